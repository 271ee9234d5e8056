"""What a point file holds, before unit, space and the guard: the common result of its readers."""

from __future__ import annotations

import math
from typing import NamedTuple

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.geometry.units import Unit


class RawPoints(NamedTuple):
    """Points as their file states them; the guard has not seen them yet.

    Attributes:
        names: One per point.
        points: Three coordinates per point, in ``unit`` and ``space``.
        unit: None if the file states none.
        space: None if the file states none.
        kinds: One per point, if the file has them.
        joints_deg: Six joint angles per point, if the file says how the robot stood there.
    """

    names: list[str]
    points: list[tuple[float, float, float]]
    unit: Unit | None
    space: Space | None
    kinds: tuple[str, ...] | None = None
    joints_deg: list[tuple[float, ...]] | None = None


def parse_coordinate(text: str, where: str) -> float:
    """A finite decimal number.

    Raises:
        InputError: If the text is anything else, such as a decimal comma, NaN or an empty field.
    """
    allowed = "a finite number with a decimal point"
    if "_" in text:  # Python would read 1_0 as 10
        raise InputError(f"{text[:40]!r} is not a number", where=where, allowed=allowed)
    try:
        number = float(text)
    except ValueError as error:
        raise InputError(f"{text[:40]!r} is not a number", where=where, allowed=allowed) from error
    if not math.isfinite(number):
        raise InputError(f"{text[:40]!r} is not finite", where=where, allowed=allowed)
    return number
