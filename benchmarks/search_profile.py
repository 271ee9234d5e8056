"""Where the exact search spends its time: what it counts, times what each step costs in a tight loop."""

from __future__ import annotations

import time

import numba as nb
import numpy as np

from benchmarks.scenes import Scene
from benchmarks.timing import least_seconds
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.kernels.bounds import disc_bounds, line_distances
from puncture_twin.planning.clearance.kernels.lanes import LANES, bare
from puncture_twin.planning.clearance.kernels.side_by_side import ROWS, bring_into_frame, measure_beside
from puncture_twin.planning.clearance.kernels.tile_search import COUNTED

TURNS = 300_000
REPEATS = 7

Single = np.float32
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
X32, Y32, Z32 = (tuple(Single(x) for x in axis) for axis in (X, Y, Z))


@nb.njit(error_model="numpy")
def _discs(nodes, bounds, turns):
    nodes, bounds = bare(nodes), bare(bounds)
    for i in range(turns):
        disc_bounds(nodes, i & 31, Z32, Single(0.03), Single(210), Single(1e-4), bounds, i & 31)


@nb.njit(error_model="numpy")
def _blocks(local, squares, turns):
    local, squares = bare(local), bare(squares)
    for i in range(turns):
        line_distances(local, i & 31, X32, Y32, Single(3), Single(2), Single(-1e-3), squares, i & 31)


@nb.njit(error_model="numpy")
def _triangles(triangles, pairs, turns):
    triangles, pairs = bare(triangles), bare(pairs)
    for i in range(0, turns, 16):
        for k in range(16):
            pairs[11, k] = 210.0
            bring_into_frame(Z, X, Y, triangles, (i + k) & 255, (0.0, 0.0, 0.0), pairs, k)
        measure_beside(pairs, 16)


def unit_costs() -> tuple[float, float, float]:
    """Seconds for the bounds of 16 discs, for a block of 16 triangles in float32, and for one triangle in float64."""
    rng = np.random.default_rng(0)
    nodes = np.abs(rng.normal(0, 3, (32, 10, LANES))).astype(Single)
    local = rng.normal(0, 3, (32, 9, LANES)).astype(Single)
    beside = rng.normal(0, 1, (256, 9)) + np.tile([30.0, 5.0, 40.0], 3)
    bounds, squares = np.empty((32, LANES), Single), np.empty((32, LANES), Single)
    return (
        least_seconds(lambda: _discs(nodes, bounds, TURNS), REPEATS) / TURNS,
        least_seconds(lambda: _blocks(local, squares, TURNS), REPEATS) / TURNS,
        least_seconds(lambda: _triangles(beside, np.empty((ROWS, 24)), TURNS), REPEATS) / TURNS,
    )


def profile(scene: Scene, step_deg: float) -> None:
    """Print what the search of one scene counts per answer, and how its time divides."""
    directions, engine = scene.hemisphere(step_deg), FastEngine(scene.meshes, threads=1)
    took = min(_search(engine, scene, directions) for _ in range(3))
    counts = dict(zip(COUNTED, engine.counts / 3, strict=True))
    answers = len(directions) * len(scene.meshes)
    disc, block, triangle = unit_costs()
    per_answer = ", ".join(f"{name} {count / answers:.2f}" for name, count in counts.items())
    print(f"{scene.name}: {took / answers * 1e9:.0f} ns per answer; per answer: {per_answer}")
    shares = {
        "walk (discs of the tree)": counts["nodes"] * disc,
        "filter (discs per direction)": counts["filters"] * disc,
        "blocks in float32": counts["block tests"] * block,
        "triangles in float64": counts["triangle tests"] * triangle,
    }
    named = ", ".join(f"{name} {100 * cost / took:.0f} %" for name, cost in shares.items())
    print(f"    {named}, between these {100 * (1 - sum(shares.values()) / took):.0f} %")
    print(
        f"    one step of each: {disc * 1e9:.0f}, {block * 1e9:.0f}, {triangle * 1e9:.0f} ns (discs, block, triangle)"
    )


def _search(engine: FastEngine, scene: Scene, directions: np.ndarray) -> float:
    """Seconds on the processor for one search."""
    start = time.thread_time()
    engine.measure(scene.target, directions, scene.length)
    return time.thread_time() - start
