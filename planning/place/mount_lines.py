"""A base's pose as the ``[robot.mount]`` of a case, rounded as it is written."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.tables.robot_section import MountSection
from puncture_twin.planning.geometry.spaces import Space, to_lps

POSITION_DIGITS = 1
"""Positions are written to 0.1 mm: nobody stands a base more exactly."""

AXIS_DIGITS = 6
"""Axes are written to six digits: 1e-3 mm at a metre."""


def mount_section(T_ct_base: Floats, space: Space) -> MountSection:
    """The section that states this pose in the case's space, rounded.

    Args:
        T_ct_base: Shape (4, 4), mm.
        space: The case's.
    """
    # LPS to RAS is its own inverse.
    position, x, z = to_lps(np.stack([T_ct_base[:3, 3], T_ct_base[:3, 0], T_ct_base[:3, 2]]), space)
    return MountSection(
        position_mm=_rounded(position, POSITION_DIGITS),
        x_axis=_rounded(x, AXIS_DIGITS),
        z_axis=_rounded(z, AXIS_DIGITS),
    )


def mount_lines(mount: MountSection) -> str:
    """The lines to paste into a case."""
    keys = ("position_mm", "x_axis", "z_axis")
    return "\n".join(["[robot.mount]", *(f"{key} = {list(getattr(mount, key))}" for key in keys)])


def _rounded(vector: Floats, digits: int) -> tuple[float, float, float]:
    x, y, z = (float(value) + 0.0 for value in np.round(vector, digits))  # + 0.0 makes -0.0 a plain 0
    return x, y, z
