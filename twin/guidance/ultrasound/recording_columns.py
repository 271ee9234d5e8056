"""The columns of a recording: every header that is read, and the numbers of a row."""

from __future__ import annotations

from itertools import product
from types import MappingProxyType

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.points.raw_points import parse_coordinate


def row_numbers(row: list[str], header: tuple[str, ...], where: str) -> list[float]:
    """The numbers behind the name of one row, as many as the header has columns.

    Raises:
        InputError: More or fewer fields, or one that is no finite number.
    """
    if len(row) != len(header):
        raise InputError(f"{len(row)} fields", where=where, allowed=f"{len(header)} fields, as in the header")
    return [parse_coordinate(cell, f"{where}, {name}") for name, cell in zip(header[1:], row[1:], strict=True)]


def columns(pixels: bool, direction: tuple[int, int], behind: int) -> tuple[str, ...]:
    """The header: columns of the direction and of its shaft's length, and of the joints and turns behind them."""
    unit = "px" if pixels else "mm"
    poses = [
        [f"{arm}_r{i}{j}" for i in "123" for j in "123"] + [f"{arm}_{axis}_mm" for axis in "xyz"] for arm in ("A", "B")
    ]
    joints = [f"{arm}_q{i}_deg" for arm in "AB" for i in "123456"]
    turns = [f"{arm}_turn{i}" for arm in "AB" for i in "123456"]
    width, shaft = direction
    seen = (f"P_u_{unit}", f"P_v_{unit}", *("v_x", "v_y", "v_z")[:width], *("shaft_mm",)[:shaft])
    return ("name", *poses[0], *poses[1], *seen, *(joints + turns)[:behind])


CHOICES = product((False, True), ((0, 0), (2, 0), (3, 0), (2, 1), (3, 1)), (0, 12, 24))

KINDS = MappingProxyType({columns(*choice): choice for choice in CHOICES})
"""Every header that is read: whether P is in pixels, columns of direction and shaft, and how many are behind them."""
