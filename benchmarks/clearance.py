"""The fast clearance engine beside its peers, on one machine, in one run: ``python benchmarks/clearance.py``."""

from __future__ import annotations

import argparse
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import fcl
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, beside the package

from benchmarks import peers
from benchmarks.proof import prove
from benchmarks.scenes import Scene, dense, scenes
from benchmarks.search_profile import profile
from planning.clearance.fast_engine import FastEngine
from planning.clearance.fcl_engine import FclEngine

CAP_MM = 20.0
SAMPLE, QUICK_SAMPLE = 300, 60
REPEATS = 3


def best(work, repeats: int = REPEATS) -> float:
    """Least time of one thread on the processor of a few runs, s: others share the machine; both sides alike."""
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return min(times)


def measure_scene(scene: Scene, sample: int, step_deg: float) -> None:
    """Print one scene's rows."""
    directions = scene.hemisphere(step_deg)
    some = directions[np.random.default_rng(1).choice(len(directions), min(sample, len(directions)), replace=False)]
    scale, ask = len(directions) / len(some), (scene.target, directions, scene.length)
    build = best(lambda: FastEngine(scene.meshes))
    engine = FastEngine(scene.meshes)
    engine.measure(scene.target, some, scene.length)
    exact = best(lambda: engine.measure(*ask))
    capped = best(lambda: engine.measure_capped(*ask, CAP_MM))
    engine.nearer_than(
        scene.target, directions, scene.length, scene.thresholds
    )  # FCL's trees, where a tie asks for one
    verdict = best(lambda: engine.nearer_than(*ask, scene.thresholds))
    fcl_build = best(lambda: FclEngine(scene.meshes), 1)
    judge = FclEngine(scene.meshes)
    segment = best(lambda: judge.measure(scene.target, some, scene.length), 2) * scale
    capsule = peers.fcl_capsule_distance(scene, some) * scale
    collide = peers.fcl_collide(scene, some) * scale
    sizes = f"{scene.triangles:,} triangles, {len(scene.meshes)} surfaces, {len(directions):,} directions"
    print(f"\n## {scene.name}: {sizes}")
    print("| ratio | search alone | end to end, building included |\n|---|---|---|")
    for name, theirs in (("FCL distance, capsule", capsule), ("FCL distance, degenerate triangle", segment)):
        print(f"| {name} / ours, exact | {theirs / exact:.0f}x | {(theirs + fcl_build) / (exact + build):.0f}x |")
    print(
        f"| FCL distance, capsule / ours, capped at {CAP_MM:g} mm | {capsule / capped:.0f}x | "
        f"{(capsule + fcl_build) / (capped + build):.0f}x |"
    )
    both = (collide + fcl_build) / (verdict + build)
    print(f"| FCL collide / ours, verdicts | {collide / verdict:.1f}x | {both:.1f}x |")
    print(
        f"seconds: build {build:.3f}, exact {exact:.3f}, capped {capped:.3f}, verdicts {verdict:.3f}; FCL build "
        f"{fcl_build:.2f}, capsule {capsule:.1f}, segment {segment:.1f}, collide {collide:.1f} "
        f"(FCL on {len(some)} random directions, scaled)"
    )
    peers.optional(scene, some)


def compile_times() -> None:
    """Print the time of a first and a second small search in a fresh process with an empty cache."""
    script = (
        "import time,sys;t=time.perf_counter();import numpy as np;from planning.mesh import TriangleMesh;"
        "from planning.clearance.fast_engine import FastEngine;"
        "m=TriangleMesh(np.eye(3)*9,[[0,1,2]]);a=time.perf_counter();"
        "FastEngine([m]).measure(np.zeros(3),np.eye(3),99.);print(f'{a-t:.2f} {time.perf_counter()-a:.2f}')"
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
    directions, engine = scene.hemisphere(step_deg), FastEngine(scene.meshes)
    start = time.perf_counter()
    engine.measure(scene.target, directions, scene.length)
    took = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{step_deg:g} degree, {len(directions):,} directions, {scene.name}: {took:.2f} s, "
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
