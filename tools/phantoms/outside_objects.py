"""Objects outside of a patient in a scanner: arms along or upon the trunk, what they lie on, and lines and cables.

Arms have hands and bones, drawn anew by every generator, sizes of adults. A patient lies on a flat table with a
mattress, a curved table, or a pad as dense as the body. Limbs, bones and lines are closed surfaces along a line
(`tube`), tables have one section along the bed (`loft`). `Outline` gives the skin's sections across the bed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.plant.scanner.case_scene import Part
from tools.phantoms.mesher import outward

SHEATH_HU, WATER_HU, CORE_HU = 100.0, 0.0, 3000.0
"""Hounsfield units of plastic, of what flows in it, and of thin wires of copper with the plastic between; ours."""


class OutsideObjects(NamedTuple):
    """Choice of objects outside of the patient; arms that are ``none`` lie over the head, outside of the image."""

    arms: Arms = "none"
    bed: Bed = "none"
    lines: int = 0

    def placed(self, skin: TriangleMesh, at_mm: float, rng: np.random.Generator) -> tuple[Part, ...]:
        """Objects about a skin, LPS mm, y to the back, z to the head: the bed first, then arms, then lines."""
        outline = Outline(skin)
        found = [*bed(outline, self.bed, rng), *arms(outline, self.arms, at_mm, rng)]
        return (*found, *lines(outline, self.lines, at_mm, rng))


def lines(outline: Outline, count: int, at_mm: float, rng: np.random.Generator) -> Iterator[Part]:
    """Draw lines, tubes and cables in turn, each over front or flank."""
    for number in range(1, count + 1):
        cable = number % 2 == 0
        radius = rng.uniform(2.0, 3.5)
        start = rng.uniform(0.0, 180.0)
        turn = np.radians(np.linspace(start, start + rng.uniform(-120.0, 120.0), 40))
        height = at_mm + np.linspace(rng.uniform(-70.0, 70.0), rng.uniform(-70.0, 70.0), 40)
        lift = rng.uniform(0.0, 25.0) * np.sin(np.linspace(0.0, np.pi, 40)) if number % 3 else np.zeros(40)
        points = np.empty((40, 3))
        for k, (a, z) in enumerate(zip(turn, height, strict=True)):
            spoke = np.array([np.cos(a), -np.sin(a)])
            points[k] = *(outline.middle(z) + (outline.reach(z, spoke) + radius + lift[k]) * spoke), z
        name = f"{'cable' if cable else 'line'}_{number}"
        yield Part(name, tube(points, np.full(40, radius)), SHEATH_HU)
        inner = 0.3 if cable else 0.55
        core = CORE_HU if cable else WATER_HU
        yield Part(f"{name}_core", tube(points[1:-1], np.full(38, inner * radius)), core)


Arms = Literal["none", "beside", "pressed", "across"]
UPPER_MM, FORE_MM, HAND_MM = 300.0, 250.0, 170.0
"""Lengths of an adult's upper arm, forearm and hand; ours."""
STEP_MM = 15.0
"""Between two sections of a limb."""
SIDES = (("left", 1.0), ("right", -1.0))


def arms(outline: Outline, kind: Arms, at_mm: float, rng: np.random.Generator) -> Iterator[Part]:
    """Both arms, flesh and bones: ``beside`` with air between, ``pressed`` to the flanks, ``across`` belly or chest."""
    for name, side in () if kind == "none" else SIDES:
        elbow = rng.uniform(32.0, 46.0)
        radii = elbow * np.array([rng.uniform(1.0, 1.25), 1.0, rng.uniform(0.6, 0.75)])
        hand = np.array([rng.uniform(34.0, 46.0), rng.uniform(12.0, 17.0)])
        if kind == "across":
            line = _across(outline, side, at_mm, radii, rng)
        else:
            line = _beside(outline, side, at_mm, radii, kind == "pressed", rng)
        hu = rng.uniform(-60.0, 50.0)
        yield from _flesh(f"arm_{name}", line, radii, hand, hu)
        yield from _bones(f"arm_{name}", line, radii, hand, rng.uniform(500.0, 1000.0))


class _Line(NamedTuple):
    """Line of an arm: joints (4, 3), a finer line (n, 3) with how far along each point is, and the hand's back."""

    joints: Floats
    points: Floats
    along: Floats
    outward: Floats


def _beside(
    outline: Outline, side: float, at_mm: float, radii: Floats, pressed: bool, rng: np.random.Generator
) -> _Line:
    """An arm along the bed: straight with a gap, or following the flank where it is pressed against it."""
    elbow = at_mm + rng.uniform(-150.0, 200.0)
    z = np.arange(elbow + UPPER_MM, elbow - FORE_MM - HAND_MM - 1e-9, -STEP_MM)
    along = elbow + UPPER_MM - z
    thick = np.interp(along, [0.0, UPPER_MM, UPPER_MM + FORE_MM], radii)
    y = outline.middle(at_mm)[1] + rng.uniform(-20.0, 40.0) + np.linspace(0.0, rng.uniform(-25.0, 25.0), len(z))
    flank = np.array([outline.aside(h, side, (m - r, m + r)) for h, m, r in zip(z, y, thick, strict=True)])
    if pressed:
        x = _smooth(flank, 5) + (1.0 - rng.uniform(0.05, 0.45)) * thick
    else:
        tilt = np.linspace(0.0, rng.uniform(-20.0, 20.0), len(z))
        x = tilt + (flank + thick - tilt).max() + rng.uniform(4.0, 30.0)
    points = np.stack([side * x, y, z], axis=1)
    ends = [np.interp(s, along, np.arange(len(z))) for s in (0.0, UPPER_MM, UPPER_MM + FORE_MM, along[-1])]
    joints = np.stack([_between(points, end) for end in ends])
    return _Line(joints, points, along, np.array([side, 0.0, 0.0]))


def _across(outline: Outline, side: float, at_mm: float, radii: Floats, rng: np.random.Generator) -> _Line:
    """An arm across the body: upper arm along the trunk, forearm over flank and belly, the hand upon it."""
    sink = rng.uniform(0.05, 0.6)
    turn = np.radians([rng.uniform(-10.0, 30.0), rng.uniform(60.0, 110.0)])
    height = at_mm + rng.uniform([-40.0, -60.0], [110.0, 60.0])
    spokes = [np.array([side * np.cos(a), -np.sin(a)]) for a in turn]
    ends = np.array([_on(outline, z, spoke, radii[1]) for z, spoke in zip(height, spokes, strict=True)])
    bisector = np.append(sum(spokes) / np.linalg.norm(sum(spokes)), 0.0)
    for _ in range(4):
        t = np.linspace(0.0, 1.0, 12)[:, None]
        line = ends[0] + t * (ends[1] - ends[0])
        thick = np.interp(t[:, 0], [0.0, 1.0], radii[1:])
        short = max(_lack(outline, p, r * (1.0 - sink)) for p, r in zip(line, thick, strict=True))
        ends = ends + short * bisector
    shoulder = ends[0] + np.array([0.0, rng.uniform(0.0, 40.0), UPPER_MM])
    y = (shoulder[1] - radii[0], shoulder[1] + radii[0])
    flank = max(outline.aside(z, side, y) for z in np.linspace(ends[0, 2], shoulder[2], 8))
    shoulder[0] = side * max(flank + 0.8 * radii[0], side * ends[0, 0] - 40.0)
    forward = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    tip = ends[1] + HAND_MM * forward
    middle = outline.middle(tip[2])
    spoke = (tip[:2] - middle) / np.linalg.norm(tip[:2] - middle)
    tip = _on(outline, float(tip[2]), spoke, 14.0)
    joints = np.stack([shoulder, *ends, tip])
    points, along = _resampled(joints)
    return _Line(joints, points, along, np.append(spoke, 0.0))


def _on(outline: Outline, z: float, spoke: Floats, off_mm: float) -> Floats:
    """A point so far off the skin in a direction from the section's middle, shape (3,)."""
    return np.append(outline.middle(z) + (outline.reach(z, spoke) + off_mm) * spoke, z)


def _lack(outline: Outline, point: Floats, off_mm: float) -> float:
    """Distance by which a point is too near to the skin, along its own spoke, mm."""
    away = point[:2] - outline.middle(point[2])
    radius = float(np.linalg.norm(away))
    return outline.reach(float(point[2]), away / radius) + off_mm - radius


def _flesh(name: str, line: _Line, radii: Floats, hand: Floats, hu: float) -> Iterator[Part]:
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line.joints, axis=0), axis=1))])
    limb = line.along <= lengths[2] + 1e-6
    thick = np.interp(line.along, lengths[:3], radii)
    yield Part(name, tube(line.points[limb], thick[limb]), hu)
    from_wrist = line.points[line.along >= lengths[2] - 20.0]
    halves = np.tile(hand, (len(from_wrist), 1))
    yield Part(f"{name}_hand", tube(from_wrist, halves, np.cross(_forward(line, 2), line.outward)), hu)


def _bones(name: str, line: _Line, radii: Floats, hand: Floats, hu: float) -> Iterator[Part]:
    thick = 0.27 * radii[1]
    inside = [line.points[_part(line, k)] for k in range(3)]
    yield Part(f"{name}_humerus", tube(inside[0], np.full(len(inside[0]), thick)), hu, "within")
    wide = np.cross(_forward(line, 1), line.outward)
    for bone, way in (("radius", 1.0), ("ulna", -1.0)):
        shift = way * np.linspace(0.35 * radii[1], 0.45 * radii[2], len(inside[1]))[:, None] * wide
        yield Part(f"{name}_{bone}", tube(inside[1] + shift, np.full(len(inside[1]), 0.55 * thick)), hu, "within")
    wide = np.cross(_forward(line, 2), line.outward)
    for number, at in enumerate(np.linspace(-0.7, 0.7, 4), start=1):
        points = inside[2] + at * hand[0] * wide
        yield Part(f"{name}_finger_{number}", tube(points, np.full(len(points), 4.0)), hu, "within")


def _part(line: _Line, number: int) -> np.ndarray:
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line.joints, axis=0), axis=1))])
    inside = (line.along >= lengths[number] + 4.0) & (line.along <= lengths[number + 1] - 4.0)
    return np.flatnonzero(inside)


def _forward(line: _Line, number: int) -> Floats:
    """Unit direction of a part of the arm, made orthogonal to the hand's back."""
    way = line.joints[number + 1] - line.joints[number]
    way = way - (way @ line.outward) * line.outward
    return np.asarray(way / np.linalg.norm(way))


def _resampled(joints: Floats) -> tuple[Floats, Floats]:
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=1))])
    along = np.unique(np.concatenate([np.arange(0.0, lengths[-1], STEP_MM), lengths]))
    return np.stack([np.interp(along, lengths, column) for column in joints.T], axis=1), along


def _between(points: Floats, at: float) -> Floats:
    return np.array([np.interp(at, np.arange(len(points)), column) for column in points.T])


def _smooth(values: Floats, half: int) -> Floats:
    """Means over neighbours, the ends repeated."""
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)), mode="valid")


Bed = Literal["none", "flat", "curved", "pad"]
Ends = tuple[float, float]
BEYOND_MM = 400.0
"""So far a bed goes on beyond the skin at head and feet."""
SHELL_HU, FOAM_HU, COVER_HU, MATTRESS_HU, PAD_HU = 60.0, -930.0, -120.0, -960.0, 20.0
"""Hounsfield units of a table's shell and core, a mattress's cover and foam, and a pad of gel; ours."""
COVER_MM, CURVED_MM = 2.0, 30.0
"""How thick a mattress's cover and a curved table are; ours."""


def bed(outline: Outline, kind: Bed, rng: np.random.Generator) -> Iterator[Part]:
    """A bed: ``flat``, a mattress of foam on a table; ``curved``, a bent shell of foam; ``pad``, gel on a table."""
    low, high = outline.skin.bounds[:, 2] + np.array([-BEYOND_MM, BEYOND_MM])
    middle = float(outline.skin.bounds[:, 0].mean()) + rng.uniform(-10.0, 10.0)
    top = outline.back(low, high) - rng.uniform(0.0, 8.0)
    half, shell = rng.uniform(200.0, 270.0), rng.uniform(2.5, 5.0)
    if kind == "curved":
        yield from _curved((middle, top), rng.uniform(260.0, 420.0), 0.8 * half, shell, (low, high))
    elif kind != "none":
        thick = rng.uniform(15.0, 45.0)
        table = top + thick
        cover = _box(middle, half, top, table)
        if kind == "pad":
            yield Part("pad", drawn(cover, low, high), PAD_HU, "beneath")
        else:
            core = _box(middle, half - COVER_MM, top + COVER_MM, table - COVER_MM)
            yield Part("mattress", drawn(cover, low, high), COVER_HU, "beneath")
            yield Part("mattress_foam", drawn(core, low + COVER_MM, high - COVER_MM), MATTRESS_HU, "beneath")
        deep = table + rng.uniform(25.0, 60.0)
        yield Part("table", drawn(_box(middle, half, table, deep), low, high), SHELL_HU, "beneath")
        inner = _box(middle, half - shell, table + shell, deep - shell)
        yield Part("table_foam", drawn(inner, low + shell, high - shell), FOAM_HU, "beneath")


def _box(middle: float, half: float, top: float, bottom: float) -> Floats:
    return np.array([[middle - half, top], [middle + half, top], [middle + half, bottom], [middle - half, bottom]])


def _curved(at: tuple[float, float], radius: float, half: float, shell: float, ends: Ends) -> Iterator[Part]:
    for name, inset, hu in (("table", 0.0, SHELL_HU), ("table_foam", shell, FOAM_HU)):
        turn = np.linspace(-1.0, 1.0, 25) * (np.arcsin(half / radius) - inset / radius)
        rim = np.stack([np.sin(turn), np.cos(turn)], axis=1)
        upper, lower = (radius + inset) * rim, (radius + CURVED_MM - inset) * rim[::-1]
        section = np.concatenate([upper, lower]) + np.array([at[0], at[1] - radius])
        yield Part(name, drawn(section, ends[0] + inset, ends[1] - inset), hu, "beneath")


TUBE_SIDES = 24
"""Corners of a round section: at a radius of 50 mm the sides lie within 0.5 mm of the circle."""
END_RINGS = 4
"""Rings of a round end."""


def tube(points: Floats, radii: Floats, wide: Floats | None = None) -> TriangleMesh:
    """A limb along a line, with round ends.

    Args:
        radii: Shape (m,), mm; or (m, 2), half widths along ``wide`` and across it.
        wide: Shape (3,): where the first half width of a flat section points, roughly; any where None.
    """
    halves = np.stack([radii, radii], axis=1) if radii.ndim == 1 else radii
    along = _tangents(points)
    one, other = _across_tube(along, wide)
    angle = 2.0 * np.pi * np.arange(TUBE_SIDES) / TUBE_SIDES
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
    """A section extruded along the bed.

    Args:
        section: Shape (n, 2), the corners in x and y around it, mm: two rows that face each other, so that
            its ends are strips between them, however it is bent.
    """
    half = len(section) // 2
    rows = [np.column_stack([section, np.full(len(section), z)]) for z in (low_mm, high_mm)]
    sides = _sides(2, len(section))
    i = np.arange(half - 1)
    facing = 2 * half - 1 - i
    strip = np.concatenate([np.stack([i, i + 1, facing - 1], axis=1), np.stack([i, facing - 1, facing], axis=1)])
    return outward(np.concatenate(rows), np.concatenate([sides, strip[:, ::-1], strip + len(section)], dtype=np.int32))


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
    return outward(vertices, np.concatenate([_sides(count, around), low, high], dtype=np.int32))


def _sides(count: int, around: int) -> np.ndarray:
    i, j = np.arange(around), np.roll(np.arange(around), -1)
    band = np.concatenate([np.stack([i, j, j + around], axis=1), np.stack([i, j + around, i + around], axis=1)])
    return np.concatenate([band + k * around for k in range(count - 1)])


def _tangents(points: Floats) -> Floats:
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    sums = np.concatenate([steps[:1], steps[1:] + steps[:-1], steps[-1:]])
    return np.asarray(sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9))


def _across_tube(along: Floats, wide: Floats | None) -> tuple[Floats, Floats]:
    """Two directions across each tangent, carried from one to the next."""
    first = np.array([0.3, 0.7, 0.65]) if wide is None else np.asarray(wide, dtype=float)
    one = np.empty_like(along)
    for k, tangent in enumerate(along):
        first = first - (first @ tangent) * tangent  # carried on without a twist
        first /= np.linalg.norm(first)
        one[k] = first
    return one, np.cross(along, one)


END_MM = 20.0
"""Nearer to its ends along the bed a skin is rounded or cut: what lies beyond is as at so far from them."""
PER_SEGMENT = np.linspace(0.0, 1.0, 5)


@dataclass(frozen=True, eq=False)
class Outline:
    """A patient's skin in the scanner: x to the left, y to the back, z to the head."""

    skin: TriangleMesh

    def section(self, z: float) -> Floats:
        """Section of the skin by a plane across the bed: segments (m, 2, 2), x and y, mm."""
        low, high = self.skin.bounds[:, 2]
        at = float(np.clip(z, min(low + END_MM, (low + high) / 2), max(high - END_MM, (low + high) / 2)))
        corners = self.skin.triangles
        above = corners[:, :, 2] > at
        cut = corners[above.any(axis=1) & ~above.all(axis=1)]
        above = cut[:, :, 2] > at
        alone = np.argmax(above == (above.sum(axis=1) == 1)[:, None], axis=1)  # the corner alone on its side
        rows = np.arange(len(cut))
        tip, first, second = (cut[rows, (alone + step) % 3] for step in range(3))
        return np.stack([_crossing(tip, first, at), _crossing(tip, second, at)], axis=1)

    def middle(self, z: float) -> Floats:
        """Middle of the section's box, shape (2,), mm."""
        points = self.section(z).reshape(-1, 2)
        return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)

    def reach(self, z: float, direction: Floats) -> float:
        """Distance from the section's middle to its farthest point along a unit direction (2,), mm."""
        segments = self.section(z) - self.middle(z)
        across = np.array([-direction[1], direction[0]])
        off, along = segments @ across, segments @ direction
        crossed = (off[:, 0] > 0) != (off[:, 1] > 0)  # segments that the line through the middle crosses
        off, along = off[crossed], along[crossed]
        ahead = along[:, 0] - off[:, 0] * (along[:, 1] - along[:, 0]) / (off[:, 1] - off[:, 0])
        return float(ahead.max(initial=0.0))

    def aside(self, z: float, side: float, y: tuple[float, float]) -> float:
        """The outermost x to a side (1 or -1), times the side, where y lies within a range, mm."""
        segments = self.section(z)
        points = segments[:, :1] + PER_SEGMENT[:, None] * (segments[:, 1:] - segments[:, :1])
        points = points.reshape(-1, 2)
        within = points[(points[:, 1] >= y[0]) & (points[:, 1] <= y[1])]
        return float((side * (within if len(within) else points)[:, 0]).max())

    def back(self, low_mm: float, high_mm: float) -> float:
        """The rearmost y between two heights, mm."""
        z, y = self.skin.vertices[:, 2], self.skin.vertices[:, 1]
        within = (z >= low_mm) & (z <= high_mm)
        return float(y[within].max() if within.any() else y.max())


def _crossing(a: Floats, b: Floats, z: float) -> Floats:
    part = ((z - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None]
    return np.asarray((a + part * (b - a))[:, :2])
