"""Chances to hit and to touch of a search's candidates, and their rejection where a chance breaks the case's limit.

To first order for all; by line sampling where a limit may decide, and where people are shown them, as in `check`.
For the best of them the chance to touch anything too, all structures linearised together.
"""

from dataclasses import fields, replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.reach.standoff import case_axis_lengths
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.uncertainty.chance_model import (
    ChanceModel,
    Chances,
    check_limits,
    demanding,
    refined_chances,
    touch_limit,
)
from puncture_twin.planning.uncertainty.hit import Proximity, touch_bound


def with_chances(
    case: Case, anatomy: Anatomy, candidates: Candidates, model: ChanceModel | None, axes: AxisDistances | None
) -> Candidates:
    """Compute the chances of all candidates that are safe so far, and reject those beyond the case's limits.

    Args:
        model: None where the pose's error is not known: the chances are blank.
        axes: Distances of the candidates' axes; None measures those of the safe ones again.

    Raises:
        InputError: A limit that nothing can be compared with.
    """
    check_limits(case, anatomy, model is not None)
    names = tuple(anatomy.checked[column].name for column in demanding(anatomy.checked))
    rows = np.flatnonzero(candidates.safe & np.isfinite(candidates.arm.q_insertion).all(axis=1))
    chances = Chances.unknown(names, len(candidates))
    if model is None or not len(rows):
        return replace(candidates, chances=chances)
    for part in (rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)):
        measured = None if axes is None else axes.at(part)
        chances = chances.put(
            part, model.chances(candidates.outward_ct[part], candidates.arm.q_insertion[part], measured)
        )
    return limited(case, refined_near_limits(replace(candidates, chances=chances), model))


def limited(case: Case, candidates: Candidates) -> Candidates:
    """Reject candidates whose chance to hit is below, or to touch above, the case's limit; unknown ones too."""
    chances, least = candidates.chances, case.search.min_hit
    assert chances is not None
    verdict = candidates.verdict
    if least is not None:
        rows = np.flatnonzero(verdict.safe & ~(chances.hit >= least))  # true for NaN
        reason, target = Reason.HIT_UNLIKELY.value, case.target_structure
        verdict = verdict.put(rows, reason=reason, structure=target, amount=chances.hit[rows])
    limits = np.array([touch_limit(case, name) for name in chances.structures])
    touch = np.where(np.isnan(chances.touch), np.inf, chances.touch)
    with np.errstate(invalid="ignore"):  # without a limit both may be infinite
        beyond = np.where(touch > limits, touch - limits, -np.inf)
    rows = np.flatnonzero(verdict.safe & (beyond > 0).any(axis=1))
    worst = beyond[rows].argmax(axis=1) if len(rows) else rows
    names, amount = np.array(chances.structures, dtype=object)[worst], chances.touch[rows, worst]
    verdict = verdict.put(rows, reason=Reason.TOUCH_LIKELY.value, structure=names, amount=amount)
    return replace(candidates, verdict=verdict)


BEST = 200
"""How many of the best candidates get the chances that take long to compute."""
REFINED_FROM = 1 / 60
"""Fraction of its limit from which on a chance of first order, or its bound, is refined. The chance to be displaced so
far to any side is 56 times that to one side at 3.5 standard deviations, and less for less."""
ROWS_AT_ONCE = 4096
"""Candidates at once: a table of gradients of 60 structures stays below 20 MB."""


def refined_near_limits(candidates: Candidates, model: ChanceModel) -> Candidates:
    """Refine the chances to touch that may exceed a limit, by first order or by the bound for a tilted needle."""
    chances, limits = candidates.chances, model.limits
    assert chances is not None
    if not np.isfinite(limits).any():
        return candidates
    error, columns = model.error, model.columns
    surface_mm = np.sqrt(np.linalg.eigvalsh(model.surfaces)[:, -1])  # in the worst direction
    greatest, rows = chances.touch.copy(), np.flatnonzero(candidates.safe)
    for part in (rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)):
        outward, slack = candidates.outward_ct[part], candidates.clearance.by_structure[part][:, columns]
        length = float(case_axis_lengths(model.case, model.anatomy, outward)[:, columns].max())
        cov_ct = error.covariance_ct(candidates.arm.q_insertion[part])
        bound = touch_bound(slack, outward, cov_ct, length, surface_mm, error.freedom)
        greatest[part] = np.fmax(greatest[part], bound)  # first order may be too low
    rows = np.flatnonzero((greatest >= REFINED_FROM * limits).any(axis=1) & np.isfinite(chances.hit))
    return with_refined(candidates, model, rows) if len(rows) else candidates


def with_refined(candidates: Candidates, model: ChanceModel, rows: Ints) -> Candidates:
    """The chances with some rows refined by line sampling."""
    chances = candidates.chances
    assert chances is not None
    names = [field.name for field in fields(chances) if field.name != "structures"]
    first = Chances(chances.structures, **{name: getattr(chances, name)[rows] for name in names})
    better = refined_chances(model, candidates.outward_ct[rows], candidates.arm.q_insertion[rows], first)
    return replace(candidates, chances=chances.put(rows, better))


def with_best_chances(candidates: Candidates, model: ChanceModel) -> Candidates:
    """Refine the candidates that people are shown: the best of all, and the best of every window.

    Those that break a limit then are rejected, and the rest ranked again, until no new one is among them. The best get
    the chance to touch anything too, all structures linearised together.
    """
    while True:
        best, chances = [window.best for window in candidates.windows], candidates.chances
        assert chances is not None
        shown = np.unique(np.append(candidates.ranked[:BEST], best)).astype(np.int64)
        rows = shown[~chances.refined[shown] & np.isfinite(chances.hit[shown])]  # still of first order
        if not len(rows):
            break
        candidates = ranked(model.case, limited(model.case, with_refined(candidates, model, rows)))
    rows = candidates.ranked[:BEST]
    if not len(rows):
        return candidates
    needles = model.needles(candidates.outward_ct[rows], candidates.arm.q_insertion[rows])
    joint, radius = chances.touch_joint.copy(), model.case.needle.radius_mm
    joint[rows] = joint_touch_chance(needles.near, needles.cov_ct, radius, needles.freedom, needles.surface_mm)
    return replace(candidates, chances=replace(chances, touch_joint=joint))


NORMALS = 4096
"""Fixed draws of the jointly linearised chance: its own error is .008 at most."""
DRAWS_SEED = 20191104
"""Seed of those draws, the same in every run: the table must not depend on chance."""


def joint_touch_chance(
    near: Proximity,
    cov_ct: Floats,
    threshold_mm: Floats | float,
    freedom: int | None = None,
    surface_mm: Floats | float = 0.0,
) -> Floats:
    """P that a needle comes nearer to any structure than its threshold, all linearised together, shape (n,).

    Args:
        cov_ct: Shape (n, 6, 6), covariance of each needle's pose, CT axes, twist order.
        threshold_mm: One number or shape (k,).
        surface_mm: As in `proximity`: every structure's surface lies off by a normal number of its own.
    """
    rng = np.random.default_rng(DRAWS_SEED)
    draws = rng.normal(size=(NORMALS, 6))
    sizes = np.ones(NORMALS) if freedom is None else np.sqrt(freedom / rng.chisquare(freedom, NORMALS))
    surfaces = np.nan_to_num(np.broadcast_to(surface_mm, near.distance.shape))
    off = rng.normal(size=(NORMALS, near.distance.shape[1])) if surfaces.any() else np.zeros((1, 1))
    chances = np.empty(len(cov_ct))
    for row, cov in enumerate(cov_ct):
        values, axes = np.linalg.eigh(cov)
        root = axes * np.sqrt(np.maximum(values, 0.0))  # a covariance may be singular
        change = sizes[:, None] * (draws @ (near.gradient[row] @ root).T + off * surfaces[row])
        chances[row] = np.mean(np.any(change < threshold_mm - near.distance[row], axis=1))
    return chances
