"""The fast clearance engine beside its peers, on one machine, in one run: ``python benchmarks/clearance.py``."""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import fcl
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, beside the package

from benchmarks import peers
from benchmarks.proof import prove
from benchmarks.scenes import Scene, dense, scenes
from benchmarks.search_profile import profile
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.fcl_engine import FclEngine

SAMPLE, QUICK_SAMPLE = 300, 60
ROUNDS = 6


def took(work: Callable[[], object]) -> float:
    """Time of one thread on the processor, s: others share the machine."""
    start = time.thread_time()
    work()
    return time.thread_time() - start


def rounds(scene: Scene, directions: np.ndarray, sample: int, kept: Cache) -> dict[str, float]:
    """Seconds of everybody for all directions, means over rounds in which all take their turn.

    Building again finds the order of the triangles in ``kept``, as a second search of the same surfaces does.

    FCL is asked for another part of a random sample in each round, and its time scaled to all directions. So a
    neighbour who comes or goes in between slows both sides alike. Only `FclEngine` is asked once for all of it: each of
    its calls prepares the depths of crossings for whole surfaces.
    """
    chosen = np.random.default_rng(1).choice(len(directions), min(sample, len(directions)), replace=False)
    engine, judge, objects = FastEngine(scene.meshes, threads=1), FclEngine(scene.meshes), peers.trees(scene)
    ask = (scene.target, directions, scene.length)
    engine.measure(*ask)
    FastEngine(scene.meshes, cache=kept, threads=1)
    sums: dict[str, float] = {}
    for part in np.array_split(directions[chosen], ROUNDS):
        scale = len(directions) / len(part)
        times = {
            "build": took(lambda: FastEngine(scene.meshes, threads=1)),
            "build again": took(lambda: FastEngine(scene.meshes, cache=kept, threads=1)),
            "exact": took(lambda: engine.measure(*ask)),
            "FCL build": took(lambda: FclEngine(scene.meshes)),
            "FCL capsule": peers.fcl_capsule_distance(scene, part, objects) * scale,
            "FCL collide": peers.fcl_collide(scene, part, objects) * scale,
        }
        sums = {name: sums.get(name, 0.0) + seconds / ROUNDS for name, seconds in times.items()}
    judge.measure(scene.target, directions[chosen[:1]], scene.length)  # compiled, and warm
    whole = took(lambda: judge.measure(scene.target, directions[chosen], scene.length))
    return {**sums, "FCL triangle": whole * len(directions) / len(chosen)}


def measure_scene(scene: Scene, sample: int, step_deg: float) -> None:
    """Print one scene's rows."""
    directions = scene.hemisphere(step_deg)
    with tempfile.TemporaryDirectory() as folder:
        s = rounds(scene, directions, sample, Cache(Path(folder)))
    sizes = f"{scene.triangles:,} triangles, {len(scene.meshes)} surfaces, {len(directions):,} directions"
    print(f"\n## {scene.name}: {sizes}")
    print("| ratio | search alone | end to end, building included |\n|---|---|---|")
    for label, theirs, ours in (
        ("FCL distance, capsule / ours, exact", "FCL capsule", "exact"),
        ("FCL distance, degenerate triangle / ours, exact", "FCL triangle", "exact"),
        ("FCL collide (hit or not) / ours, exact", "FCL collide", "exact"),
    ):
        both = (s[theirs] + s["FCL build"]) / (s[ours] + s["build"])
        print(f"| {label} | {s[theirs] / s[ours]:.0f}x | {both:.0f}x |")
    seconds = ", ".join(f"{name} {mean:.3f}" for name, mean in s.items())
    print(f"seconds, mean of {ROUNDS} rounds: {seconds} (FCL on {sample} random directions in all, scaled)")
    peers.optional(scene, directions[:: max(1, len(directions) // sample)])


def compile_times() -> None:
    """Print the time of a first and a second small search in a fresh process with an empty cache."""
    script = (
        "import time,sys;t=time.perf_counter();import numpy as np;"
        "from puncture_twin.planning.geometry.mesh import TriangleMesh;"
        "from puncture_twin.planning.clearance.fast_engine import FastEngine;"
        "m=TriangleMesh(np.eye(3)*9,[[0,1,2]]);a=time.perf_counter();"
        "FastEngine([m], threads=1).measure(np.zeros(3),np.eye(3),99.);print(f'{a-t:.2f} {time.perf_counter()-a:.2f}')"
    )
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}
        for name in ("cold (nothing compiled)", "warm (compiled before)"):
            run = subprocess.run(
                [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
            )
            imports, first = run.stdout.split()
            print(f"first use, {name}: imports {imports} s, smallest search {first} s")


def large(step_deg: float) -> None:
    """Print time and peak memory of a fine grid on the phantom."""
    scene = next(scenes())
    directions, engine = scene.hemisphere(step_deg), FastEngine(scene.meshes, threads=1)
    start = time.perf_counter()
    engine.measure(scene.target, directions, scene.length)
    seconds = time.perf_counter() - start
    peak = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1024  # this program's alone
    print(
        f"{step_deg:g} degree, {len(directions):,} directions, {scene.name}: {seconds:.2f} s, "
        f"peak memory of the process {peak:.0f} MB"
    )


def header() -> None:
    """Print where and with what this ran."""
    names = ("numpy", "numba", "llvmlite", "python-fcl", "trimesh", "embreex", "coal", "vtk")
    for name in names:
        try:
            print(f"{name} {version(name)}", end="; ")
        except PackageNotFoundError:
            print(f"{name} not installed", end="; ")
    model = [
        line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line
    ]
    print(f"Python {platform.python_version()}; {model[0]}, {len(model)} cores, one used; fcl {fcl.__version__}")


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a coarser grid and fewer FCL queries")
    parser.add_argument("--proof", action="store_true", help="every verdict of the 1-degree grid against FCL instead")
    parser.add_argument("--profile", action="store_true", help="where the exact search spends its time instead")
    parser.add_argument("--fine", type=float, help="only time and peak memory at this step, degrees")
    parser.add_argument("--scene", default="", help="only scenes whose name holds this")
    parser.add_argument("--step", type=float, default=1.0, help="of the grid, degrees")
    chosen = parser.parse_args()
    header()

    def asked(scene: Scene) -> bool:
        return chosen.scene in scene.name

    if chosen.fine:
        large(chosen.fine)
        return
    if chosen.profile:
        for scene in filter(asked, scenes()):
            profile(scene, chosen.step)
        return
    if chosen.proof:
        answers = [prove(scene, chosen.step) for scene in filter(asked, scenes()) if scene.name != dense().name]
        sys.exit(0 if all(answers) else 1)
    for scene in filter(asked, scenes()):
        measure_scene(scene, QUICK_SAMPLE if chosen.quick else SAMPLE, 4.0 if chosen.quick else chosen.step)
    compile_times()
    if not chosen.quick:
        subprocess.run([sys.executable, __file__, "--fine", "0.25"], check=True)


if __name__ == "__main__":
    main()
