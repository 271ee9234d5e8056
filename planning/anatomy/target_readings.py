"""How else a point may have been meant that lies where it cannot: in the other space, in cm or in m."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.geometry.units import Unit


def readings_inside(
    point_ct: Floats, space: Space, inside: Callable[[Floats], bool], place: str = "in the body"
) -> str:
    """The readings of a point under which it would lie where it belongs, as a hint in brackets; empty for none.

    Args:
        point_ct: Shape (3,), LPS (or local) mm, as it was read.
        space: In which it was stated.
        inside: Whether a point (3,) lies there.
        place: In words.
    """
    found = [text for text, point in _readings(point_ct, space) if inside(point)]
    return f" (read {' or '.join(found)} it lies {place})" if found else ""


def _readings(point_ct: Floats, space: Space) -> Iterator[tuple[str, Floats]]:
    """Each other reading, with the point (3,), mm."""
    for unit in Unit:
        if unit is not Unit.MM:
            yield f"in {unit}", unit.mm * point_ct
        if space is not Space.LOCAL:
            other = Space.RAS if space is Space.LPS else Space.LPS
            mirrored = to_lps(point_ct[None], Space.RAS)[0]
            yield f"in {other}" if unit is Unit.MM else f"in {other} and {unit}", unit.mm * mirrored
