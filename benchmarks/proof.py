"""Every verdict of a grid against FCL's own collision, and distances against brute force."""

from __future__ import annotations

import time

import fcl
import numpy as np

from benchmarks.peers import pose, trees
from benchmarks.scenes import Scene
from puncture_twin.planning.clearance.engine import NEAR_THRESHOLD_MM, too_near
from puncture_twin.planning.clearance.fast_engine import FastEngine

RADII_MM = (0.5, 3.0, 5.5)
PAIRS = 2000
OTHER_DIRECTIONS, OTHER_PAIRS = 250, 60
TOLERANCE_MM = 1e-6


def prove(scene: Scene, step_deg: float) -> bool:
    """Print how many verdicts differ from FCL's and how far distances are from brute force; whether all is well.

    The scene's own target with every direction of the grid, then other targets with random directions.
    """
    directions, start = scene.hemisphere(step_deg), time.perf_counter()
    engine, objects = FastEngine(scene.meshes), trees(scene)
    asked, wrong = verdicts_unlike_fcl(scene, engine, objects, scene.target, directions)
    print(
        f"{scene.name}: {asked:,} verdicts at {RADII_MM} mm, {step_deg:g} degree: {wrong} differ from FCL", flush=True
    )
    worst = brute_force_error(scene, engine, scene.target, directions, PAIRS)
    rng = np.random.default_rng(11)
    for place, target in other_targets(scene, rng).items():
        some = random_directions(rng, OTHER_DIRECTIONS)
        count, differ = verdicts_unlike_fcl(scene, engine, objects, target, some)
        worst = max(worst, brute_force_error(scene, engine, target, some, OTHER_PAIRS))
        print(f"    target {place}: {count:,} verdicts, {differ} differ from FCL", flush=True)
        asked, wrong = asked + count, wrong + differ
    print(
        f"    in all {asked:,} verdicts, {wrong} differ; largest error {worst:.1e} mm against brute force; "
        f"{time.perf_counter() - start:.0f} s",
        flush=True,
    )
    return wrong == 0 and worst < TOLERANCE_MM


def random_directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Unit vectors all over the sphere, shape (count, 3)."""
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def other_targets(scene: Scene, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Random targets on a vertex, on an edge, in a face, in a face's plane, amid a structure and outside them all."""
    mesh = scene.meshes[int(rng.integers(len(scene.meshes)))]
    a, b, c = mesh.triangles[int(rng.integers(len(mesh.faces)))]
    other = scene.meshes[int(rng.integers(len(scene.meshes)))]
    low = np.min([m.vertices.min(axis=0) for m in scene.meshes], axis=0)
    high = np.max([m.vertices.max(axis=0) for m in scene.meshes], axis=0)
    return {
        "on a vertex": np.array(a),
        "on an edge": 0.3 * a + 0.7 * b,
        "in a face": (a + b + c) / 3,
        "in a face's plane": 4 * a - 2 * b - c,
        "amid a structure": other.vertices.mean(axis=0),
        "anywhere": rng.uniform(low, high),
        "anywhere else": rng.uniform(low, high),
        "outside": high + 30.0,
    }


def verdicts_unlike_fcl(
    scene: Scene, engine: FastEngine, objects: list[fcl.CollisionObject], target: np.ndarray, directions: np.ndarray
) -> tuple[int, int]:
    """Verdicts asked of both, and those that differ: of the planner, and of the exact distances away from a tie.

    What FCL leaves free by less than its tolerance is too near to the planner by its distance: that is no difference.
    """
    exact = engine.measure(target, directions, scene.length).distance
    wrong = asked = 0
    for radius in RADII_MM:
        columns = enumerate(exact.T)
        ours = [too_near(engine, k, target, directions, scene.length, axes, radius) for k, axes in columns]
        verdicts = np.stack(ours, axis=1)
        capsule, rated = fcl.Capsule(radius, scene.length), np.empty(verdicts.shape, bool)
        for row, outward in enumerate(directions):
            needle = fcl.CollisionObject(capsule, pose(target, outward, scene.length))
            for column, tree in enumerate(objects):
                rated[row, column] = fcl.collide(needle, tree, fcl.CollisionRequest(), fcl.CollisionResult()) > 0
        far = np.abs(exact - radius) >= NEAR_THRESHOLD_MM
        overlaps = verdicts & ~far & (exact < radius)
        wrong += int(np.sum(((rated != verdicts) & ~overlaps) | (far & (rated != (exact < radius)))))
        asked += rated.size
    return asked, wrong


def brute_force_error(
    scene: Scene, engine: FastEngine, target: np.ndarray, directions: np.ndarray, pairs: int
) -> float:
    """Largest difference over random (direction, structure) pairs, mm."""
    rng = np.random.default_rng(7)
    found = engine.measure(target, directions, scene.length).distance
    worst = 0.0
    for row, column in zip(
        rng.integers(0, len(directions), pairs), rng.integers(0, len(scene.meshes), pairs), strict=True
    ):
        top = target + scene.length * directions[row]
        distance = segment_distance(target, top, scene.meshes[column].triangles)
        worst = max(worst, abs(distance - found[row, column]))
    return worst


def segment_distance(p: np.ndarray, q: np.ndarray, triangles: np.ndarray) -> float:
    """Distance of a segment from triangles (m, 3, 3), all tried: shares no code and no formula with the engine.

    0 where the segment runs through a face; else the least over three edges and the two ends.
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    if _through(p, q, a, b, c).any():
        return 0.0
    least = min(_segments(p, q, x, y).min() for x, y in ((a, b), (b, c), (c, a)))
    return float(np.sqrt(min(least, *(_point(end, a, b, c).min() for end in (p, q)))))


def _dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", x, y)


def _inside(x: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray, n: np.ndarray) -> np.ndarray:
    sides = [_dot(np.cross(e1 - e0, x - e0), n) >= 0 for e0, e1 in ((a, b), (b, c), (c, a))]
    area = _dot(n, n) > 1e-24 * (_dot(b - a, b - a) * _dot(c - a, c - a))
    return sides[0] & sides[1] & sides[2] & area


def _through(p, q, a, b, c):
    n = np.cross(b - a, c - a)
    above, below = _dot(p - a, n), _dot(q - a, n)
    span = np.where(above == below, 1.0, above - below)
    crossed = (above * below <= 0) & (above != below)
    return crossed & _inside(p + (above / span)[:, None] * (q - p), a, b, c, n)


def _point(x, a, b, c):
    n = np.cross(b - a, c - a)
    size = np.maximum(_dot(n, n), 1e-300)
    height = _dot(x - a, n)
    return np.where(_inside(x - (height / size)[:, None] * n, a, b, c, n), height**2 / size, np.inf)


def _segments(p, q, a, b):
    """Squared distance of p-q from edges a-b: clamped solutions of both line equations, and all four ends."""
    u, v, w = q - p, b - a, p - a
    uu, vv, uv, uw, vw = u @ u, _dot(v, v), v @ u, w @ u, _dot(v, w)
    determinant = uu * vv - uv * uv
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.clip(np.nan_to_num((uv * vw - vv * uw) / determinant), 0, 1)
        least = np.full(len(a), np.inf)
        for start in (s, np.zeros(len(a)), np.ones(len(a))):
            t = np.clip(np.nan_to_num((vw + start * uv) / vv), 0, 1)
            again = np.clip((uv * t - uw) / uu, 0, 1)
            gap = w + again[:, None] * u - t[:, None] * v
            least = np.minimum(least, _dot(gap, gap))
        for t in (0.0, 1.0):
            again = np.clip((uv * t - uw) / uu, 0, 1)
            gap = w + again[:, None] * u - t * v
            least = np.minimum(least, _dot(gap, gap))
    return least
