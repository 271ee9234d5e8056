"""The fast clearance engine beside FCL, on one machine, in one run; and every verdict of a grid against FCL's own.

python -m benchmarks.clearance            how fast
python -m benchmarks.clearance --quick    a coarser grid and fewer FCL queries
python -m benchmarks.clearance --proof    verdicts and distances instead; exit 1 where one differs
python -m benchmarks.clearance --curves   how the cost grows, as docs/pictures/search-cost.png
"""

import sys
import time

import fcl
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.shared import REPOSITORY, Scene, dense, least_seconds, options, scenes, took, versions
from puncture_twin.planning.clearance.engine import NEAR_THRESHOLD_MM, too_near
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from tools.plain_distance import least_distances

SAMPLE, QUICK_SAMPLE = 300, 60
ROUNDS = 6
NEEDLE_MM = 0.6
RADII_MM = (0.5, 3.0, 5.5)
PAIRS = 2000
OTHER_DIRECTIONS, OTHER_PAIRS = 250, 60
TOLERANCE_MM = 1e-6
ROWS, DIRECTIONS = (71, 100, 142, 200, 283, 400), (1_000, 4_000, 16_000, 64_000, 250_000)
"""Of the curves: rows of the dense scene's organs (50k to 1.6M triangles in all), and directions."""


def trees(scene: Scene) -> list[fcl.CollisionObject]:
    """FCL objects of the surfaces."""
    found = []
    for mesh in scene.meshes:
        tree = fcl.BVHModel()
        tree.beginModel(num_tris_=len(mesh.faces), num_vertices_=len(mesh.vertices))
        tree.addSubModel(mesh.vertices, mesh.faces)
        tree.endModel()
        found.append(fcl.CollisionObject(tree))
    return found


def capsule(target: np.ndarray, outward: np.ndarray, length: float, radius: float) -> fcl.CollisionObject:
    """A needle."""
    helper = np.eye(3)[np.argmin(np.abs(outward))]
    x = np.cross(helper, outward) / np.linalg.norm(np.cross(helper, outward))
    R = np.stack([x, np.cross(outward, x), outward], axis=1)
    return fcl.CollisionObject(fcl.Capsule(radius, length), fcl.Transform(R, target + outward * (length / 2)))


def ask_distances(scene: Scene, directions: np.ndarray, objects: list[fcl.CollisionObject]) -> None:
    """`fcl.distance` of a 0.6 mm capsule from every surface: exact, as people use it."""
    for outward in directions:
        needle = capsule(scene.target, outward, scene.length, NEEDLE_MM)
        for tree in objects:
            fcl.distance(needle, tree, fcl.DistanceRequest(), fcl.DistanceResult())


def ask_hits(scene: Scene, directions: np.ndarray, objects: list[fcl.CollisionObject]) -> None:
    """`fcl.collide` with every surface that has a margin: one capsule per direction and margin."""
    for outward in directions:
        for radius in np.unique(scene.thresholds[np.isfinite(scene.thresholds)]):
            needle = capsule(scene.target, outward, scene.length, radius)
            for column in np.flatnonzero(scene.thresholds == radius):
                fcl.collide(needle, objects[column], fcl.CollisionRequest(), fcl.CollisionResult())


def rounds(scene: Scene, directions: np.ndarray, sample: int) -> dict[str, float]:
    """Seconds of everybody for all directions, means over rounds in which all take their turn."""
    chosen = np.random.default_rng(1).choice(len(directions), min(sample, len(directions)), replace=False)
    engine, judge, objects = FastEngine(scene.meshes, threads=1), FclEngine(scene.meshes), trees(scene)
    ask = (scene.target, directions, scene.length)
    engine.measure(*ask)
    sums: dict[str, float] = {}
    for part in np.array_split(directions[chosen], ROUNDS):
        scale = len(directions) / len(part)
        times = {
            "build": took(lambda: FastEngine(scene.meshes, threads=1)),
            "exact": took(lambda: engine.measure(*ask)),
            "FCL build": took(lambda: FclEngine(scene.meshes)),
            "FCL capsule": took(lambda part=part: ask_distances(scene, part, objects)) * scale,
            "FCL collide": took(lambda part=part: ask_hits(scene, part, objects)) * scale,
        }
        sums = {name: sums.get(name, 0.0) + seconds / ROUNDS for name, seconds in times.items()}
    judge.measure(scene.target, directions[chosen[:1]], scene.length)  # compiled, and warm
    whole = took(lambda: judge.measure(scene.target, directions[chosen], scene.length))
    return {**sums, "FCL triangle": whole * len(directions) / len(chosen)}


def measure_scene(scene: Scene, sample: int, step_deg: float) -> None:
    """Print one scene's rows."""
    directions = scene.hemisphere(step_deg)
    s = rounds(scene, directions, sample)
    sizes = f"{scene.triangles:,} triangles, {len(scene.meshes)} surfaces, {len(directions):,} directions"
    print(f"\n## {scene.name}: {sizes}\n| ratio | search alone | end to end, building included |\n|---|---|---|")
    for label, theirs in (
        ("FCL distance, capsule", "FCL capsule"),
        ("FCL distance, degenerate triangle", "FCL triangle"),
        ("FCL collide (hit or not)", "FCL collide"),
    ):
        both = (s[theirs] + s["FCL build"]) / (s["exact"] + s["build"])
        print(f"| {label} / ours, exact | {s[theirs] / s['exact']:.0f}x | {both:.0f}x |")
    seconds = ", ".join(f"{name} {mean:.3f}" for name, mean in s.items())
    print(f"seconds, mean of {ROUNDS} rounds: {seconds} (FCL on {sample} random directions in all, scaled)", flush=True)


def prove(scene: Scene, step_deg: float) -> bool:
    """Print how many verdicts differ from FCL's and how far distances are from brute force; whether all is well."""
    directions, start, rng = scene.hemisphere(step_deg), time.perf_counter(), np.random.default_rng(11)
    engine, objects = FastEngine(scene.meshes), trees(scene)
    asked, wrong = verdicts_unlike_fcl(scene, engine, objects, scene.target, directions)
    step = f"{step_deg:g} degree"
    print(f"{scene.name}: {asked:,} verdicts at {RADII_MM} mm, {step}: {wrong} differ from FCL", flush=True)
    worst = brute_force_error(scene, engine, scene.target, directions, PAIRS)
    for place, target in other_targets(scene, rng).items():
        some = rng.normal(size=(OTHER_DIRECTIONS, 3))
        some /= np.linalg.norm(some, axis=1, keepdims=True)
        count, differ = verdicts_unlike_fcl(scene, engine, objects, target, some)
        worst = max(worst, brute_force_error(scene, engine, target, some, OTHER_PAIRS))
        print(f"    target {place}: {count:,} verdicts, {differ} differ from FCL", flush=True)
        asked, wrong = asked + count, wrong + differ
    error, spent = f"largest error {worst:.1e} mm against brute force", time.perf_counter() - start
    print(f"    in all {asked:,} verdicts, {wrong} differ; {error}; {spent:.0f} s", flush=True)
    return wrong == 0 and worst < TOLERANCE_MM


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
        rated = np.empty(verdicts.shape, bool)
        for row, outward in enumerate(directions):
            needle = capsule(target, outward, scene.length, radius)
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
    """Largest difference over random (direction, structure) pairs, mm, from every triangle measured one by one."""
    rng = np.random.default_rng(7)
    found = engine.measure(target, directions, scene.length).distance
    chosen, columns = rng.integers(0, len(directions), pairs), rng.integers(0, len(scene.meshes), pairs)
    worst = 0.0
    for column in np.unique(columns):
        rows = chosen[columns == column]
        plain = least_distances(target, target + scene.length * directions[rows], scene.meshes[column].triangles)
        worst = max(worst, float(np.abs(plain - found[rows, column]).max()))
    return worst


def cost(rows: int, count: int) -> tuple[float, float]:
    """Seconds to build and to search the dense scene, so many directions spread evenly over a hemisphere."""
    scene, z = dense(rows), 1 - (np.arange(count) + 0.5) / count
    beta, aside = np.pi * (1 + np.sqrt(5)) * np.arange(count), np.sqrt(1 - z * z)
    rays = np.stack([aside * np.cos(beta), aside * np.sin(beta), z], axis=1)
    engine = FastEngine(scene.meshes, threads=1)
    build = least_seconds(lambda: FastEngine(scene.meshes, threads=1), 3)
    return build, least_seconds(lambda: engine.measure(scene.target, rays, scene.length), 3)


def curves() -> None:
    """Draw both curves, print the exponents."""
    by_triangles = {10 * rows**2: cost(rows, 32_760) for rows in ROWS}
    by_directions = {count: cost(283, count)[1] for count in DIRECTIONS}
    lines = {
        "search, 32,760 directions": {n: seconds for n, (_, seconds) in by_triangles.items()},
        "building": {n: seconds for n, (seconds, _) in by_triangles.items()},
        "search, 801k triangles": by_directions,
    }
    figure, axes = plt.subplots(1, 2, figsize=(9, 4), constrained_layout=True)
    for axis, name, points in zip(axes[[0, 0, 1]], lines, lines.values(), strict=True):
        x, y = np.array(list(points)), np.array(list(points.values()))
        slope = np.polyfit(np.log(x), np.log(y), 1)[0]
        axis.loglog(x, y, "o-", label=f"{name}: exponent {slope:.2f}")
        print(f"{name}: {y[0]:.3f} to {y[-1]:.3f} s, exponent {slope:.2f}")
    for axis, across in zip(axes, ("triangles of five surfaces", "directions"), strict=True):
        axis.set(xlabel=across, ylabel="processor time of one thread, s")
        axis.grid(visible=True, which="major", alpha=0.4)
        axis.legend(fontsize=8)
    figure.savefig(REPOSITORY / "docs" / "pictures" / "search-cost.png", dpi=110)


def main() -> int:
    """Parse, measure, print."""
    chosen = options(__doc__, quick=False, proof=False, curves=False, scene="", step=1.0)
    print(versions("numpy", "numba", "python-fcl"))
    if chosen.curves:
        curves()
        return 0
    if chosen.proof:
        answers = [prove(scene, chosen.step) for scene in scenes(chosen.scene) if scene.name != "dense synthetic"]
        return 0 if all(answers) else 1
    for scene in scenes(chosen.scene):
        measure_scene(scene, QUICK_SAMPLE if chosen.quick else SAMPLE, 4.0 if chosen.quick else chosen.step)
    return 0


if __name__ == "__main__":
    sys.exit(main())
