"""Closed surfaces along a line: limbs, bones and lines with round ends, and what has one section along the bed."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh

SIDES = 24
"""Corners of a round section: at a radius of 50 mm the sides lie within 0.5 mm of the circle."""
END_RINGS = 4
"""Of a round end."""


class Part(NamedTuple):
    """One body beside a patient; a later one fills the place of an earlier one.

    Attributes:
        name: What it is.
        mesh: Closed, mm.
        hu: What it is made of, Hounsfield units.
        place: ``beneath`` the patient, as the bed; ``upon`` them, as arms and lines, which the body displaces;
            ``within`` an arm, as its bones, which displace the body.
    """

    name: str
    mesh: TriangleMesh
    hu: float
    place: Literal["beneath", "upon", "within"] = "upon"


def tube(points: Floats, radii: Floats, wide: Floats | None = None) -> TriangleMesh:
    """A limb along a line, with round ends.

    Args:
        points: Shape (m, 3), m >= 2, mm.
        radii: Shape (m,), mm; or (m, 2), half widths along ``wide`` and across it.
        wide: Shape (3,): where the first half width of a flat section points, roughly; any where None.
    """
    halves = np.stack([radii, radii], axis=1) if radii.ndim == 1 else radii
    along = _tangents(points)
    one, other = _across(along, wide)
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    lift = np.pi / 2 * np.arange(END_RINGS, 0, -1) / (END_RINGS + 0.5)
    rows = [(0, -np.sin(a), np.cos(a)) for a in lift]
    rows += [(k, 0.0, 1.0) for k in range(len(points))]
    rows += [(len(points) - 1, np.sin(a), np.cos(a)) for a in lift[::-1]]
    rings = []
    for at, beyond, scale in rows:
        section = scale * circle * halves[at]
        middle = points[at] + beyond * halves[at].min() * along[at]
        rings.append(middle + section[:, :1] * one[at] + section[:, 1:] * other[at])
    return loft(np.array(rings))


def drawn(section: Floats, low_mm: float, high_mm: float) -> TriangleMesh:
    """A section along the bed.

    Args:
        section: Shape (n, 2), the corners in x and y around it, mm: two rows that face each other, so that
            its ends are strips between them, however it is bent.
        low_mm: Where it begins along z.
        high_mm: Where it ends.
    """
    half = len(section) // 2
    rows = [np.column_stack([section, np.full(len(section), z)]) for z in (low_mm, high_mm)]
    sides = _sides(2, len(section))
    i = np.arange(half - 1)
    strip = np.concatenate(
        [np.stack([i, i + 1, 2 * half - 2 - i], axis=1), np.stack([i, 2 * half - 2 - i, 2 * half - 1 - i], axis=1)]
    )
    return _outward(np.concatenate(rows), np.concatenate([sides, strip[:, ::-1], strip + len(section)]))


def loft(rings: Floats) -> TriangleMesh:
    """A closed surface through rings, flat at both ends.

    Args:
        rings: Shape (m, n, 3): n corners around each, in one order, mm; the ends star-shaped about their middles.
    """
    count, around = rings.shape[:2]
    tops = np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    i, j, last = np.arange(around), np.roll(np.arange(around), -1), count * around
    low = np.stack([np.full(around, last), j, i], axis=1)
    high = np.stack([np.full(around, last + 1), i + last - around, j + last - around], axis=1)
    vertices = np.concatenate([rings.reshape(-1, 3), tops])
    return _outward(vertices, np.concatenate([_sides(count, around), low, high]))


def _sides(count: int, around: int) -> np.ndarray:
    """Triangles between neighbouring rings."""
    i, j = np.arange(around), np.roll(np.arange(around), -1)
    band = np.concatenate([np.stack([i, j, j + around], axis=1), np.stack([i, j + around, i + around], axis=1)])
    return np.concatenate([band + k * around for k in range(count - 1)])


def _outward(vertices: Floats, faces: np.ndarray) -> TriangleMesh:
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    inward = float(np.einsum("ij,ij->", a, np.cross(b, c))) < 0.0
    return TriangleMesh(vertices, np.asarray(faces[:, ::-1] if inward else faces, dtype=np.int32))


def _tangents(points: Floats) -> Floats:
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    sums = np.concatenate([steps[:1], steps[1:] + steps[:-1], steps[-1:]])
    return np.asarray(sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9))


def _across(along: Floats, wide: Floats | None) -> tuple[Floats, Floats]:
    """Two directions across each tangent, carried from one to the next."""
    first = np.array([0.3, 0.7, 0.65]) if wide is None else np.asarray(wide, dtype=float)
    one = np.empty_like(along)
    for k, tangent in enumerate(along):
        first = first - (first @ tangent) * tangent
        first /= np.linalg.norm(first)
        one[k] = first
    return one, np.cross(along, one)
