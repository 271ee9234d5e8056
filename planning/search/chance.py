"""Chances of a search's candidates, and their refusal where a chance breaks the case's limit.

To first order for all; by line sampling where that may decide: near a limit, and for the best candidates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy, Structure
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine
from puncture_twin.planning.reach.standoff import axis_lengths
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.uncertainty.chances import Chances, HitModel, hit_model
from puncture_twin.planning.uncertainty.pose_error import PoseError
from puncture_twin.planning.uncertainty.refined_touch import Needles, Surroundings, refined
from puncture_twin.planning.uncertainty.touch import Proximity, joint_touch_chance, proximity, touch_bound, touch_chance

BEST = 200
"""Of the ranked candidates: how many get the dearer chances."""

TAKEN = frozenset({"any", "joint"})
"""Names whose column ``p_touch_<name>`` says something else than one structure's chance."""

REFINED_FROM, REFINED_TO = 1 / 60, 3.0
"""Times its limit: what first order, or its bound, puts in between is refined. The chance to be displaced so far to any
side at all is 56 times that to one side at 3.5 standard deviations, and less for less."""

ROWS_AT_ONCE = 4096
"""Of candidates: a table of gradients of 60 structures stays below 20 MB."""


@dataclass(frozen=True, eq=False)
class ChanceModel:
    """What the chances of a case's candidates are computed from.

    Attributes:
        error: Of the needle's pose.
        hit: When the tip hits.
    """

    error: PoseError
    hit: HitModel


def chance_model(case: Case, anatomy: Anatomy, error: PoseError | None) -> ChanceModel | None:
    """The model of a case; None where it declares no errors, or nothing ties its frames.

    Raises:
        InputError: Neither a radius nor a closed mesh says where the target is hit, or a structure has the name of
            another column.
    """
    if error is None:
        return None
    taken = [anatomy.checked[column].name for column in demanding(anatomy.checked)]
    if not TAKEN.isdisjoint(taken):
        message = f"structures {', '.join(sorted(TAKEN.intersection(taken)))}: p_touch_<name> is another column"
        raise InputError(message, where=case.path, allowed="other names than any and joint")
    mesh = anatomy.structure(case.target_structure).mesh
    if case.hit_radius_mm is None and not mesh.closed:
        message = f"the mesh of '{case.target_structure}' is open: what lies in it, and is hit, is not known"
        raise InputError(message, where=case.path, allowed="target.hit_radius_mm, or a closed mesh")
    return ChanceModel(error, hit_model(case.hit_radius_mm, mesh, case.target_ct))


def demanding(structures: tuple[Structure, ...]) -> Ints:
    """Columns of the structures that must not be touched."""
    return np.flatnonzero([s.demands_margin for s in structures])


def with_chances(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    found: Candidates,
    model: ChanceModel | None,
    axes: AxisDistances,
) -> Candidates:
    """Compute the chances of all candidates that geometry and reach left, and reject those beyond the case's limits.

    Args:
        case: Declares errors; else nothing is computed.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``.
        found: Checked against organs and arm.
        model: None where the pose's error is not known: the chances are blank.
        axes: What ``engine`` measured of the candidates.

    Raises:
        InputError: A limit that nothing can be held against.
    """
    if case.errors is None:
        return found
    check_limits(case, anatomy, model)
    columns = demanding(anatomy.checked)
    names = tuple(anatomy.checked[column].name for column in columns)
    blank = Chances.unknown(names, len(found))
    rows = np.flatnonzero(found.safe & np.isfinite(found.arm.q_insertion).all(axis=1))
    if model is None or not len(rows):
        return replace(found, chances=blank)
    parts = [rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)]
    outward, q = found.outward_ct, found.arm.q_insertion
    arrays = [chances_of(case, anatomy, engine, model, outward[part], q[part], axes.at(part)) for part in parts]
    values = {name: np.concatenate([part[name] for part in arrays]) for name in arrays[0]}
    filled = {name: getattr(blank, name).copy() for name in values}
    for name, value in values.items():
        filled[name][rows] = value
    found = replace(found, chances=Chances(names, **filled, touch_joint=blank.touch_joint))
    return _limited(case, _refined_near_limits(case, anatomy, engine, found, model))


def check_limits(case: Case, anatomy: Anatomy, model: ChanceModel | None) -> None:
    """Refuse limits that no candidate can be held against: it would pass unasked.

    Raises:
        InputError: Limits without a pose error, or of a structure that has no chance to be touched.
    """
    settings = case.search
    limited = settings.min_hit is not None or settings.max_touch is not None or bool(settings.max_touch_of)
    if limited and model is None:
        message = "search.min_hit and max_touch cannot be checked: only markers and the arm give the needle's error"
        allowed = "[registration] with markers, and a search with the arm; or no such limit"
        raise InputError(message, where=case.path, allowed=allowed)
    names = [anatomy.checked[column].name for column in demanding(anatomy.checked)]
    unknown = sorted(set(settings.max_touch_of) - set(names))
    if unknown:
        message = f"search.max_touch_of '{unknown[0]}' is no structure that must not be touched"
        raise InputError(message, where=case.path, allowed=", ".join(names))


def passing(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    model: ChanceModel,
    outward_ct: Floats,
    cov_ct: Floats,
    axes: AxisDistances | None = None,
) -> Proximity:
    """How some needles pass what must not be touched; ``axes`` as in `chances_of`."""
    columns = demanding(anatomy.checked)
    if axes is None:
        axes = engine.measure(case.target_ct, outward_ct, axis_lengths(case, anatomy.checked), shown=False)
    normal = engine.normals(case.target_ct, outward_ct, axes)[:, columns]
    distance, depth = axes.distance[:, columns], axes.depth[:, columns]
    return proximity(distance, depth, normal, outward_ct, cov_ct, model.error.surface_mm)


def _needles(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    model: ChanceModel,
    outward_ct: Floats,
    q: Floats,
    axes: AxisDistances | None = None,
) -> Needles:
    """Some needles and the doubt about them; ``axes`` as in `chances_of`."""
    cov_ct = model.error.covariance_ct(q)
    near = passing(case, anatomy, engine, model, outward_ct, cov_ct, axes)
    return Needles(outward_ct, cov_ct, near, model.error.surface_mm, model.error.freedom)


def _thresholds(case: Case, anatomy: Anatomy) -> tuple[Floats, Floats]:
    """How near a needle's axis touches each structure, and breaks its margin, shape (k,), mm."""
    margins = np.array([anatomy.checked[column].margin_mm for column in demanding(anatomy.checked)], dtype=np.float64)
    return np.full(len(margins), case.needle.radius_mm), case.needle.radius_mm + margins


def chances_of(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    model: ChanceModel,
    outward_ct: Floats,
    q: Floats,
    axes: AxisDistances | None = None,
) -> dict[str, Floats]:
    """The columns of `Chances`, but for the joint one, of any needles that reach the target.

    Args:
        case: The case.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``.
        model: Of the case.
        outward_ct: Shape (n, 3), unit.
        q: Shape (n, 6), rad, the tip on the target.
        axes: What the engine has measured of the needles already; None measures them.
    """
    needles = _needles(case, anatomy, engine, model, outward_ct, q, axes)
    touching, breaking = _thresholds(case, anatomy)
    touch = touch_chance(needles.near, touching, model.error.freedom)
    tip = needles.cov_ct[:, :3, :3] + model.error.target_covariance_ct
    along = np.einsum("na,nab,nb->n", outward_ct, tip, outward_ct)
    return {
        "hit": model.hit.chance(model.error, needles.cov_ct),
        "touch": touch,
        "margin": touch_chance(needles.near, breaking, model.error.freedom),
        "touch_any": _any(touch),
        "lateral_mm": np.sqrt(np.maximum(np.trace(tip, axis1=1, axis2=2) - along, 0.0)),
        "depth_mm": np.sqrt(along),
    }


def _any(touch: Floats) -> Floats:
    """Shape (n,), from chances (n, k)."""
    return np.asarray(np.minimum(1.0, touch.sum(axis=1)))


def refined_chances(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    model: ChanceModel,
    needles: tuple[Floats, Floats],
    first: tuple[Floats, Floats],
    wanted: Bools | None = None,
) -> dict[str, Floats]:
    """Chances to touch, to break a margin and to touch any, by line sampling.

    Args:
        case: The case.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``.
        model: Of the case.
        needles: Directions (n, 3) and configurations (n, 6), as in `chances_of`.
        first: Chances (n, k) to touch and to break a margin, to first order.
        wanted: Shape (n, k), which chances to touch are refined, those of margins not; None refines all of both.
    """
    outward_ct, q = needles
    columns, every = demanding(anatomy.checked), np.ones(first[0].shape, bool)
    around = Surroundings(engine, columns, axis_lengths(case, anatomy.checked)[columns], case.target_ct)
    asked, (touching, breaking) = _needles(case, anatomy, engine, model, outward_ct, q), _thresholds(case, anatomy)
    touch = refined(around, asked, touching, first[0], every if wanted is None else wanted)
    margin = first[1] if wanted is not None else refined(around, asked, breaking, first[1], every)
    return {"touch": touch, "margin": margin, "touch_any": _any(touch)}


def _with_refined(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    found: Candidates,
    model: ChanceModel,
    rows: Ints,
    wanted: Bools | None = None,
) -> Candidates:
    """Refine some rows; ``wanted`` as in `refined_chances`."""
    chances = found.chances
    assert chances is not None
    needles, first = (found.outward_ct[rows], found.arm.q_insertion[rows]), (chances.touch[rows], chances.margin[rows])
    values = refined_chances(case, anatomy, engine, model, needles, first, wanted)
    filled = {name: getattr(chances, name).copy() for name in values}
    for name, value in values.items():
        filled[name][rows] = value
    return replace(found, chances=replace(chances, **filled))


def _refined_near_limits(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, found: Candidates, model: ChanceModel
) -> Candidates:
    """Refine the chances to touch that first order puts near a limit, or that may be there if the needle leans."""
    chances = found.chances
    assert chances is not None
    limits = np.array([touch_limit(case, name) for name in chances.structures])
    if not np.isfinite(limits).any():
        return found
    greatest = np.fmax(chances.touch, _touch_bounds(case, anatomy, found, model))
    wanted = (greatest >= REFINED_FROM * limits) & (chances.touch <= REFINED_TO * limits)
    rows = np.flatnonzero(wanted.any(axis=1) & found.safe)
    return _with_refined(case, anatomy, engine, found, model, rows, wanted[rows]) if len(rows) else found


def _touch_bounds(case: Case, anatomy: Anatomy, found: Candidates, model: ChanceModel) -> Floats:
    """Shape (n, k), of the safe candidates' chances to touch; NaN for others."""
    error, columns = model.error, demanding(anatomy.checked)
    length = float(axis_lengths(case, anatomy.checked)[columns].max())
    bounds, rows = np.full((len(found), len(columns)), np.nan), np.flatnonzero(found.safe)
    for part in (rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)):
        slack, cov_ct = found.clearance.distance[part][:, columns], error.covariance_ct(found.arm.q_insertion[part])
        bounds[part] = touch_bound(slack, found.outward_ct[part], cov_ct, length, error.surface_mm, error.freedom)
    return bounds


def with_best_refined(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    found: Candidates,
    model: ChanceModel | None,
) -> Candidates:
    """Refine the best candidates, reject those that break a limit then, and rank again until no new one is among them.

    Args:
        case: The case.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``.
        found: Ranked, with chances.
        model: As in `with_chances`.
    """
    if model is None or found.chances is None:
        return found
    done = np.zeros(len(found), bool)
    while len(rows := (best := found.ranked[:BEST])[~done[best]]):
        found = ranked(case, _limited(case, _with_refined(case, anatomy, engine, found, model, rows)))
        done[rows] = True
    return found


def _limited(case: Case, found: Candidates) -> Candidates:
    """Reject what is too unlikely to hit, or too likely to touch."""
    chances, least = found.chances, case.search.min_hit
    assert chances is not None
    if least is not None:
        rows = np.flatnonzero(found.safe & ~(chances.hit >= least))  # what is not known is not enough
        target = np.full(len(rows), case.target_structure, dtype=object)
        found = replace(found, verdict=found.verdict.rejected(rows, Reason.HIT_UNLIKELY, target, chances.hit[rows]))
    limits = np.array([touch_limit(case, name) for name in chances.structures])
    touch = np.where(np.isnan(chances.touch), np.inf, chances.touch)  # nor is it little enough
    with np.errstate(invalid="ignore"):  # without a limit both may be infinite
        beyond = np.where(touch > limits, touch - limits, -np.inf)
    rows = np.flatnonzero(found.safe & (beyond > 0).any(axis=1))
    worst = beyond[rows].argmax(axis=1) if len(rows) else rows
    names = np.array(chances.structures, dtype=object)[worst]
    amounts = chances.touch[rows, worst]
    return replace(found, verdict=found.verdict.rejected(rows, Reason.TOUCH_LIKELY, names, amounts))


def keeps_limits(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, model: ChanceModel, outward_ct: Floats, q: Floats
) -> Bools:
    """Whether needles keep the case's limits of chances, shape (n,), in any configurations that reach the target.

    Args:
        case: The case.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``.
        model: Of the case.
        outward_ct: Shape (n, 3), unit.
        q: Shape (n, 6), rad, the tip on the target.
    """
    asked, settings = (case, anatomy, engine, model), case.search
    kept = np.ones(len(q), bool)
    if settings.min_hit is not None:
        kept &= model.hit.chance(model.error, model.error.covariance_ct(q)) >= settings.min_hit
    limits = np.array([touch_limit(case, anatomy.checked[column].name) for column in demanding(anatomy.checked)])
    if not np.isfinite(limits).any():
        return kept
    first = chances_of(*asked, outward_ct, q)
    wanted = np.broadcast_to(np.isfinite(limits), first["touch"].shape)
    touch = refined_chances(*asked, (outward_ct, q), (first["touch"], first["margin"]), wanted)["touch"]
    return np.asarray(kept & (np.where(np.isnan(touch), np.inf, touch) <= limits).all(axis=1))


def touch_limit(case: Case, name: str) -> float:
    """The greatest chance to touch a structure that a case allows."""
    allowed = case.search.max_touch_of.get(name, case.search.max_touch)
    return np.inf if allowed is None else allowed


def with_joint_chances(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, found: Candidates, model: ChanceModel | None
) -> Candidates:
    """Add, for the best candidates, the chance to touch anything, all structures linearised together.

    The candidates are ranked; the arguments are those of `with_chances`.
    """
    rows = found.ranked[:BEST]
    if model is None or found.chances is None or not len(rows):
        return found
    asked = _needles(case, anatomy, engine, model, found.outward_ct[rows], found.arm.q_insertion[rows])
    joint = found.chances.touch_joint.copy()
    joint[rows] = joint_touch_chance(asked.near, asked.cov_ct, case.needle.radius_mm, asked.freedom)
    return replace(found, chances=replace(found.chances, touch_joint=joint))
