"""Declared errors of a servo case, in the estimator's units: what may be off, and by how much.

The belief computes with them, the twin's truth is drawn from them. Defaults and reasons: docs/reference/servo-case.md.
What is not here (a rod that bends, cameras that move after the calibration, tissue) is not modelled, which is something
else than 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import ARM_KINDS
from puncture_twin.planning.case.toml_types import Number, Section

Millimetres = Annotated[Number, Field(ge=0, le=50)]
Degrees = Annotated[Number, Field(ge=0, le=10)]
Pixels = Annotated[Number, Field(ge=0, le=200)]
DetectionPixels = Annotated[Number, Field(ge=1e-4, le=50)]
Part = Annotated[Number, Field(ge=0, le=0.2)]
"""A fraction, 0 to 1."""

DEFAULT_REPEATABILITY_DEG = 0.003
"""As in the CT case: .1 mm and less at the reach of a UR3, its data sheet's pose repeatability."""

DEFAULT_BACKLASH_DEG = 0.0
"""The gears of these arms have no play worth naming."""

DEFAULT_MEASURING_MM = 0.01
"""Deviation of a coordinate measuring arm."""

DEFAULT_MARKER_MM = 0.3
"""Deviation of a marker's centre in an image with voxels of a millimetre: 1 / sqrt(12)."""


ANGLES = ("twist", "joint", "backlash", "repeatability", "needle_direction", "head_turn")
"""Attributes of `ServoErrors` in rad, whose keys are in degrees."""


class ServoErrorsSection(Section):
    """The declared errors; what is left out takes its default (`declared_errors`)."""

    arm: Literal["calibrated", "nominal"] = "calibrated"
    link_mm: Millimetres | None = None
    twist_deg: Degrees | None = None
    joint_deg: Degrees | None = None
    backlash_deg: Degrees | None = None
    repeatability_deg: Degrees | None = None
    ball_offset_mm: Millimetres = 0.3
    tip_offset_mm: Millimetres = 0.3
    needle_direction_deg: Degrees = 0.2
    camera_turn_deg: Degrees = 0.23
    camera_shift_mm: Millimetres = 3.0
    camera_axis_px: Pixels = 8.0
    camera_focal: Part = 0.01
    lens: tuple[Part, Part, Part, Part] = (0.02, 0.02, 0.0005, 0.0005)
    ball_px: DetectionPixels | None = None
    measuring_arm_mm: Millimetres | None = None
    marker_mm: Millimetres | None = None
    target_mm: Millimetres | None = None
    head_shift_mm: Millimetres = 0.0
    head_turn_deg: Degrees = 0.0


class ServoRehearsalSection(Section):
    """Errors from which a workcell's truth is drawn, where they are not those that the belief declares."""

    errors: ServoErrorsSection | None = None


@dataclass(frozen=True)
class CameraErrors:
    """Standard deviations of a camera about its plan, before it is calibrated.

    Attributes:
        turn: About each axis, rad.
        shift_mm: Along each axis.
        axis_px: Of the principal point, per axis.
        focal: Of the focal length, as a part of it.
        lens: Of k1, k2, p1, p2.
    """

    turn: float
    shift_mm: float
    axis_px: float
    focal: float
    lens: tuple[float, float, float, float]


@dataclass(frozen=True)
class ServoErrors:
    """Standard deviations per axis; mm, rad and px.

    Attributes:
        link_mm: Of every Denavit-Hartenberg length a_i and d_i.
        twist: Of every twist alpha_i.
        joint: Of every joint's zero.
        backlash: Full width of every joint's play.
        repeatability: Of every joint, anew at each arrival.
        ball_offset_mm: Of the ball's centre against where the controller has it on the flange; the cameras see it.
        tip_offset_mm: Of the needle's tip against the ball's centre, flange axes; no camera sees it.
        needle_direction: Of the needle, about each of the flange's x and y axes.
        camera: Of each camera.
        ball_px: Of the centre of a ball or marker in one look; None takes what the tracker states of each image.
        measuring_mm: Of the measuring arm.
        marker_mm: Of a marker in the image.
        target_mm: Of the target in the image.
        head_shift_mm: By which the head moves after its markers were seen.
        head_turn: By which it turns, about the markers' middle.
    """

    link_mm: float
    twist: float
    joint: float
    backlash: float
    repeatability: float
    ball_offset_mm: float
    tip_offset_mm: float
    needle_direction: float
    camera: CameraErrors
    ball_px: float | None
    measuring_mm: float
    marker_mm: float
    target_mm: float
    head_shift_mm: float
    head_turn: float

    @property
    def arrival(self) -> float:
        """Deviation of every joint at one arrival, rad; play leaves a joint at either edge, so half of it counts."""
        return float(np.hypot(self.repeatability, self.backlash / 2))

    def arm_deviations(self) -> Floats:
        """Deviations of the 26 parameters that move the ball, shape (26,), ordered as `error_jacobian`; mm, rad."""
        kinds = ((self.link_mm, 11), (self.twist, 6), (self.joint, 6), (self.ball_offset_mm, 3))
        return np.repeat([value for value, _ in kinds], [count for _, count in kinds])

    def camera_deviations(self) -> Floats:
        """Deviations of a camera's 13 parameters: focal length (part), axis (px), lens, rotation (rad), shift (mm)."""
        one = self.camera
        return np.array([one.focal, *[one.axis_px] * 2, *one.lens, *[one.turn] * 3, *[one.shift_mm] * 3])

    def stated(self) -> dict[str, float | tuple[float, ...] | None]:
        """The deviations by the keys of ``[errors]``, mm, degrees and px."""
        one, degrees = self.camera, {name: float(np.degrees(getattr(self, name))) for name in ANGLES}
        return {
            "link_mm": self.link_mm,
            **{f"{name}_deg": value for name, value in degrees.items()},
            "ball_offset_mm": self.ball_offset_mm,
            "tip_offset_mm": self.tip_offset_mm,
            "camera_turn_deg": float(np.degrees(one.turn)),
            "camera_shift_mm": one.shift_mm,
            "camera_axis_px": one.axis_px,
            "camera_focal": one.focal,
            "lens": one.lens,
            "ball_px": self.ball_px,
            "measuring_arm_mm": self.measuring_mm,
            "marker_mm": self.marker_mm,
            "target_mm": self.target_mm,
            "head_shift_mm": self.head_shift_mm,
        }

    def scaled(self, factor: float) -> ServoErrors:
        """Each deviation times a factor; of the pixels only where one is declared."""
        numbers = {name: factor * value for name, value in vars(self).items() if isinstance(value, float)}
        camera = {name: factor * value for name, value in vars(self.camera).items() if name != "lens"}
        one, two, three, four = (factor * value for value in self.camera.lens)
        return replace(self, **numbers, camera=CameraErrors(**camera, lens=(one, two, three, four)))


def declared_errors(section: ServoErrorsSection, older: Mapping[str, float | None]) -> ServoErrors:
    """The declaration in mm, rad and px, with the defaults filled in.

    Args:
        section: As the case states it.
        older: Values of keys of the same names that other tables of the case state.
    """
    kind = ARM_KINDS[section.arm]

    def value(key: str, default: float) -> float:
        stated = getattr(section, key)
        stated = older.get(key) if stated is None else stated
        return default if stated is None else float(stated)

    marker = value("marker_mm", DEFAULT_MARKER_MM)
    return ServoErrors(
        link_mm=value("link_mm", kind.link_mm),
        twist=np.radians(value("twist_deg", kind.twist_deg)),
        joint=np.radians(value("joint_deg", kind.joint_deg)),
        backlash=np.radians(value("backlash_deg", DEFAULT_BACKLASH_DEG)),
        repeatability=np.radians(value("repeatability_deg", DEFAULT_REPEATABILITY_DEG)),
        ball_offset_mm=section.ball_offset_mm,
        tip_offset_mm=section.tip_offset_mm,
        needle_direction=np.radians(section.needle_direction_deg),
        camera=CameraErrors(
            np.radians(section.camera_turn_deg),
            section.camera_shift_mm,
            section.camera_axis_px,
            section.camera_focal,
            section.lens,
        ),
        ball_px=section.ball_px,
        measuring_mm=value("measuring_arm_mm", DEFAULT_MEASURING_MM),
        marker_mm=marker,
        target_mm=value("target_mm", marker),
        head_shift_mm=section.head_shift_mm,
        head_turn=np.radians(section.head_turn_deg),
    )
