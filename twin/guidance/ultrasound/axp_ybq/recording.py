"""A recording of both arms and the image, pose by pose: the input of the self-calibration.

Frames: ``base1`` and ``end1`` of the arm with the probe, ``image`` (mm, the slice is z = 0), ``base2`` and
``end2`` of the arm with the needle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import Shown, brief
from puncture_twin.planning.formats.csv_table import finite_rows, pose_names, refuse_first, rigid_poses
from puncture_twin.planning.formats.points import joint_readings

OPTIONAL = ("v", "shaft_mm", "q_probe", "q_needle", "turn_probe", "turn_needle")
"""Optional arrays of a recording besides both flanges and the tip, with one row per pose."""
SHAFT_POWER = 1.5
"""A line's angle errs with the power -3/2 of its length: the variance of a least squares slope through n evenly spaced
points is 12 sigma^2 / (n length^2), n as the length. Detected in images: .17 deg at 10 mm, .11 at 15, .03 at 32."""
LEAST_SHAFT_MM = 1.0
"""Nothing shorter shows a direction."""
LEAST_IN_PLANE = 0.5
"""Least fraction of a needle direction that must lie in the image: a needle that leans more does not show as a line."""


class Noise(NamedTuple):
    """Standard deviations per axis: of each flange's place and small turn, the tip and the direction in the image."""

    robot_mm: float
    robot_rad: float
    image_mm: float
    direction_rad: float
    off_plane_mm: float = 0.0  # how far the tip lies off the slice and still shows


SPEC_NOISE = Noise(robot_mm=0.1, robot_rad=np.radians(0.03), image_mm=0.3, direction_rad=np.radians(0.5))
"""The noise of spec 3, section 4; it gives none for the direction: half a degree, ten times its detector's spread."""


@dataclass(frozen=True, eq=False)
class Recording(Shown):
    """Poses of both arms with the needle seen in the image. Checked when made; the arrays are read-only.

    Raises:
        InputError: Shapes that do not match, values that are not finite, matrices that are not rigid motions.
    """

    A: Floats
    """T_base1_end1, shape (n, 4, 4), mm: flange of the probe's arm; B: T_base2_end2, flange of the needle's arm."""
    B: Floats  # T_base2_end2, shape (n, 4, 4), mm: flange of the needle's arm
    P: Floats
    """The tip in the image, shape (n, 2), mm (pixels where ``pixels`` is set: mm per pixel is to be found); shape (n,
    3), mm, where a volume or a camera measures it out of a plane too."""
    v: Floats | None = None
    """Direction of the needle toward its tip, in the image, made unit. Shape (n, 2) where the image alone says it, (n,
    3) where the part across the image is measured too; None where it was not measured."""
    names: tuple[str, ...] = ()  # one per pose; numbers where nothing is given
    pixels: bool = False
    q_probe: Floats | None = None
    """Joints of the probe's arm, shape (n, 6), rad, as its controller prints them; those of the needle's arm in
    ``q_needle``; None where they were not recorded: errors of the arms are then not told from noise."""
    q_needle: Floats | None = None  # joints of the needle's arm, shape (n, 6), rad
    turn_probe: Floats | None = None
    """Direction of each probe joint's last rotation before it stopped, shape (n, 6): 1, -1, or 0 where nobody knows;
    the needle's in ``turn_needle``. None where they were not recorded: the play's sign is then unknown."""
    turn_needle: Floats | None = None
    shaft_mm: Floats | None = None
    """How much of the shaft shows, shape (n,): the more, the better its direction is known; None where it was not
    measured: all directions then count the same."""
    missed: tuple[tuple[str, str], ...] = ()  # name and reason of each picture in which no needle was found

    @brief
    def __repr__(self) -> str:
        missed = f", {len(self.missed)} pictures without a needle" if self.missed else ""
        return f"{len(self.P)} poses, the tip in {'pixels' if self.pixels else 'mm'}{missed}"

    def __post_init__(self) -> None:
        names = pose_names(self.names, len(np.atleast_1d(self.A)))
        checked: dict[str, Any] = {key: rigid_poses(getattr(self, key), key, names) for key in "AB"}
        checked |= {"names": names, "P": finite_rows(self.P, "P", names, widths=(2, 3))}
        if self.pixels and checked["P"].shape[1] == 3:
            refuse("three coordinates in pixels", "recording", "mm", "wrong_unit")
        if self.v is not None:
            checked["v"] = _directions(self.v, names)
        if self.shaft_mm is not None:
            checked["shaft_mm"] = _lengths(self.shaft_mm, self.v, names)
        if (self.q_probe is None) != (self.q_needle is None):
            refuse("joints of only one arm", "recording", "joints of both arms, or of none", "joints_of_one_arm")
        if self.joints:
            checked |= {key: _angles(getattr(self, key), key, names) for key in ("q_probe", "q_needle")}
        if (self.turn_probe is None) != (self.turn_needle is None) or (self.turn_probe is not None and not self.joints):
            refuse("turns without joints, or of only one arm", "recording", "both, with joints", "joints_of_one_arm")
        if self.turn_probe is not None:
            checked |= {key: _signs(getattr(self, key), key, names) for key in ("turn_probe", "turn_needle")}
        for key, value in checked.items():
            object.__setattr__(self, key, value)

    @property
    def joints(self) -> bool:
        """Whether the joints of both arms were recorded."""
        return self.q_probe is not None

    @property
    def direction_spread(self) -> Floats:
        """Each direction's standard deviation over all directions' rms, shape (n,)."""
        if self.shaft_mm is None:
            return np.ones(len(self))
        return np.asarray(self.shaft_mm**-SHAFT_POWER / self.shaft_unit)

    @property
    def shaft_unit(self) -> float:
        """Root mean square of the directions' spreads by their shafts' lengths; 1 where those were not read."""
        return 1.0 if self.shaft_mm is None else float(np.sqrt(np.mean(self.shaft_mm ** (-2 * SHAFT_POWER))))

    def __len__(self) -> int:
        return len(self.names)

    def subset(self, rows: NDArray[np.int_] | NDArray[np.bool_] | slice) -> Recording:
        """The recording with these poses only."""
        parts = {key: getattr(self, key) for key in ("A", "B", "P", *OPTIONAL)}
        selected: dict[str, Any] = {key: None if one is None else one[rows] for key, one in parts.items()}
        return replace(self, names=tuple(np.array(self.names)[rows].tolist()), **selected)


def _angles(values: Floats, what: str, names: tuple[str, ...]) -> Floats:
    rows = finite_rows(values, what, names, widths=(6,))
    return read_only(joint_readings(rows, "rad", where=f"recording, {what}", names=names))


def _lengths(values: Floats, v: Floats | None, names: tuple[str, ...]) -> Floats:
    if v is None:
        refuse("shaft_mm without directions", "recording", "together with v, or not at all", "missing_column")
    array = finite_rows(np.reshape(values, (-1, 1)), "shaft_mm", names, widths=(1,))[:, 0]
    allowed = f"at least {LEAST_SHAFT_MM:g} mm"
    refuse_first(array < LEAST_SHAFT_MM, names, "shaft_mm", "is too little", allowed, "out_of_range")
    return array


def _signs(values: Floats, what: str, names: tuple[str, ...]) -> Floats:
    array = finite_rows(values, what, names, widths=(6,))
    bad = np.asarray(~np.isin(array, (-1.0, 0.0, 1.0)).all(axis=1))
    refuse_first(bad, names, what, "is not a direction of rotation", "1, -1, or 0 if not known", "bad_value")
    return array


def _directions(v: Floats, names: tuple[str, ...]) -> Floats:
    array = finite_rows(v, "v", names, widths=(2, 3))
    lengths = np.linalg.norm(array, axis=1)
    flat = np.linalg.norm(array[:, :2], axis=1) < LEAST_IN_PLANE * lengths
    refuse_first(~np.any(array != 0, axis=1), names, "v", "has no length", "a direction", "zero_direction")
    refuse_first(flat, names, "v", "points out of the image", "a needle that lies in the image", "out_of_image")
    return read_only(array / lengths[:, None])
