"""Servo cases with other settings, and cameras without pictures: what the studies change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from puncture_twin.twin.guidance.stereo.detection import Detection, Detector, LocatedPair, Search
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.stereo_workcell import StereoWorkcell


def pixel_detector(room: StereoWorkcell, sigma_px: float, rng: np.random.Generator) -> Detector:
    """True pixels with normal errors of a standard deviation per axis."""

    def see(number: int, ball: LocatedPair, search: Search) -> Detection:
        del search
        pixel = room.cameras[number].project(ball.center_c) + rng.normal(0.0, sigma_px, 2)
        return Detection(pixel, max(sigma_px, 1e-6) ** 2 * np.eye(2))

    return see


def varied(case: ServoCase, **sections: dict[str, Any]) -> ServoCase:
    """The case with some keys of its sections changed, checked as when read.

    Args:
        case: The case.
        sections: Such as ``cameras={"noise_grey": 6.0}``.
    """
    content = case.file.model_dump(by_alias=True)
    for section, keys in sections.items():
        content[section] = (content[section] or {}) | keys
    return replace(case, file=type(case.file).model_validate(content))
