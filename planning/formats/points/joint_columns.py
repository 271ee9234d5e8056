"""The joint angles that a CSV of touched points may hold beside each point."""

from __future__ import annotations

from collections.abc import Sequence

from puncture_twin.planning.formats.points.raw_points import parse_coordinate
from puncture_twin.planning.formats.raw_mesh import refuse

JOINT_COLUMNS = tuple(f"q{number}_deg" for number in range(1, 7))
"""In any order among the others."""

MAX_JOINT_DEG = 720.0
"""No joint of a robot arm turns farther than two whole turns; a larger angle is none in degrees."""


def joints_deg(fields: Sequence[str], header: Sequence[str], where: str) -> tuple[float, ...]:
    """The six angles of one line, degrees.

    Args:
        fields: Of the line.
        header: Names of its columns, `JOINT_COLUMNS` among them.
        where: File and line, for the error.

    Raises:
        InputError: An angle is no number, or none in degrees.
    """
    angles = tuple(parse_coordinate(fields[header.index(name)], where) for name in JOINT_COLUMNS)
    if max(map(abs, angles)) > MAX_JOINT_DEG:
        refuse(f"a joint at {max(angles, key=abs):g} degrees", where, f"-{MAX_JOINT_DEG:g} to {MAX_JOINT_DEG:g}")
    return angles
