"""How long a certified map takes, against the dense grids; and a million random directions thrown at it.

python -m benchmarks.certify             times and queries of three anatomies at 0.25 degrees, and at half of that
python -m benchmarks.certify --million   a million random directions into certified cells of three anatomies
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.shared import least_seconds, options, real_ct, versions
from puncture_twin.meshes import folder
from puncture_twin.planning.case.entry import Directions, grid, outward
from puncture_twin.planning.certify.certificate import Certificate
from puncture_twin.planning.certify.checker import verify
from puncture_twin.planning.certify.subdivision import certify
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.search import organ_candidates

CHUNK = 50_000
SEED = 20190401


def times(size_deg: float, repeats: int) -> None:
    """Certify each anatomy; compare with the exact distances alone on the dense grids."""
    print(f"{versions('numba', 'numpy')}; processor time of one thread, best of {repeats}")
    print(f"fewer queries: than a {size_deg:g}-degree grid; the grid's time: of 1 degree, exact, and with its trees")
    head = "anatomy (triangles) | size, deg | map / grid (+ trees) | fewer queries | safe | undecided | really mixed"
    print(f"| {head} | map, s | grid, s (+ trees) | queries | cells |")
    print("|" + "---|" * 11)
    with tempfile.TemporaryDirectory() as temporary:
        for name, path in _anatomies(Path(temporary)).items():
            context = prepare(path, arm=False)
            for size in (size_deg, size_deg / 2):
                _row(name, context, size, size_deg, repeats)
            found = certify(context.case, context.anatomy, size=np.radians(size_deg))
            start = time.thread_time()
            print(
                f"  checked again: {verify(found, context.case, context.anatomy)}, {time.thread_time() - start:.0f} s"
            )


def _row(name: str, context: CaseContext, size_deg: float, step_deg: float, repeats: int) -> None:
    case, meshes = context.case, tuple(s.mesh for s in context.anatomy.structures)
    R, length = case.T_ct_entry[:3, :3], case.needle.length_mm
    coarse, fine = (grid(case.search.theta, case.search.beta, np.radians(step), R) for step in (1.0, step_deg))
    own = least_seconds(lambda: certify(case, context.anatomy, size=np.radians(size_deg)), repeats)
    found = certify(case, context.anatomy, size=np.radians(size_deg))
    engine = FastEngine(meshes, threads=1)
    trees = least_seconds(lambda: FastEngine(meshes, threads=1), repeats)
    dense = least_seconds(lambda: engine.measure(case.target_ct, coarse.outward_ct, length), repeats)
    fewer, triangles = 100 * (1 - found.queries / len(fine)), sum(len(mesh.faces) for mesh in meshes)
    shares = 100 * (found.fraction("S") or 0), 100 * (found.fraction("U") or 0), 100 * _mixed(context, found)
    cells = " | ".join(
        [
            f"{name} ({triangles:,})",
            f"{size_deg:g}",
            f"{own / dense:.2f} ({own / (dense + trees):.2f})",
            f"{fewer:.1f} %",
            *(f"{fraction:.2f} %" for fraction in shares),
            f"{own:.3f}",
            f"{dense:.3f} ({dense + trees:.3f})",
            f"{found.queries:,}",
            f"{len(found.leaves):,}",
        ]
    )
    print(f"| {cells} |", flush=True)


def _mixed(context: CaseContext, found: Certificate, across: int = 6) -> float:
    """Share of the cap in undecided cells that hold safe and unsafe directions: no proof can decide these."""
    cells, case = found.leaves.take(found.verdict == "U"), context.case
    at = (np.arange(across) + 0.5) / across
    theta = cells.theta[:, :1, None] + at[None, :, None] * np.diff(cells.theta)[:, :, None]
    beta = cells.beta[:, None, :1] + at[None, None, :] * np.diff(cells.beta)[:, :, None]
    angles = [np.ascontiguousarray(a).ravel() for a in np.broadcast_arrays(theta, beta)]
    outward_ct = outward(*angles) @ case.T_ct_entry[:3, :3].T
    safe = organ_candidates(case, context.anatomy, context.engine, Directions(*angles, outward_ct)).safe
    fraction = safe.reshape(len(cells), -1).mean(axis=1)
    mixed = cells.take((fraction > 0) & (fraction < 1)).solid_angle().sum()
    return float(mixed / found.question.cap().solid_angle()[0])


def million(total: int, size_deg: float) -> int:
    """Throw random directions into certified cells; returns how many contradict."""
    wrong = 0
    with tempfile.TemporaryDirectory() as temporary:
        for name, path in _anatomies(Path(temporary)).items():
            context = prepare(path, arm=False)
            found = certify(context.case, context.anatomy, size=np.radians(size_deg))
            _areas(name, found)
            wrong += _contradictions(name, context, found, total)
    return wrong


def _anatomies(temporary: Path) -> dict[str, Path]:
    cases = {"abdomen": folder() / "abdomen", "carton": folder() / "carton" / "case_m.toml"}
    return {**cases, "real CT": temporary / "case_v2.toml"} if real_ct(temporary) else cases


def _contradictions(name: str, context: CaseContext, found: Certificate, total: int) -> int:
    """Half of the directions by area, half by cell, so that the small cells at the borders get theirs."""
    rng = np.random.default_rng(SEED)
    R, start = context.case.T_ct_entry[:3, :3], time.perf_counter()
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
        rated = organ_candidates(context.case, context.anatomy, context.engine, directions)
        wrong += int(np.count_nonzero(rated.safe != (found.verdict[rows] == "S")))
    print(f"{name}: {total} directions, {wrong} contradict, {time.perf_counter() - start:.0f} s")
    return wrong


def _areas(name: str, found: Certificate) -> None:
    summary = found.summary()
    print(
        f"{name}: safe {summary['safe_square_deg']:.0f} square deg ({100 * summary['safe_share']:.2f} %), "
        f"undecided {100 * summary['undecided_share']:.2f} %, {len(found.leaves)} cells, {found.queries} queries"
    )


def main() -> int:
    """Parse, run, print."""
    arguments = options(__doc__, size=0.25, repeats=5, million=False, directions=1_000_000)
    if arguments.million:
        return 1 if million(arguments.directions, arguments.size) else 0
    times(arguments.size, arguments.repeats)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
