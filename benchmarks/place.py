"""Where to stand the arm: published shares and windows beside ours, and the search: how long, and how well it guesses.

    python benchmarks/place.py [--quick] [--jobs N]

Seconds are CPU seconds of this process and its children, so that other work on the machine counts little.
"""

import argparse
import resource
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, beside the package

from benchmarks.chen2019_reach import AGAINST_Z, SHARES, TOWARD_AXIS, WINDOWS, cap, held_share, our_share, our_windows
from puncture_twin.meshes import folder
from puncture_twin.planning.case.read_case import load_case
from puncture_twin.planning.place.mounts import Region, Site
from puncture_twin.planning.place.search import search_placements
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates

AXIS_WORDS = {AGAINST_Z: "base -z", TOWARD_AXIS: "to base axis"}
LESION_M_CT = np.array([50.0, 130.0, 63.0])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the published numbers alone")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--case", type=Path, default=folder() / "abdomen")
    arguments = parser.parse_args()
    shares()
    windows()
    if not arguments.quick:
        best_positions()
        search(arguments.case, arguments.jobs)


def shares() -> None:
    """Specification 1, section 2: the table, at its own positions."""
    print("r + l  rho   z    cap axis       published  ours   (share of the 60 deg cap, UR3, no collisions)")
    for row in SHARES:
        ours = our_share(row)
        numbers = f"{100 * row.share:6.0f} %  {100 * ours:5.1f} %   {100 * (ours - row.share):+.1f}"
        print(
            f"{row.distance_mm:5.0f} {row.rho_mm:4.0f} {row.z_mm:4.0f}  {AXIS_WORDS[row.cap_axis_base]:13s}  {numbers}"
        )


def windows() -> None:
    """The same section: what the paper's own placement reaches."""
    placed = load_placement(load_case(folder() / "carton" / "case_m.toml"))
    print("theta  published beta windows      ours                        worst difference, deg")
    for theta, published in WINDOWS.items():
        ours = our_windows(placed.T_base_ct, LESION_M_CT, theta)
        worst = np.abs(np.subtract(ours, published)).max() if len(ours) == len(published) and ours else 0
        same = "" if len(ours) == len(published) else "  OTHER NUMBER OF WINDOWS"
        print(f"{theta:5d}  {_words(published):26s}  {_words(ours):26s}  {worst}{same}")


def _words(some: tuple[tuple[int, int], ...]) -> str:
    return ", ".join(f"{a}-{b}" for a, b in some) or "nothing"


def best_positions() -> None:
    """The best positions of a 50 mm lattice: how near the published positions come to them."""
    print("r + l  cap axis       best share of a 50 mm lattice, at rho, z")
    for distance in (551.0, 451.0, 401.0, 300.0):
        for axis in (AGAINST_Z, TOWARD_AXIS):
            middle = np.array([0.0, 0.0, 1.0]) if axis == AGAINST_Z else np.array([1.0, 0.0, 0.0])
            directions, found = cap(middle, 800), []
            for rho in np.arange(50.0, 701.0, 50.0):
                for z in np.arange(-300.0, 901.0, 50.0):
                    region = Region("ceiling", "", (0, 0, -1), (0.0,) * 3, (0.0,) * 3)
                    T = np.linalg.inv(Site(region, (rho, 0.0, z)).T_bed_base())
                    found.append((held_share(T[:3, 3], directions @ T[:3, :3].T, distance), rho, z))
            fraction, rho, z = max(found)
            print(f"{distance:5.0f}  {AXIS_WORDS[axis]:13s}  {100 * fraction:5.1f} %  at {rho:.0f}, {z:.0f}")


def search(path: Path, jobs: int) -> None:
    """The whole search on a case: seconds, and what was estimated beside what was judged."""
    context = prepare(path, arm=False)
    found = organ_candidates(context.case, context.anatomy, context.engine, context.case.directions())
    begin, cpu = perf_counter(), _cpu()
    done = search_placements(context.case, context.anatomy, found, context.placement, jobs=jobs)
    spent = f"{perf_counter() - begin:.1f} s, CPU {_cpu() - cpu:.1f} s"
    print(
        f"{context.case.name}: {len(done.coarse)} + {done.refined} sites estimated, {len(done.rated)} judged over"
        f" {int(found.safe.sum())} directions, {jobs} processes: {spent}"
    )
    print(f"possible {100 * done.possible:.1f} %; share % estimated and judged:")
    for one in done.rated:
        print(f"  {one.name:18s} {100 * one.estimate.fraction:5.1f}  {100 * one.verdict.fraction:5.1f}")


def _cpu() -> float:
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)


if __name__ == "__main__":
    main()
