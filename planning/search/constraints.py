"""The constraints that reject a candidate, in the order in which its reason is given: organs and skin, then the arm.

`first_broken` checks skin and organs of all candidates at once, `with_reach` the arm for those that they leave.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.skin import SkinPaths
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.arm.insertion import ReachRequest
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import AngleGrid, outward
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.clearance.engine import MeasuredClearances
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.reach.reach import ReachAnswer, assess_reach_all
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.candidates import ARM_CHECKED, CONE_OF_GRID, ArmColumns, Candidates, Verdict

Column = NDArray[Any] | str | float

SKIN = "skin"
"""The skin's name in the reasons."""


def first_broken(
    paths: SkinPaths,
    clearances: MeasuredClearances,
    structures: tuple[Structure, ...],
    *,
    needle: Needle,
    max_skin_angle: float,
) -> Verdict:
    """Verdict of n candidates for skin and organs: each one's reason is the first constraint that it breaks.

    The order is that of the ``reject`` calls. Unscanned regions come first: nothing behind them is known. Structures
    come last: some matter only to a tip that waits at its standoff, so only on paths that satisfy the others.
    """
    count = len(paths.path_length)
    reasons, names_of, details = (np.full(count, "", dtype=object) for _ in range(3))
    depths, amounts = np.full(count, np.nan), np.full(count, np.nan)
    unset = np.ones(count, bool)

    def reject(reason: Reason, where: Bools, names: Column, depth: Column, amount: Column = np.nan) -> None:
        rows = np.flatnonzero(where & unset)  # a row that has a reason already is not changed
        unset[rows] = False
        reasons[rows] = reason.value
        columns: tuple[tuple[NDArray[Any], Column], ...]
        columns = ((names_of, names), (depths, depth), (amounts, amount))
        for column, value in columns:
            column[rows] = value[rows] if isinstance(value, np.ndarray) else value

    length, worst = paths.path_length, worst_violation(clearances, structures)
    reject(Reason.UNKNOWN_REGION, ~np.isnan(paths.unknown_depth), SKIN, paths.unknown_depth)
    reject(Reason.NO_SKIN_ENTRY, np.isnan(length), SKIN, np.nan)
    reject(Reason.REENTERS_SKIN, ~np.isnan(paths.reentry_depth), SKIN, paths.reentry_depth)
    reject(Reason.TOO_LONG, length > needle.longest_path_mm, SKIN, length, length)
    reject(Reason.SKIN_ANGLE, paths.skin_angle > max_skin_angle, SKIN, length, np.degrees(paths.skin_angle))
    names = np.array([s.name for s in structures] or [""], dtype=object)[worst]
    unknown = np.array([s.role is Role.UNKNOWN for s in structures] or [False])[worst]
    rows = np.arange(count)
    if structures:
        broken = np.asarray(clearances.violated.any(axis=1))
        depth, amount = clearances.depth[rows, worst], clearances.clearance[rows, worst]
        reject(Reason.UNKNOWN_REGION, broken & unknown, names, depth, amount)
        reject(Reason.TOO_CLOSE, broken, names, depth, amount)
    return Verdict(reasons, names_of, depths, amounts, details)


def skin_allows(paths: SkinPaths, needle: Needle, max_skin_angle: float) -> Bools:
    """Which paths break no constraint of the skin, shape (n,), whatever structures do; ``max_skin_angle`` in rad."""
    none = np.empty((len(paths.path_length), 0))
    nothing = MeasuredClearances(none, none, none.astype(bool))
    return first_broken(paths, nothing, (), needle=needle, max_skin_angle=max_skin_angle).safe


def worst_violation(clearances: MeasuredClearances, structures: tuple[Structure, ...]) -> NDArray[np.int64]:
    """Column of the structure whose margin is violated by most, shape (n,); 0 where none is.

    Of equal violations that at the least depth counts.
    """
    count = len(clearances.clearance)
    worst, most, reached = np.zeros(count, np.int64), np.full(count, -np.inf), np.full(count, np.inf)
    for column, structure in enumerate(structures):
        rows = np.flatnonzero(clearances.violated[:, column])
        lack, depth = structure.margin_mm - clearances.clearance[rows, column], clearances.depth[rows, column]
        more = (lack > most[rows]) | ((lack == most[rows]) & (depth < reached[rows]))
        rows = rows[more]
        worst[rows], most[rows], reached[rows] = column, lack[more], depth[more]
    return worst


DIAGONAL = np.sqrt(2.0)
"""Diagonal of a cell, in steps, at the equator; nearer to the poles cells are narrower."""


def with_grid_cone(candidates: Candidates, grid: AngleGrid) -> Candidates:
    """The candidates of a grid with the safe cone of each safe one."""
    cone = np.full(len(candidates), np.nan)
    cone[candidates.safe] = grid_cone(grid, candidates.safe)
    return replace(candidates, safe_cone=cone, cone_source=CONE_OF_GRID)


def grid_cone(grid: AngleGrid, safe: Bools) -> Floats:
    """Safe cone of each safe direction: how far it may be off in any direction, shape (safe ones,), rad.

    The angle to the nearest direction of the grid that is not safe, or to the nearest beyond the grid, less a cell's
    diagonal. A disc as wide as that diagonal holds a direction of the grid; so where such a disc fits into what is not
    safe, at its border, the cone ends before it. What is thinner may pass between the directions: only a
    certificate excludes that.

    Args:
        safe: Shape (n,), row by row.
    """
    theta, beta = np.repeat(grid.theta, len(grid.beta)), np.tile(grid.beta, len(grid.theta))
    border = _border(grid, safe)
    barred = np.concatenate([outward(theta[border], beta[border]), outward(*grid.beyond())])
    if not len(barred):
        return np.full(int(safe.sum()), np.pi)
    chord = np.empty(int(safe.sum()))
    _least_chords(outward(theta[safe], beta[safe]), barred, chord)
    return np.maximum(2 * np.arcsin(np.clip(chord / 2, 0.0, 1.0)) - DIAGONAL * grid.step, 0.0)


def _border(grid: AngleGrid, safe: Bools) -> Bools:
    """Unsafe directions next to a safe one, or at the grid's end: among them is one nearest to any safe direction.

    They are not safe themselves, and lie next to a safe one or at an end of the azimuths. From any other, the step
    towards the safe one, first in azimuth the shorter way and then in θ, stays in the grid and ends nearer (at a pole
    in the same direction) in one that is not safe either.
    """
    pairs = grid.neighbours()
    ends = pairs[safe[pairs[:, 0]] != safe[pairs[:, 1]]].ravel()
    border = np.zeros((len(grid.theta), len(grid.beta)), bool)
    border.ravel()[ends] = True
    if not grid.full_circle:
        border[:, [0, -1]] = True
    return np.asarray(border.ravel() & ~safe)


@allocation_free()
def _least_chords(points, others, chords):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``chords`` (n,) with the distance of each point (n, 3) from the nearest of the others (m, 3)."""
    for i in range(len(points)):
        least = np.inf
        for k in range(len(others)):
            x, y, z = points[i, 0] - others[k, 0], points[i, 1] - others[k, 1], points[i, 2] - others[k, 2]
            least = min(least, x * x + y * y + z * z)
        chords[i] = np.sqrt(least)


def closest_miss(candidates: Candidates) -> int | None:
    """Row of the rejected candidate that came closest to being safe, for the report; None without candidates.

    First one that is safe for the organs, rejected by the latest constraint possible; else the one whose clearance is
    least below its margin; else one rejected by skin or path.
    """
    late = (Reason.TOUCH_LIKELY, Reason.HIT_UNLIKELY, Reason.UNSAFE_WHEN_BREATHING, Reason.NEEDLE_BENDS)
    of_arm = (Reason.APPROACH_NOT_FOUND, Reason.INSERTION_BLOCKED, Reason.ARM_COLLISION, Reason.UNREACHABLE)
    of_skin = (Reason.SKIN_ANGLE, Reason.TOO_LONG, Reason.REENTERS_SKIN, Reason.UNKNOWN_REGION)
    for reason in (*late, *of_arm, Reason.TOO_CLOSE, *of_skin):
        rows = np.flatnonzero(candidates.verdict.reason == reason.value)
        if len(rows) and reason is Reason.TOO_CLOSE:
            clearance = candidates.clearance
            demanded = ~np.isnan(clearance.margins)
            rows = rows[np.argmin((clearance.margins - clearance.by_structure[rows])[:, demanded].max(axis=1)) :]
        if len(rows):
            return int(rows[0])
    return None


@dataclass(frozen=True, eq=False)
class ArmReach:
    """The arm in its workcell, as the check of candidates needs it, and where the patient is."""

    own_checker: Callable[[], CellChecker]
    """Returns the calling thread's own checker; checkers are not thread-safe."""
    T_base_ct: Floats

    @property
    def checker(self) -> CellChecker:
        """The checker of the calling thread."""
        return self.own_checker()


def with_reach(case: Case, candidates: Candidates, reach: ArmReach, progress: Count | None = None) -> Candidates:
    """Check whether the arm reaches, and can insert along, every candidate that is safe so far; fill its columns."""
    rows = np.flatnonzero(candidates.safe)
    if not len(rows):  # nothing is left to ask the arm about
        return replace(candidates, arm_note=ARM_CHECKED)
    requests = reach_requests(case, candidates, rows, reach.T_base_ct)
    return with_answers(case, candidates, assess_reach_all(reach.checker, requests, progress))


def with_answers(case: Case, candidates: Candidates, answers: Sequence[ReachAnswer]) -> Candidates:
    """The arm's columns filled with the reach answers of all candidates that are safe so far, in their order."""
    rows = np.flatnonzero(candidates.safe)
    waiting = standoffs(case.needle, candidates.path.length[rows], candidates.path.skin_angle[rows])
    verdict = {field.name: getattr(candidates.verdict, field.name).copy() for field in fields(candidates.verdict)}
    reachable, margin, q_insertion = (getattr(candidates.arm, field.name).copy() for field in fields(candidates.arm))
    for row, standoff_mm, answer in zip(rows, waiting, answers, strict=True):
        reachable[row] = int(answer.reachable)
        margin[row] = answer.margin
        if answer.reachable:
            q_insertion[row] = answer.insertion_q[-1]
        else:
            verdict["reason"][row], verdict["detail"][row] = answer.reason.value, answer.detail
            verdict["structure"][row] = "" if answer.contact is None else "/".join(answer.contact)
            inserted = answer.depth_mm  # the tip's distance from the target is what is left of the standoff
            verdict["depth"][row] = np.nan if inserted is None else standoff_mm - inserted
    return replace(
        candidates, verdict=Verdict(**verdict), arm=ArmColumns(reachable, margin, q_insertion), arm_note=ARM_CHECKED
    )


def reach_request(case: Case, candidates: Candidates, row: int, T_base_ct: Floats) -> ReachRequest:
    """The reach request of one candidate: its needle line and standoff."""
    return reach_requests(case, candidates, np.array([row]), T_base_ct)[0]


def reach_requests(case: Case, candidates: Candidates, rows: Ints, T_base_ct: Floats) -> list[ReachRequest]:
    """The reach requests of some candidates."""
    R, target = T_base_ct[:3, :3], T_base_ct[:3, :3] @ case.target_ct + T_base_ct[:3, 3]
    lengths = standoffs(case.needle, candidates.path.length[rows], candidates.path.skin_angle[rows]).tolist()
    outward = [R @ candidates.outward_ct[row] for row in rows]
    return [ReachRequest(target, *of_row) for of_row in zip(outward, repeat(case.needle.length_mm), lengths)]
