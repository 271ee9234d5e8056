"""How the cost of the exact search grows with triangles and with directions, drawn to docs/pictures/search-cost.png.

python benchmarks/curves.py          50k to 3M triangles at 1 degree, 1k to 2M directions, first use
python benchmarks/curves.py --quick  fewer and smaller points

Every point runs in a process of its own, so that its peak memory is its own. Times are processor time of one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # run as a script, beside the package

ROWS = (71, 100, 142, 200, 283, 400, 548)
"""Rows of the dense scene's organs: 10 x rows x rows triangles, 50k to 3M."""

DIRECTIONS = (1_000, 4_000, 16_000, 64_000, 250_000, 519_840, 1_000_000, 2_000_000)
ONE_DEGREE, FIXED_ROWS = 32_760, 283
REPEATS = 3

FIRST_USE = {
    "exact search of three directions": (
        "from puncture_twin.planning.geometry.mesh import TriangleMesh;"
        "from puncture_twin.planning.clearance.fast_engine import FastEngine;"
        "FastEngine([TriangleMesh(np.eye(3)*9,[[0,1,2]])]).measure(np.zeros(3),np.eye(3),99.)"
    ),
    "search of the carton, without the arm": (
        "from puncture_twin.planning.search.context import prepare;"
        "prepare('meshes/carton/case_m.toml',arm=False).search()"
    ),
    "certified map of the carton to 2 degrees": (
        "from puncture_twin.planning.search.context import prepare;from planning.certify import certify;"
        "p=prepare('meshes/carton/case_m.toml',arm=False);certify(p.case,p.anatomy,size=.035)"
    ),
}
"""What a person may do first, as code for a new process."""


def spiral(count: int) -> np.ndarray:
    """Evenly spread directions of a hemisphere, shape (n, 3)."""
    z = 1 - (np.arange(count) + 0.5) / count
    beta = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    aside = np.sqrt(1 - z * z)
    return np.stack([aside * np.cos(beta), aside * np.sin(beta), z], axis=1)


def point(rows: int, count: int) -> dict[str, float]:
    """Time and peak memory of one search, in this process."""
    from benchmarks.scenes import dense
    from puncture_twin.planning.clearance.fast_engine import FastEngine

    scene, rays = dense(rows), spiral(count)
    FastEngine(dense(4).meshes).measure(scene.target, rays[:50], scene.length)  # loads what is compiled
    before = _peak_mb()
    build, search = [], []
    for _ in range(REPEATS if count < 300_000 else 1):
        start = time.thread_time()
        engine = FastEngine(scene.meshes, threads=1)
        built = time.thread_time()
        engine.measure(scene.target, rays, scene.length)
        build.append(built - start)
        search.append(time.thread_time() - built)
    return {
        "triangles": scene.triangles,
        "directions": count,
        "build_s": min(build),
        "search_s": min(search),
        "before_mb": before,
        "peak_mb": _peak_mb(),
    }


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def apart(rows: int, count: int) -> dict[str, float]:
    """`point` in a new process; prints its row."""
    command = [sys.executable, __file__, "--point", str(rows), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    row: dict[str, float] = json.loads(done.stdout)
    print(
        f"| {row['triangles']:,} | {row['directions']:,} | {row['build_s']:.3f} | {row['search_s']:.3f} | "
        f"{row['before_mb']:.0f} | {row['peak_mb']:.0f} |",
        flush=True,
    )
    return row


def exponent(rows: list[dict[str, float]], across: str, along: str) -> float:
    """The slope of the line through the points in the double-logarithmic picture."""
    return float(np.polyfit(np.log([r[across] for r in rows]), np.log([r[along] for r in rows]), 1)[0])


def draw(by_triangles: list[dict[str, float]], by_directions: list[dict[str, float]], path: Path) -> None:
    """Draw both curves and the memory."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4), constrained_layout=True)
    _curve(axes[0], by_triangles, "triangles", ("search_s", "build_s"))
    axes[0].set(xlabel="triangles of five surfaces", ylabel="processor time, s", title="32,760 directions")
    _curve(axes[1], by_directions, "directions", ("search_s",))
    fixed = f"{int(by_directions[0]['triangles']):,} triangles"
    axes[1].set(xlabel="directions", ylabel="processor time, s", title=fixed)
    axes[2].semilogx(
        [r["directions"] for r in by_directions], [r["peak_mb"] for r in by_directions], "o-", label="peak"
    )
    before = [r["before_mb"] for r in by_directions]
    axes[2].semilogx([r["directions"] for r in by_directions], before, "s--", label="before the search")
    axes[2].axhline(1500, color="grey", linestyle=":", label="1.5 GB")
    axes[2].set(xlabel="directions", ylabel="memory of the process, MB", title=fixed, ylim=(0, 1600))
    for axis in axes:
        axis.grid(visible=True, which="major", alpha=0.4)
        axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _curve(axis: Any, rows: list[dict[str, float]], across: str, columns: tuple[str, ...]) -> None:
    names = {"search_s": "search", "build_s": "building the trees"}
    for column in columns:
        slope = exponent(rows, across, column)
        label = f"{names[column]}, exponent {slope:.2f}"
        axis.loglog([r[across] for r in rows], [r[column] for r in rows], "o-", label=label)


def first_use() -> None:
    """Print how long a first use takes with nothing compiled, and how long once it is."""
    print("\n| first use | nothing compiled, s | compiled before, s |\n|---|---|---|")
    for name, code in FIRST_USE.items():
        with tempfile.TemporaryDirectory() as cache:
            environment = os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(REPOSITORY)}
            seconds = []
            for _ in range(2):
                start = time.perf_counter()
                command = [sys.executable, "-c", f"import numpy as np;{code}"]
                subprocess.run(command, env=environment, cwd=REPOSITORY, capture_output=True, check=True)
                seconds.append(time.perf_counter() - start)
        print(f"| {name} | {seconds[0]:.1f} | {seconds[1]:.1f} |", flush=True)


def main() -> None:
    """Parse, measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer and smaller points")
    parser.add_argument("--point", type=int, nargs=2, metavar=("ROWS", "DIRECTIONS"), help="one point, as JSON")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs" / "pictures" / "search-cost.png")
    chosen = parser.parse_args()
    if chosen.point:
        print(json.dumps(point(*chosen.point)))
        return
    rows, counts = (ROWS[:4], DIRECTIONS[:4]) if chosen.quick else (ROWS, DIRECTIONS)
    print("| triangles | directions | building, s | search, s | before, MB | peak, MB |\n|---|---|---|---|---|---|")
    by_triangles = [apart(row, ONE_DEGREE) for row in rows]
    by_directions = [apart(FIXED_ROWS, count) for count in counts]
    for name, points, across in (("triangles", by_triangles, "triangles"), ("directions", by_directions, "directions")):
        print(f"search grows with {name} to the power {exponent(points, across, 'search_s'):.2f}")
    draw(by_triangles, by_directions, chosen.out)
    first_use()


if __name__ == "__main__":
    main()
