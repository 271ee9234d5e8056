"""Arms beside or upon a trunk, with hands and bones: drawn anew by every generator, sizes of adults."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.plant.beside.outline import Outline
from puncture_twin.twin.plant.beside.tubes import Part, tube

Arms = Literal["none", "beside", "pressed", "across"]
UPPER_MM, FORE_MM, HAND_MM = 300.0, 250.0, 170.0
"""Lengths of an adult's upper arm, forearm and hand; ours."""
STEP_MM = 15.0
"""Between two sections of a limb."""
SIDES = (("left", 1.0), ("right", -1.0))


def arms(outline: Outline, kind: Arms, at_mm: float, rng: np.random.Generator) -> Iterator[Part]:
    """Both arms: flesh with skin, and bones.

    Args:
        outline: Of the trunk.
        kind: ``beside`` with air between; ``pressed`` against the flanks; ``across`` belly or chest.
        at_mm: The height along the bed near which they lie.
        rng: Draws sizes and places.
    """
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
    """Of an arm: joints (4, 3), a finer line (n, 3) through them with how far along each is, and the hand's back."""

    joints: Floats
    points: Floats
    along: Floats
    outward: Floats


def _beside(
    outline: Outline, side: float, at_mm: float, radii: Floats, pressed: bool, rng: np.random.Generator
) -> _Line:
    """Along the bed; straight with a gap, or following the flank where it is pressed against it."""
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
    """The upper arm beside the trunk, the forearm straight over flank and belly, the hand upon it."""
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
    """By how much a point is nearer to the skin, along its own spoke, than wanted."""
    away = point[:2] - outline.middle(point[2])
    radius = float(np.linalg.norm(away))
    return outline.reach(float(point[2]), away / radius) + off_mm - radius


def _flesh(name: str, line: _Line, radii: Floats, hand: Floats, hu: float) -> Iterator[Part]:
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line.joints, axis=0), axis=1))])
    limb = line.along <= lengths[2] + 1e-6
    thick = np.interp(line.along, lengths[:3], radii)
    yield Part(name, tube(line.points[limb], thick[limb]), hu)
    from_wrist = line.points[line.along >= lengths[2] - 20.0]
    halves = np.stack([np.full(len(from_wrist), hand[0]), np.full(len(from_wrist), hand[1])], axis=1)
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
