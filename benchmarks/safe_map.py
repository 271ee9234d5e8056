"""The verdict map beside the engine with distances: every verdict, and the time of one core.

python -m benchmarks.safe_map                     10 million verdicts, then times; exit 1 where a verdict differs
python -m benchmarks.safe_map --verdicts 1000000  fewer

Verdicts are of hostile scenes (`tools.hostile_scenes`) over random grids, frames and lengths, their limits the distance
of some direction but for a little, less than rounding or FCL's tolerance too; and of the organs of each case on this
machine, each organ alone, from random targets.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.shared import REPOSITORY, least_seconds, options, real_ct, versions
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.case.entry import Directions, grid
from puncture_twin.planning.clearance.engine import measure_clearances
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.verdict_map import VerdictMap
from puncture_twin.planning.reach.standoff import case_axis_lengths
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.search import first_blocking
from tools.hostile_scenes import KINDS, make_scene

OFFSETS_MM = (0.0, 1e-12, 3e-10, 3e-9, 1e-7, 5e-5, 2e-4, 0.05)
"""By which a limit is off a direction's own distance, to either side. None is where the rule itself changes
(`ROUNDING_MM`, `NEAR_THRESHOLD_MM`): there the last bit of a distance decides."""
LIMITS, STEPS_DEG = 4, (2.0, 3.0, 5.0, 7.5)
TARGETS = 8


def differing(
    engine: FastEngine, one: Structure, target: np.ndarray, directions: Directions, R: np.ndarray, lengths: np.ndarray
) -> int:
    """How many verdicts of one structure are not the engine's."""
    found = VerdictMap(target, directions.grid, directions.outward_ct, R)
    found.add(engine, 0, one, lengths, 0.0)
    axes = measure_clearances(engine, (one,), target, directions.outward_ct, length=lengths[:, None], radius=0.0)
    return int((found.free == axes.violated[:, 0]).sum())


def random_grid(rng: np.random.Generator, R: np.ndarray, step_deg: float) -> Directions:
    """Part of the sphere, or all of it."""
    theta, beta = np.sort(rng.uniform(0, np.pi, 2)), np.sort(rng.uniform(0, 2 * np.pi, 2))
    if rng.random() < 0.5:
        theta, beta = np.array([0.0, np.pi]), np.array([0.0, 2 * np.pi])
    return grid(tuple(theta), tuple(beta), np.radians(step_deg), R)


def hostile(kind: str, seed: int, step_deg: float | None = None) -> tuple[int, int]:
    """Verdicts of one hostile scene, and how many differ; half of its grids point along its hostile directions."""
    rng = np.random.default_rng((seed, sorted(KINDS).index(kind)))
    scene = make_scene(kind, rng, 64)
    engine, asked, wrong = FastEngine([scene.mesh], threads=1), 0, 0
    R = Rotation.random(random_state=rng).as_matrix() if rng.random() < 0.5 else np.eye(3)
    directions = random_grid(rng, R, step_deg or rng.choice(STEPS_DEG))
    lengths = rng.choice([0.0, 1.0, 0.5 * scene.length, scene.length], len(directions), p=[0.02, 0.02, 0.06, 0.9])
    distance = engine.measure(scene.target, directions.outward_ct, lengths[:, None]).distance[:, 0]
    for _ in range(LIMITS):
        limit = rng.choice(distance) + rng.choice([-1.0, 1.0]) * rng.choice(OFFSETS_MM)
        one = Structure("surface", Role.AVOID, float(max(limit, 0.01)), scene.mesh, "made")
        wrong += differing(engine, one, scene.target, directions, R, lengths)
        asked += len(directions)
    return asked, wrong


def targets(context: CaseContext, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """The case's own target, vertices of its organs, and points between them."""
    yield context.case.target_ct
    points = np.concatenate([one.mesh.vertices for one in context.anatomy.structures])
    for _ in range(TARGETS - 1):
        yield rng.choice(points) + rng.choice([0.0, 20.0]) * rng.normal(size=3)


def of_case(context: CaseContext, rng: np.random.Generator) -> tuple[int, int]:
    """Verdicts of each organ of a case alone, and how many differ."""
    case, checked, asked, wrong = context.case, context.anatomy.checked, 0, 0
    R, radius = case.T_ct_entry[:3, :3], case.needle.radius_mm
    for target in targets(context, rng):
        directions = random_grid(rng, R, rng.choice(STEPS_DEG))
        lengths = case_axis_lengths(case, context.anatomy, directions.outward_ct)
        axes = measure_clearances(context.engine, checked, target, directions.outward_ct, length=lengths, radius=radius)
        for column, one in enumerate(checked):
            found = VerdictMap(target, directions.grid, directions.outward_ct, R)
            found.add(context.engine, column, one, lengths[:, column], radius)
            if one.demands_margin:
                wrong += int((found.free == axes.violated[:, column]).sum())
                asked += len(directions)
    return asked, wrong


def times(name: str, context: CaseContext) -> None:
    """Print the time of one core, map and engine in one run, over the hemisphere about the entry frame's z."""
    case, anatomy = context.case, context.anatomy
    engine = FastEngine([one.mesh for one in anatomy.checked], threads=1)
    directions = grid((0, np.radians(89)), (0, 2 * np.pi), np.radians(1), case.T_ct_entry[:3, :3])
    lengths = case_axis_lengths(case, anatomy, directions.outward_ct)

    def whole() -> None:
        engine._placed = None
        radius, outward = case.needle.radius_mm, directions.outward_ct
        measure_clearances(engine, anatomy.checked, case.target_ct, outward, length=lengths, radius=radius)

    ours = least_seconds(lambda: first_blocking(case, anatomy, engine, directions), 7)
    theirs = least_seconds(whole, 3)
    size = f"{len(anatomy.checked)} surfaces, {sum(len(one.mesh.faces) for one in anatomy.checked):,} triangles"
    print(
        f"{name}: {size}, {len(directions):,} directions: map {1e3 * ours:.0f} ms with the skin of what is free, "
        f"engine with mm {1e3 * theirs:.0f} ms without it, {theirs / ours:.1f}x",
        flush=True,
    )


def main() -> int:
    """Compare, then time."""
    wanted = options(__doc__, verdicts=10_000_000).verdicts
    print(versions("numpy", "numba", "python-fcl"))
    asked, wrong, seed, rng = 0, 0, 0, np.random.default_rng(3)
    with tempfile.TemporaryDirectory() as folder:
        paths = [REPOSITORY / "meshes" / "abdomen"]
        paths += [Path(folder) / f"case_{name}.toml" for name in ("v1", "v2")] if real_ct(Path(folder)) else []
        cases = {path.stem: prepare(path, arm=False) for path in paths}
        while asked < wanted:
            parts = [hostile(kind, seed) for kind in KINDS] + [of_case(one, rng) for one in cases.values()]
            asked, wrong, seed = asked + sum(p[0] for p in parts), wrong + sum(p[1] for p in parts), seed + 1
            print(f"{asked:,} verdicts, {wrong} differ", flush=True)
        for name, context in cases.items():
            times(name, context)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
