"""Chances to touch where the errors' size is known from a few residuals alone: against closed forms and draws.

    python -m benchmarks.error_size

The needle shifts by Student's t of nu degrees, 1 mm a deviation across it. A bore around it is touched with (1 +
d²/nu)^(-nu/2), two plates with twice the distribution's tail; a bar along it, with errors twice as large across as
towards it, and the narrow sides of two walls have no closed form: ten million draws. Columns are the distance d in
deviations. Where the size is known the error is normal, and the bore is touched with exp(-d²/2).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh
from scipy.special import ndtr, stdtr

from puncture_twin.planning.clearance.engine import normals_of
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.uncertainty.hit import proximity, touch_chance
from puncture_twin.planning.uncertainty.lines import Needles, refined

FREEDOMS, DISTANCES = (1, 3, 5, 9, 30, None), range(1, 9)
LENGTH, RADIUS, BAR = 150.0, 0.6, 10.0
HIGH, FAR = 4000.0, 1000.0  # mm: nothing that shifts passes what is as large
UP = np.array([0.0, 0.0, 1.0])
DRAWS = 10_000_000


def touched(mesh: trimesh.Trimesh, deviations: tuple[float, float], freedom: int | None) -> float:
    """The refined chance of one needle that shifts across its axis."""
    engine, cov = FastEngine([TriangleMesh(mesh.vertices, mesh.faces)]), np.zeros((1, 6, 6))
    cov[0, (0, 1), (0, 1)] = np.square(deviations)
    axes = engine.measure(np.zeros(3), UP[None], LENGTH)
    normal = normals_of(engine.triangles, np.zeros(3), UP[None], axes)
    near = proximity(axes.distance, axes.depth, normal, UP[None], cov, 0.0)
    needles = Needles(UP[None], cov, near, np.zeros((1, 1)), freedom)
    first, lengths, every = touch_chance(near, RADIUS, freedom), np.full((1, 1), LENGTH), np.ones((1, 1), bool)
    return float(refined(engine.blocks, lengths, np.zeros(3), needles, np.array([RADIUS]), first, every)[0, 0])


def bore(d: float) -> trimesh.Trimesh:
    """A block with a bore about the needle."""
    return trimesh.creation.annulus(r_min=d + RADIUS, r_max=FAR, height=HIGH, sections=128)


def plates(d: float) -> trimesh.Trimesh:
    """A plate at either side."""
    sides = [trimesh.creation.box((FAR, HIGH, HIGH)) for _ in range(2)]
    for side, sign in zip(sides, (-1, 1), strict=True):
        side.apply_translation([sign * (d + RADIUS + FAR / 2), 0, 0])
    return trimesh.util.concatenate(sides)


def bar(d: float) -> trimesh.Trimesh:
    """A round bar along the needle."""
    made = trimesh.creation.cylinder(radius=BAR, height=HIGH, sections=128)
    made.apply_translation([d + RADIUS + BAR, 0, 0])
    return made


WALLS = (0.4, 1.65)  # half widths, mm: less than a deviation, and just below where the small rule's lines lie


def wall(d: float, half: float) -> trimesh.Trimesh:
    """A wall whose narrow side faces the needle."""
    made = trimesh.creation.box((FAR, 2 * half, HIGH))
    made.apply_translation([d + RADIUS + FAR / 2, 0, 0])
    return made


def rows(freedom: int | None) -> Iterator[tuple[str, list[float], list[float]]]:
    """What is touched, the true chances and the refined ones."""
    d = np.array(DISTANCES, dtype=float)
    circle = np.exp(-(d**2) / 2) if freedom is None else (1 + d**2 / freedom) ** (-freedom / 2)
    side = ndtr(-d) if freedom is None else stdtr(freedom, -d)
    yield "bore", list(circle), [touched(bore(x), (1, 1), freedom) for x in d]
    yield "two plates", list(2 * side), [touched(plates(x), (1, 1), freedom) for x in d]
    rng = np.random.default_rng(freedom)
    size = 1.0 if freedom is None else np.sqrt(freedom / rng.chisquare(freedom, DRAWS))
    x, y = size * rng.normal(size=DRAWS), size * 2 * rng.normal(size=DRAWS)
    drawn = [float(np.mean(np.hypot(x - (at + RADIUS + BAR), y) < BAR + RADIUS)) for at in d]
    yield "bar, drawn", drawn, [touched(bar(x), (1, 2), freedom) for x in d]
    for half in WALLS:
        aside = np.maximum(np.abs(y / 2) - half, 0.0)
        drawn = [float(np.mean(np.hypot(np.maximum(at + RADIUS - x, 0.0), aside) < RADIUS)) for at in d]
        yield f"wall of {2 * half:g}, drawn", drawn, [touched(wall(at, half), (1, 1), freedom) for at in d]


def main() -> None:
    """Print the table, and how much the refined chances err."""
    print("| nu | touched | |" + "".join(f" {d} |" for d in DISTANCES) + "\n|---|---|---|" + "---|" * len(DISTANCES))
    errors = {}
    for freedom in FREEDOMS:
        nu, off = "known" if freedom is None else str(freedom), []
        for name, true, found in rows(freedom):
            off.extend(np.subtract(found, true))
            for what, values in (("true", true), ("refined", found)):
                print(f"| {nu} | {name} | {what} |" + "".join(f" {value:.4f} |" for value in values))
        errors[nu] = np.array(off)
    print("\n| nu | rms error | largest |\n|---|---|---|")
    for nu, off in errors.items():
        print(f"| {nu} | {np.sqrt(np.mean(off**2)):.4f} | {np.abs(off).max():.4f} |")


if __name__ == "__main__":
    main()
