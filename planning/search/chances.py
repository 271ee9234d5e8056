"""Chances of any needles that reach a case's target, and the search's candidates that break a limit of them.

`ChanceModel` is made once for a case; a query is needles alone: directions, and the arm's joints with the tip on the
target. Chances to hit, to touch and to break margins are of first order for all; line sampling refines them where a
limit may decide, and where people are shown them. For the best the chance to touch anything too, all structures
linearised together.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.base.text import did_you_mean
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine, normals_of
from puncture_twin.planning.reach.standoff import case_axis_lengths
from puncture_twin.planning.search.candidates import Candidates, Chances
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.uncertainty.hit import (
    HitModel,
    Proximity,
    hit_model,
    mean_over_faces,
    proximity,
    touch_bound,
    touch_chance,
    touching_any,
)
from puncture_twin.planning.uncertainty.lines import Needles, refined
from puncture_twin.planning.uncertainty.pose_error import PoseError

TAKEN = frozenset({"any", "joint"})
"""Names that are taken: ``p_touch_<name>`` is another column than one structure's chance."""


@dataclass(frozen=True, eq=False)
class ChanceModel:
    """Chances of any needles of one case."""

    case: Case
    anatomy: Anatomy
    engine: ClearanceEngine
    error: PoseError
    hit: HitModel

    @property
    def columns(self) -> Ints:
        """Places in ``anatomy.checked`` of the k structures that must not be touched."""
        return demanding(self.anatomy.checked)

    @property
    def structures(self) -> tuple[str, ...]:
        """Names of the k structures that must not be touched."""
        return tuple(self.anatomy.checked[column].name for column in self.columns)

    @property
    def limits(self) -> Floats:
        """The greatest chance to touch each of them that the case allows, shape (k,)."""
        return np.array([touch_limit(self.case, name) for name in self.structures])

    @cached_property
    def surfaces(self) -> Floats:
        """Covariance of each surface as a whole, `PoseError.surface_cov_ct`, shape (k, 3, 3), CT axes."""
        voxels = [self.anatomy.checked[column].voxel_ct for column in self.columns]
        return np.array([self.error.surface_cov_ct(voxel_ct) for voxel_ct in voxels]).reshape(-1, 3, 3)

    @cached_property
    def target_surface_mm(self) -> float:
        """Standard deviation of the target's surface, the mean over its faces; 0 where a radius decides a hit."""
        if self.hit.radius_mm is not None:
            return 0.0
        target = self.anatomy.structure(self.case.target_structure)
        return mean_over_faces(target.mesh, self.error.surface_cov_ct(target.voxel_ct))

    @property
    def touching(self) -> Floats:
        """Axis distance at which a needle touches each structure, shape (k,), mm."""
        return np.full(len(self.columns), self.case.needle.radius_mm)

    @property
    def breaking(self) -> Floats:
        """Axis distance at which a needle breaks each margin, shape (k,), mm."""
        margins = np.array([self.anatomy.checked[column].margin_mm for column in self.columns], dtype=np.float64)
        return self.case.needle.radius_mm + margins

    def led(self, error: PoseError, mean_ct: Floats) -> ChanceModel:
        """The model for another error, about needles that end off the target by a known mean, shape (3,), mm."""
        if not mean_ct.any():
            return replace(self, error=error)
        case, mesh = self.case, self.anatomy.structure(self.case.target_structure).mesh
        hit = hit_model(case.hit_radius_mm, mesh, case.target_ct, mean_ct)
        return replace(self, case=replace(case, target_ct=case.target_ct + mean_ct), error=error, hit=hit)

    def needles(self, outward_ct: Floats, q: Floats, axes: AxisDistances | None = None) -> Needles:
        """Needles with their covariances and proximity to the structures; arguments as of `chances`."""
        target, columns, surfaces = self.case.target_ct, self.columns, self.surfaces
        if axes is None:
            lengths = case_axis_lengths(self.case, self.anatomy, outward_ct)
            axes = self.engine.measure(target, outward_ct, lengths, shown=False)
        normal = normals_of(self.engine.triangles, target, outward_ct, axes)[:, columns]
        distance, depth = axes.distance[:, columns], axes.depth[:, columns]
        cov_ct = self.error.covariance_ct(q)
        surface_mm = np.sqrt(np.einsum("nka,kab,nkb->nk", normal, surfaces, normal))
        near = proximity(distance, depth, normal, outward_ct, cov_ct, surface_mm)
        return Needles(outward_ct, cov_ct, near, surface_mm, self.error.freedom)

    def hit_chance(self, cov_ct: Floats) -> Floats:
        """The chance to hit of needles with these Sigma6, shape (n, 6, 6), CT axes: shape (n,)."""
        return self.hit.chance(self.error, cov_ct, self.target_surface_mm)

    def chances(self, outward_ct: Floats, q: Floats, axes: AxisDistances | None = None) -> Chances:
        """The chances of needles along unit vectors (n, 3) to first order, the joint one unknown.

        The joints (n, 6), rad, put the tip on the target; what the engine has measured of them already is not measured
        again.
        """
        needles = self.needles(outward_ct, q, axes)
        near, freedom = needles.near, self.error.freedom
        touch, margin = (touch_chance(near, reach, freedom) for reach in (self.touching, self.breaking))
        tip = needles.cov_ct[:, :3, :3] + self.error.target_covariance_ct
        along = np.einsum("na,nab,nb->n", outward_ct, tip, outward_ct)
        return Chances(
            structures=self.structures,
            hit=self.hit_chance(needles.cov_ct),
            touch=touch,
            margin=margin,
            touch_any=touching_any(touch),
            touch_joint=np.full(len(q), np.nan),
            lateral_mm=np.sqrt(np.maximum(np.trace(tip, axis1=1, axis2=2) - along, 0.0)),
            depth_mm=np.sqrt(along),
            refined=np.zeros(len(q), bool),
        )


def chance_model(case: Case, anatomy: Anatomy, engine: ClearanceEngine, error: PoseError | None) -> ChanceModel | None:
    """The model of a case; None where it declares no errors, or nothing ties its frames.

    Raises InputError: Neither a radius nor a closed mesh says where the target is hit, or a structure has a column's
    name.
    """
    if error is None:
        return None
    taken = [anatomy.checked[column].name for column in demanding(anatomy.checked)]
    if not TAKEN.isdisjoint(taken):
        message = f"structures {', '.join(sorted(TAKEN.intersection(taken)))}: p_touch_<name> is another column"
        refuse(message, case.path, "names other than any and joint", "reserved_name")
    mesh = anatomy.structure(case.target_structure).mesh
    if case.hit_radius_mm is None and not mesh.closed:
        message = f"the mesh of '{case.target_structure}' is open: its inside, and so a hit, is not defined"
        refuse(message, case.path, "target.hit_radius_mm, or a closed mesh", "open_mesh")
    return ChanceModel(case, anatomy, engine, error, hit_model(case.hit_radius_mm, mesh, case.target_ct))


def refined_chances(
    model: ChanceModel, outward_ct: Floats, q: Floats, first: Chances, wanted: Bools | None = None
) -> Chances:
    """Chances to touch, to break a margin and to touch any, by line sampling; the others as they are.

    Of needles as of `ChanceModel.chances`, with theirs to first order; of those ``wanted`` (n, k) the chances to touch
    alone, None: all of both.
    """
    every = np.ones(first.touch.shape, bool)
    blocks, lengths = model.engine.blocks, case_axis_lengths(model.case, model.anatomy, outward_ct)[:, model.columns]
    around = [blocks[column] for column in model.columns], lengths, model.case.target_ct
    needles = model.needles(outward_ct, q)
    touch = refined(*around, needles, model.touching, first.touch, every if wanted is None else wanted)
    margin = first.margin if wanted is not None else refined(*around, needles, model.breaking, first.margin, every)
    whole = np.full(len(q), wanted is None)
    return replace(first, touch=touch, margin=margin, touch_any=touching_any(touch), refined=whole)


def satisfies_limits(model: ChanceModel, outward_ct: Floats, q: Floats) -> Bools:
    """Whether needles, as of `ChanceModel.chances`, satisfy the limits in any configuration at the target: (n,)."""
    satisfied, least, limits = np.ones(len(q), bool), model.case.search.min_hit, model.limits
    if least is not None:
        satisfied &= model.hit_chance(model.error.covariance_ct(q)) >= least
    if not np.isfinite(limits).any():
        return satisfied
    first = model.chances(outward_ct, q)
    touch = refined_chances(model, outward_ct, q, first, np.broadcast_to(np.isfinite(limits), first.touch.shape)).touch
    return np.asarray(satisfied & (np.where(np.isnan(touch), np.inf, touch) <= limits).all(axis=1))


def demanding(structures: tuple[Structure, ...]) -> Ints:
    """Columns of the structures that must not be touched."""
    return np.flatnonzero([s.demands_margin for s in structures])


def check_limits(case: Case, anatomy: Anatomy, error_known: bool) -> None:
    """Refuse limits that no candidate can be tested against: every one would pass untested.

    Raises InputError: Limits without a pose error, or of a structure that has no chance to be touched.
    """
    settings = case.search
    limited = settings.min_hit is not None or settings.max_touch is not None or bool(settings.max_touch_of)
    if limited and not error_known:
        message = "search.min_hit and max_touch cannot be checked: the needle's error needs markers and the arm"
        allowed = "[registration] with markers, and a search with the arm; or no such limit"
        refuse(message, case.path, allowed, "no_needle_error")
    names = [anatomy.checked[column].name for column in demanding(anatomy.checked)]
    unknown = sorted(set(settings.max_touch_of) - set(names))
    if unknown:
        message = f"search.max_touch_of '{unknown[0]}' is not a structure to avoid"
        message += did_you_mean(unknown[0], names)
        refuse(message, case.path, ", ".join(names), "unknown_structure")


def touch_limit(case: Case, name: str) -> float:
    """The greatest chance to touch a structure that a case allows."""
    allowed = case.search.max_touch_of.get(name, case.search.max_touch)
    return np.inf if allowed is None else allowed


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
    if model is None or not len(rows):
        return replace(candidates, chances=Chances.unknown(names, len(candidates)))
    outward, q, chances = candidates.outward_ct, candidates.arm.q_insertion, Chances.unknown(names, len(candidates))
    for part in (rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)):
        measured = None if axes is None else axes.at(part)
        chances = chances.with_rows(part, model.chances(outward[part], q[part], measured))
    return limited(case, refined_near_limits(replace(candidates, chances=chances), model))


def limited(case: Case, candidates: Candidates) -> Candidates:
    """Reject candidates whose chance to hit is below, or to touch above, the case's limit; unknown ones too."""
    chances, least = candidates.chances, case.search.min_hit
    assert chances is not None
    verdict = candidates.verdict
    if least is not None:
        rows = np.flatnonzero(verdict.safe & ~(chances.hit >= least))  # true for NaN
        reason, target = Reason.HIT_UNLIKELY.value, case.target_structure
        verdict = verdict.with_rows(rows, reason=reason, structure=target, amount=chances.hit[rows])
    limits = np.array([touch_limit(case, name) for name in chances.structures])
    touch = np.where(np.isnan(chances.touch), np.inf, chances.touch)
    with np.errstate(invalid="ignore"):  # without a limit both may be infinite
        beyond = np.where(touch > limits, touch - limits, -np.inf)
    rows = np.flatnonzero(verdict.safe & (beyond > 0).any(axis=1))
    worst = beyond[rows].argmax(axis=1) if len(rows) else rows
    names, amount = np.array(chances.structures, dtype=object)[worst], chances.touch[rows, worst]
    verdict = verdict.with_rows(rows, reason=Reason.TOUCH_LIKELY.value, structure=names, amount=amount)
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
    return replace(candidates, chances=chances.with_rows(rows, better))


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
