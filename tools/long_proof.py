"""Sixteen million verdicts of the product against FCL and against a plain brute force, on hostile scenes.

``python -m tools.long_proof --count 16000000 --log FILE`` writes one line per scene, without times, and prints the
log's SHA-256: the same seed and count give the same digest. A log that is there is continued, and only reported where
it is long enough. Exit 1 where a "safe" is wrong.

A verdict is the product's: `planning.clearance.engine.measure` over the `FastEngine`, safe or too close at a margin.
What is true: too close if the axis' distance is below needle radius plus margin, 0 inside a closed surface. The brute
force computes in float64, and once more in long double where it differs from the verdict or is within `CLOSE_MM` of the
threshold. A verdict is wrong if the distance lies on the other side of the threshold by more than `ROUNDING_MM`.
FCL's own verdict is its capsule collision with the surface; a difference from it counts beyond `FCL_TOLERANCE_MM`.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections import defaultdict
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import fcl
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.clearance.engine import measure_clearances
from puncture_twin.planning.clearance.fast_engine import FastEngine
from tools.hostile_scenes import KINDS, HostileScene, make_scene
from tools.plain_distance import Inside, distances, exact_distance, least_distances

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

ROUNDING_MM = 1e-9
"""A verdict that is wrong by less than this is a matter of rounding."""

CLOSE_MM = 1e-6
"""Within this of a threshold float64 is not trusted: long double decides what is true."""

FCL_TOLERANCE_MM = 1e-6
"""FCL's iterations end at this: it does not see capsules that overlap a triangle by less."""

NEAR_MM = 0.1
NEAR_FRACTION = 0.26
"""Of all verdicts, this many are chosen to lie within `NEAR_MM` of their threshold; others do so by chance."""

VERDICTS = 4000
"""Of one scene, about."""

BATCHES = 4
"""Margins that a scene's verdicts away from the threshold share."""

LEAST_THRESHOLD_MM = 0.01
"""FCL does not return from a capsule without a radius."""

TOGETHER = 8
"""Directions before and behind one that are asked with it, where their distances are as near to its threshold."""

MAX_RADIUS_MM = 0.6


class Questions(NamedTuple):
    """Rows of a scene's directions and a threshold for each, mm; shapes (n,)."""

    row: NDArray[np.int64]
    threshold: Floats


@dataclass
class Tally:
    """What was found, in numbers of verdicts.

    Attributes:
        near: Within `NEAR_MM` of the threshold.
        near_apart: Of these, where the axis does not meet the structure.
        inside: The target lies in a closed surface, so that nothing is safe.
        long_double: Decided by the long double brute force.
        within_rounding: Right either way.
        unlike_fcl: The product differs from FCL's collision, beyond FCL's tolerance.
        fcl_within_tolerance: It differs within that.
        fcl_wrong: FCL differs from the brute force's distance from the surface, beyond its tolerance.
    """

    verdicts: int = 0
    near: int = 0
    near_apart: int = 0
    safe: int = 0
    inside: int = 0
    long_double: int = 0
    wrong_safe: int = 0
    wrong_too_close: int = 0
    within_rounding: int = 0
    unlike_fcl: int = 0
    fcl_within_tolerance: int = 0
    fcl_wrong: int = 0

    def add(self, other: Tally) -> None:
        """Sum up."""
        for field in fields(self):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))


def product_verdicts(engine: FastEngine, scene: HostileScene, outward: Floats, threshold: float) -> Bools:
    """Whether the product says too close, shape (n,)."""
    radius = min(MAX_RADIUS_MM, threshold)
    structure = Structure("surface", Role.AVOID, threshold - radius, scene.mesh, "made")
    found = measure_clearances(engine, (structure,), scene.target, outward, length=scene.length, radius=radius)
    return found.violated[:, 0]


def fcl_verdicts(tree: fcl.CollisionObject, scene: HostileScene, asked: Questions) -> Bools:
    """Whether FCL's capsule collides with the surface, shape (n,)."""
    z = scene.outward[asked.row]
    helper = np.eye(3)[np.argmin(np.abs(z), axis=1)]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], axis=2)
    middle = scene.target + z * (scene.length / 2)
    hits = np.empty(len(z), bool)
    for row, threshold in enumerate(asked.threshold.tolist()):
        capsule = fcl.CollisionObject(fcl.Capsule(threshold, scene.length), fcl.Transform(R[row], middle[row]))
        hits[row] = fcl.collide(capsule, tree, fcl.CollisionRequest(), fcl.CollisionResult()) > 0
    return hits


def fcl_tree(scene: HostileScene) -> fcl.CollisionObject:
    """FCL's tree of the scene's surface."""
    tree = fcl.BVHModel()
    tree.beginModel(num_tris_=len(scene.mesh.faces), num_vertices_=len(scene.mesh.vertices))
    tree.addSubModel(scene.mesh.vertices, scene.mesh.faces)
    tree.endModel()
    return fcl.CollisionObject(tree)


def far_questions(distance: Floats, rng: np.random.Generator) -> list[Questions]:
    """Batches that share a threshold from the whole range of distances."""
    rows = np.array_split(np.arange(int(VERDICTS * (1 - NEAR_FRACTION))), BATCHES)
    top = max(float(np.quantile(distance, 0.9)), 1.0)
    thresholds = LEAST_THRESHOLD_MM + top * rng.uniform(0, 1, BATCHES) ** 2
    return [Questions(r, np.full(len(r), t)) for r, t in zip(rows, thresholds, strict=True)]


def near_questions(distance: Floats, rng: np.random.Generator) -> list[Questions]:
    """Thresholds within `NEAR_MM` of a direction's own distance, evenly or down to 1e-9 mm, and who else is as near."""
    order = np.argsort(distance)
    distance, left = distance[order], int(VERDICTS * NEAR_FRACTION)
    apart = int(np.searchsorted(distance, NEAR_MM))
    asked = []
    while left > 0:
        pick = int(rng.integers(apart if apart < len(order) else 0, len(order)))
        offset = rng.uniform(0, NEAR_MM) if rng.random() < 0.5 else 10.0 ** rng.uniform(-9, np.log10(NEAR_MM))
        threshold = distance[pick] + offset * rng.choice([-1.0, 1.0])
        if threshold < LEAST_THRESHOLD_MM:
            threshold = rng.uniform(LEAST_THRESHOLD_MM, NEAR_MM)
        low, high = np.searchsorted(distance, [threshold - NEAR_MM, threshold + NEAR_MM])
        rows = order[max(low, pick - TOGETHER) : min(high, pick + TOGETHER)]
        asked.append(Questions(rows, np.full(len(rows), threshold)))
        left -= len(rows)
    return asked


def truth(scene: HostileScene, asked: Questions, distance: Floats, doubted: Bools) -> Floats:
    """Distances from the surface, in long double where they are doubted, from the triangles that can matter."""
    found, outward = distance.copy(), scene.outward[asked.row]
    for row in np.flatnonzero(doubted):
        each = distances(scene.target, scene.target + scene.length * outward[row], scene.mesh.triangles)
        matter = each <= max(distance[row], asked.threshold[row]) + 1e-3
        triangles = scene.mesh.triangles[matter]
        found[row] = exact_distance(scene.target, outward[row], scene.length, triangles)
    return found


def prove_scene(kind: str, seed: tuple[int, int]) -> str:
    """Ask all questions of one scene; its line of the log."""
    rng = np.random.default_rng(seed)
    scene = make_scene(kind, rng, VERDICTS)
    engine, tree = FastEngine([scene.mesh]), fcl_tree(scene)
    inside = Inside(scene.mesh).holds(scene.target)
    ends = scene.target + scene.length * scene.outward
    surface = least_distances(scene.target, ends, scene.mesh.triangles)
    solid = np.zeros_like(surface) if inside else surface
    batches = far_questions(solid, rng) + near_questions(solid, rng)
    asked = Questions(*(np.concatenate(column) for column in zip(*batches, strict=True)))
    said = [product_verdicts(engine, scene, scene.outward[b.row], float(b.threshold[0])) for b in batches]
    fcl_said = fcl_verdicts(tree, scene, asked)
    return _compare(scene, asked, np.concatenate(said), fcl_said, surface[asked.row], inside, seed)


def _compare(
    scene: HostileScene,
    asked: Questions,
    said: Bools,
    fcl_said: Bools,
    surface: Floats,
    inside: bool,
    seed: tuple[int, int],
) -> str:
    """Tally one scene's verdicts, and write its line of the log."""
    doubted = (np.abs(surface - asked.threshold) < CLOSE_MM) | ((said != (surface < asked.threshold)) & ~inside)
    surface = truth(scene, asked, surface, doubted)
    gap = (np.zeros_like(surface) if inside else surface) - asked.threshold
    unlike, fcl_errs = (fcl_said | inside) != said, fcl_said != (surface < asked.threshold)
    seen = np.abs(surface - asked.threshold) > FCL_TOLERANCE_MM
    tally = Tally(
        verdicts=len(said),
        near=int((np.abs(gap) <= NEAR_MM).sum()),
        near_apart=int(((np.abs(gap) <= NEAR_MM) & (gap + asked.threshold > 0.0)).sum()),
        safe=int((~said).sum()),
        inside=len(said) * inside,
        long_double=int(doubted.sum()),
        wrong_safe=int((~said & (gap < -ROUNDING_MM)).sum()),
        wrong_too_close=int((said & (gap > ROUNDING_MM)).sum()),
        within_rounding=int((np.abs(gap) <= ROUNDING_MM).sum()),
        unlike_fcl=int((unlike & (seen | inside)).sum()),
        fcl_within_tolerance=int((unlike & ~seen & ~inside).sum()),
        fcl_wrong=int((fcl_errs & seen).sum()),
    )  # fmt: skip
    bits = hashlib.sha256(np.packbits(np.stack([said, fcl_said, gap < 0])).tobytes()).hexdigest()
    numbers = " ".join(f"{field.name}={getattr(tally, field.name)}" for field in fields(tally))
    return (
        f"{seed[1]} {scene.kind.replace(' ', '_')} triangles={len(scene.mesh.faces)} {numbers} verdicts_sha256={bits}"
    )


def tally_of(line: str) -> Tally:
    """The numbers of a log's line."""
    said = dict(word.split("=") for word in line.split()[2:])
    return Tally(**{field.name: int(said[field.name]) for field in fields(Tally)})


def read_log(path: Path) -> dict[str, Tally]:
    """What a log says, by kind of scene; nothing for a log that is not there."""
    by_kind: dict[str, Tally] = defaultdict(Tally)
    for line in path.read_text().splitlines() if path.exists() else ():
        by_kind[line.split()[1]].add(tally_of(line))
    return by_kind


def report(path: Path) -> int:
    """Print a log's sums by kind of scene, and its digest; how many "safe" are wrong."""
    by_kind, total = read_log(path), Tally()
    print("| kind | " + " | ".join(field.name.replace("_", " ") for field in fields(Tally)) + " |")
    for tally in by_kind.values():
        total.add(tally)
    for kind, tally in [*by_kind.items(), ("all", total)]:
        print(f"| {kind} | " + " | ".join(f"{getattr(tally, field.name):,}" for field in fields(Tally)) + " |")
    print(f"{total.verdicts:,} verdicts; sha256 of the log: {hashlib.sha256(path.read_bytes()).hexdigest()}")
    return total.wrong_safe


def main() -> int:
    """Run the proof, or go on where a log ends; 1 where a "safe" is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000_000, help="verdicts, at least; whole scenes")
    parser.add_argument("--seed", type=int, default=20191104)
    parser.add_argument("--log", type=Path, default=Path("long_proof.log"), help="continued where it is there")
    options = parser.parse_args()
    kinds, lines = list(KINDS), options.log.read_text().splitlines() if options.log.exists() else []
    done, number = sum(tally.verdicts for tally in read_log(options.log).values()), len(lines)
    with options.log.open("a") as log:
        while done < options.count:
            line = prove_scene(kinds[number % len(kinds)], (options.seed, number))
            log.write(line + "\n")
            log.flush()
            done, number = done + tally_of(line).verdicts, number + 1
    return 1 if report(options.log) else 0


if __name__ == "__main__":
    sys.exit(main())
