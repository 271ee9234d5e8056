"""Declared errors of a servo case: what may be off, and by how much.

The belief computes with them, the twin's truth is drawn from them. Defaults and reasons: docs/reference/servo-case.md.
What is not here (a rod that bends, cameras that move after the calibration, tissue) is not modelled, which is something
else than 0.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Strict, model_validator

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import ARM_KINDS, ArmErrors
from puncture_twin.planning.case.tables import Number, Section

Millimetres = Annotated[Number, Field(ge=0, le=50)]
Degrees = Annotated[Number, Field(ge=0, le=10)]
Pixels = Annotated[Number, Field(ge=0, le=200)]
DetectionPixels = Annotated[Number, Field(ge=1e-4, le=50)]
Part = Annotated[Number, Field(ge=0, le=0.2)]
"""A fraction, 0 to 1."""

DEFAULT_MEASURING_MM = 0.01
"""Deviation of a coordinate measuring arm."""

DEFAULT_MARKER_MM = 0.3
"""Deviation of a marker's centre in an image with voxels of a millimetre: 1 / sqrt(12)."""


class ServoErrors(ArmErrors):
    """Standard deviations per axis.

    Attributes:
        arm: Whose numbers link, twist and joint take where none are stated.
        gear_deg: Amplitude of each gear's error, a sine over its joint.
        gear_cycles: Periods of that sine per turn of the joint: 200 of a harmonic drive of 1:100, twice a turn of its
            motor (Tuttle, "Understanding and modeling the behavior of a harmonic drive gear transmission", MIT
            AITR-1365, 1992).
        ball_offset_mm: Of the ball's centre against where the controller has it on the flange; the cameras see it.
        tip_offset_mm: Of the needle's tip against the ball's centre, flange axes; no camera sees it.
        needle_direction_deg: Of the needle, about each of the flange's x and y axes.
        camera_axis_px: Of the principal point.
        camera_focal: Of the focal length, as a part of it.
        lens: Of k1, k2, p1, p2.
        ball_px: Of the centre of a ball or marker in one look; None takes what the tracker states of each image.
        target_mm: Of the target in the image; as a marker where it is not stated.
        head_shift_mm: By which the head moves after its markers were seen.
        head_turn_deg: By which it turns, about the markers' middle.
    """

    arm: Literal["calibrated", "nominal"] = "calibrated"
    gear_deg: Degrees = 0.0
    gear_cycles: Annotated[int, Strict(), Field(ge=1, le=1000)] = 200
    ball_offset_mm: Millimetres = 0.3
    tip_offset_mm: Millimetres = 0.3
    needle_direction_deg: Degrees = 0.2
    camera_turn_deg: Degrees = 0.23
    camera_shift_mm: Millimetres = 3.0
    camera_axis_px: Pixels = 8.0
    camera_focal: Part = 0.01
    lens: tuple[Part, Part, Part, Part] = (0.02, 0.02, 0.0005, 0.0005)
    ball_px: DetectionPixels | None = None
    measuring_arm_mm: Millimetres = DEFAULT_MEASURING_MM
    marker_mm: Millimetres = DEFAULT_MARKER_MM
    target_mm: Millimetres = DEFAULT_MARKER_MM
    head_shift_mm: Millimetres = 0.0
    head_turn_deg: Degrees = 0.0

    @model_validator(mode="before")
    @classmethod
    def _as_kind_and_marker(cls, stated: Any) -> Any:
        if not isinstance(stated, dict):
            return stated
        kind = ARM_KINDS["nominal" if stated.get("arm") == "nominal" else "calibrated"]
        return {**kind._asdict(), "target_mm": stated.get("marker_mm", DEFAULT_MARKER_MM), **stated}

    @property
    def needle_direction(self) -> float:
        """Of the needle, rad."""
        return float(np.radians(self.needle_direction_deg))

    @property
    def camera_turn(self) -> float:
        """Of each camera about each axis, rad."""
        return float(np.radians(self.camera_turn_deg))

    @property
    def head_turn(self) -> float:
        """Of the head after its markers were seen, rad."""
        return float(np.radians(self.head_turn_deg))

    @property
    def arrival(self) -> float:
        """Deviation of every joint at one arrival, rad.

        Play leaves a joint at either edge, so half of it counts. A gear's error is a sine of the joint, of which no two
        arrivals have the same phase: it is as good as drawn anew.
        """
        return float(np.linalg.norm([self.repeatability, self.backlash / 2, np.radians(self.gear_deg) / np.sqrt(2.0)]))

    def arm_deviations(self) -> Floats:
        """Deviations of the 26 parameters that move the ball, shape (26,), ordered as `error_jacobian`; mm, rad."""
        return np.repeat([self.link_mm, self.twist, self.joint, self.ball_offset_mm], [11, 6, 6, 3])

    def camera_deviations(self) -> Floats:
        """Deviations of a camera's 13 parameters: focal length (part), axis (px), lens, rotation (rad), shift (mm)."""
        lens, axes = (self.camera_focal, *[self.camera_axis_px] * 2, *self.lens), [self.camera_turn] * 3
        return np.array([*lens, *axes, *[self.camera_shift_mm] * 3])

    def stated(self) -> dict[str, Any]:
        """The deviations by the keys of ``[errors]``, mm, degrees and px."""
        return self.model_dump(exclude={"arm"})


class ServoRehearsalSection(Section):
    """Errors from which a workcell's truth is drawn, where they are not those that the belief declares."""

    errors: ServoErrors | None = None
