"""How long a certified map takes, against the dense grids; and a million random directions thrown at it.

python benchmarks/certify.py             times and queries for the abdomen at 0.25 degrees
python benchmarks/certify.py --million   a million random directions into certified cells of three anatomies
"""

from __future__ import annotations

import argparse
import platform
import shutil
import tempfile
import time
from pathlib import Path

import numba
import numpy as np

from meshes import folder
from planning.certify import Certificate, certify, verify
from planning.entry import Directions, grid, outward
from planning.prepared import Prepared, prepare
from planning.search import organ_candidates

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = REPOSITORY.parent / "shared" / "data" / "totalseg_abdomen_3mm"
CHUNK = 50_000
SEED = 20190401


def times(size_deg: float, repeats: int) -> None:
    """Certify the abdomen; compare with the distances alone on the dense grids."""
    prepared = prepare(folder() / "abdomen", arm=False)
    case, engine = prepared.case, prepared.engine
    print(
        f"{platform.machine()}, Python {platform.python_version()}, numba {numba.__version__}, numpy {np.__version__}"
    )
    print(f"engine {type(engine).__name__}; median of {repeats}, first run (compiling) left out")
    size = np.radians(size_deg)
    own = _median(lambda: certify(case, prepared.anatomy, size=size), repeats)
    found = certify(case, prepared.anatomy, size=size)
    print(f"certified to {size_deg:g} deg    {own:8.3f} s, {found.queries} queries")
    for step_deg in (1.0, size_deg):
        directions = grid(case.search.theta, case.search.beta, np.radians(step_deg), case.T_ct_entry[:3, :3])
        rays = directions.outward_ct
        if len(rays) > CHUNK and type(engine).__name__ == "FclEngine":
            print(f"dense {step_deg:g} deg grid    not timed with FCL, {len(rays)} queries")
            continue
        dense = _median(lambda rays=rays: engine.measure(case.target_ct, rays, case.needle.length_mm), repeats)
        fewer = 100 * (1 - found.queries / len(rays))
        line = f"dense {step_deg:g} deg grid    {dense:8.3f} s (distances alone), {len(rays)} queries"
        print(f"{line}; the map takes {own / dense:.2f} of that time and {fewer:.1f} % fewer queries")
    _areas("abdomen", found)
    start = time.perf_counter()
    print(f"checked again: {verify(found, case, prepared.anatomy)} in {time.perf_counter() - start:.1f} s")


def million(total: int, size_deg: float) -> int:
    """Throw random directions into certified cells; returns how many contradict."""
    wrong = 0
    with tempfile.TemporaryDirectory() as temporary:
        for name, path in _anatomies(Path(temporary)).items():
            prepared = prepare(path, arm=False)
            found = certify(prepared.case, prepared.anatomy, size=np.radians(size_deg))
            _areas(name, found)
            wrong += _contradictions(name, prepared, found, total)
    return wrong


def _anatomies(temporary: Path) -> dict[str, Path]:
    cases = {"abdomen": folder() / "abdomen", "carton": folder() / "carton" / "case_m.toml"}
    if not DATA.is_dir():
        print(f"the real CT is not on this machine ({DATA.name}): two anatomies only")
        return cases
    for file in (REPOSITORY / "tests" / "real").iterdir():
        shutil.copy(file, temporary)
    for file in DATA.glob("*.nii.gz"):
        (temporary / file.name).symlink_to(file)
    return {**cases, "real CT": temporary / "case_v2.toml"}


def _contradictions(name: str, prepared: Prepared, found: Certificate, total: int) -> int:
    """Half of the directions by area, half by cell, so that the small cells at the borders get theirs."""
    rng = np.random.default_rng(SEED)
    R, start = prepared.case.T_ct_entry[:3, :3], time.perf_counter()
    certified = np.flatnonzero(found.verdict != "U")
    area = found.leaves.take(certified).solid_angle()
    wrong = 0
    for first in range(0, total, CHUNK):
        count = min(CHUNK, total - first)
        by_area = rng.choice(certified, count // 2, p=area / area.sum())
        rows = np.concatenate([by_area, rng.choice(certified, count - count // 2)])
        cells = found.leaves.take(rows)
        top, bottom = np.cos(cells.theta).T
        height = bottom + (top - bottom) * rng.random(count)
        theta, beta = np.arccos(np.clip(height, -1, 1)), rng.uniform(*cells.beta.T)
        directions = Directions(theta, beta, outward(theta, beta) @ R.T)
        judged = organ_candidates(prepared.case, prepared.anatomy, prepared.engine, directions)
        wrong += int(np.count_nonzero(judged.safe != (found.verdict[rows] == "S")))
    print(f"{name}: {total} directions, {wrong} contradict, {time.perf_counter() - start:.0f} s")
    return wrong


def _areas(name: str, found: Certificate) -> None:
    summary = found.summary()
    print(
        f"{name}: safe {summary['safe_square_deg']:.0f} square deg ({100 * summary['safe_share']:.2f} %), "
        f"undecided {100 * summary['undecided_share']:.2f} %, {len(found.leaves)} cells, {found.queries} queries"
    )


def _median(work: object, repeats: int) -> float:
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        work()  # type: ignore[operator]  # a function without arguments
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds[1:]))


def main() -> int:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=float, default=0.25, help="angular size, degrees")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--million", action="store_true", help="throw random directions into certified cells")
    parser.add_argument("--directions", type=int, default=1_000_000, help="how many for each anatomy")
    arguments = parser.parse_args()
    if arguments.million:
        return 1 if million(arguments.directions, arguments.size) else 0
    times(arguments.size, arguments.repeats)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
