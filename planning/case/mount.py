"""Frames that a case states by two axes: where the arm's base stands, and which way a gantry or a bed looks."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.entry import entry_frame
from puncture_twin.planning.case.tables.robot_section import MountSection
from puncture_twin.planning.case.tables.search_section import EntryAxes
from puncture_twin.planning.case.toml_types import Anatomical
from puncture_twin.planning.geometry.frames import frame_of_axes
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.spaces import Space, to_lps

AXES_PARALLEL = 0.999
"""|cos| above which a mount's x and z axes do not span a frame (2.6 degrees)."""

LIKE_METRES = 5.0
"""A base that stands nearer to the CT's origin than this, and not on it, is one in metres: no arm reaches farther."""

AXES_SQUARE_DEG = 1.0
"""A mount's x and z axes may differ from a right angle by this much: what rounding to two digits leaves. More is
another rotation than was meant, and 1 degree moves the needle's tip by 9 mm at the arm's reach of half a metre."""

Axis = Anatomical | tuple[float, float, float]


def mount_pose(mount: MountSection, space: Space, path: Path) -> Floats:
    """T_base_ct, shape (4, 4), from the base's origin and axes, as a case states them in its own space.

    Raises:
        InputError: The axes are parallel or zero, or not at a right angle, or the position looks like metres.
    """
    x, z = (to_lps(np.asarray([v], dtype=float), space)[0] for v in (mount.x_axis, mount.z_axis))
    lengths = np.linalg.norm(x), np.linalg.norm(z)
    if min(lengths) == 0 or abs(x @ z) > AXES_PARALLEL * lengths[0] * lengths[1]:
        raise InputError("robot.mount: x_axis and z_axis are parallel or zero", where=path, allowed="two axes")
    angle = float(np.degrees(np.arccos(x @ z / (lengths[0] * lengths[1]))))
    if abs(angle - 90.0) > AXES_SQUARE_DEG:
        raise InputError(
            f"robot.mount: x_axis and z_axis are {angle:.1f} degrees apart",
            where=path,
            allowed=f"a right angle, to {AXES_SQUARE_DEG:g} degree",
        )
    far = float(np.linalg.norm(mount.position_mm))
    if 0.0 < far < LIKE_METRES:
        raise InputError(
            f"robot.mount: position_mm is {far:g} mm from the origin, which would be a base within the patient",
            where=path,
            allowed="millimetres (these look like metres)",
        )
    T_ct_base = pose(frame_of_axes(z, x), to_lps(np.asarray([mount.position_mm]), space)[0])
    T_base_ct = np.asarray(np.linalg.inv(T_ct_base), np.float64)
    T_base_ct.setflags(write=False)
    return T_base_ct


def axes_frame(z: Axis, x: Axis, space: Space, path: Path, key: str) -> Floats:
    """R_ct_frame, shape (3, 3), of a frame whose z axis is given and whose x axis is what of ``x`` is square to it.

    Raises:
        InputError: The two are parallel or zero; names ``key``.
    """
    try:
        return entry_frame(EntryAxes(z=z, x=x), space, where=path)
    except InputError as error:
        raise InputError(f"{key} are parallel or zero", where=path, allowed="two axes") from error
