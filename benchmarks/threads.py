"""What a second thread brings to the exact search: ``python -m benchmarks.threads``.

One thread and two take turns, beside a control that needs no memory: the same loop of arithmetic once, and twice on
two threads. Where the control gains less than twofold, the machine has not got two free cores. Seconds by the clock.
"""

from __future__ import annotations

import argparse
import hashlib
import os
from collections.abc import Callable
from statistics import median
from time import perf_counter

import numba as nb

from benchmarks.scenes import Scene, scenes
from puncture_twin.planning.base.processes import on_threads
from puncture_twin.planning.clearance.fast_engine import FastEngine

TURNS = 150_000_000
"""Some tenths of a second."""


@nb.njit(nogil=True)
def _arithmetic(turns):
    total = 1.0
    for k in range(turns):
        total = total * 0.999999 + k
    return total


def seconds(work: Callable[[], object]) -> float:
    """By the clock."""
    start = perf_counter()
    work()
    return perf_counter() - start


def control_gain() -> float:
    """How much sooner two threads do two pieces of arithmetic than one."""

    def twice(threads: int) -> None:
        for _ in on_threads(lambda _: _arithmetic(TURNS), 2, threads):
            pass

    return seconds(lambda: twice(1)) / seconds(lambda: twice(2))


def bytes_of(engine: FastEngine, scene: Scene, step_deg: float) -> str:
    """Hash of all answers."""
    found = engine.measure(scene.target, scene.hemisphere(step_deg), scene.length)
    parts = (found.distance, found.depth, found.nearest)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def compare(scene: Scene, step_deg: float, rounds: int) -> None:
    """Print the medians of rounds in which one thread, two threads and the control take turns."""
    directions = scene.hemisphere(step_deg)
    engines = [FastEngine(scene.meshes, threads=threads) for threads in (1, 2)]
    same = len({bytes_of(engine, scene, step_deg) for engine in engines}) == 1
    _arithmetic(1)
    times: list[tuple[float, float]] = []
    controls = []
    for _ in range(rounds):
        one, two = (seconds(lambda e=e: e.measure(scene.target, directions, scene.length)) for e in engines)
        times.append((one, two))
        controls.append(control_gain())
    gains = [one / two for one, two in times]
    one, two = (median(column) for column in zip(*times, strict=True))
    cells = (
        f"{scene.name} ({scene.triangles / 1000:.0f}k, {len(scene.meshes)})",
        *(f"{one:.3f} s", f"{two:.3f} s", f"{median(gains):.2f}", f"{median(controls):.2f}"),
        "yes" if same else "NO",
    )
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--step", type=float, default=1.0, help="degrees")
    parser.add_argument("--rounds", type=int, default=9)
    chosen = parser.parse_args()
    print(f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors\n")
    print("| scene (triangles, surfaces) | one thread | two | gain | control | same bytes |\n|---|---|---|---|---|---|")
    for scene in scenes():
        compare(scene, chosen.step, chosen.rounds)


if __name__ == "__main__":
    main()
