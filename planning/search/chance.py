"""Chances of a search's candidates, and their refusal where a chance breaks the case's limit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy, Structure
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import ClearanceEngine
from puncture_twin.planning.reach.standoff import axis_lengths
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.uncertainty.chances import Chances, HitModel, hit_model
from puncture_twin.planning.uncertainty.pose_error import PoseError
from puncture_twin.planning.uncertainty.touch import Proximity, joint_touch_chance, proximity, touch_chance

BEST = 200
"""Of the ranked candidates: how many get the dearer chances."""

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
    """The model of a case; None where it declares no errors, or nothing ties its frames."""
    if error is None:
        return None
    mesh = anatomy.structure(case.target_structure).mesh
    return ChanceModel(error, hit_model(case.hit_radius_mm, mesh, case.target_ct))


def demanding(structures: tuple[Structure, ...]) -> Ints:
    """Columns of the structures that must not be touched."""
    return np.flatnonzero([s.demands_margin for s in structures])


def with_chances(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, found: Candidates, model: ChanceModel | None
) -> Candidates:
    """Compute the chances of all candidates that geometry and reach left, and reject those beyond the case's limits.

    Args:
        case: Declares errors; else nothing is computed.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``.
        found: Checked against organs and arm.
        model: None where the pose's error is not known: the chances are blank.
    """
    if case.errors is None:
        return found
    columns = demanding(anatomy.checked)
    names = tuple(anatomy.checked[column].name for column in columns)
    blank = Chances.unknown(names, len(found))
    rows = np.flatnonzero(found.safe & np.isfinite(found.arm.q_insertion).all(axis=1))
    if model is None or not len(rows):
        return replace(found, chances=blank)
    parts = [rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)]
    outward, q = found.outward_ct, found.arm.q_insertion
    arrays = [chances_of(case, anatomy, engine, model, outward[part], q[part]) for part in parts]
    values = {name: np.concatenate([part[name] for part in arrays]) for name in arrays[0]}
    filled = {name: getattr(blank, name).copy() for name in values}
    for name, value in values.items():
        filled[name][rows] = value
    return _limited(case, replace(found, chances=Chances(names, **filled, touch_joint=blank.touch_joint)))


def passing(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, model: ChanceModel, outward_ct: Floats, cov_ct: Floats
) -> Proximity:
    """How some needles pass what must not be touched."""
    columns = demanding(anatomy.checked)
    axes = engine.measure(case.target_ct, outward_ct, axis_lengths(case, anatomy.checked), normals=True)
    assert axes.normal is not None
    distance, depth, normal = axes.distance[:, columns], axes.depth[:, columns], axes.normal[:, columns]
    return proximity(distance, depth, normal, outward_ct, cov_ct, model.error.surface_mm)


def chances_of(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, model: ChanceModel, outward_ct: Floats, q: Floats
) -> dict[str, Floats]:
    """The columns of `Chances`, but for the joint one, of any needles that reach the target.

    Args:
        case: The case.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``.
        model: Of the case.
        outward_ct: Shape (n, 3), unit.
        q: Shape (n, 6), rad, the tip on the target.
    """
    near = passing(case, anatomy, engine, model, outward_ct, model.error.covariance_ct(q))
    margins = np.array([anatomy.checked[column].margin_mm for column in demanding(anatomy.checked)])
    touch = touch_chance(near, case.needle.radius_mm, model.error.freedom)
    tip = model.error.tip_covariance_ct(q)
    along = np.einsum("na,nab,nb->n", outward_ct, tip, outward_ct)
    return {
        "hit": model.hit.chance(model.error, q),
        "touch": touch,
        "margin": touch_chance(near, case.needle.radius_mm + margins, model.error.freedom),
        "touch_any": np.minimum(1.0, touch.sum(axis=1)),
        "lateral_mm": np.sqrt(np.maximum(np.trace(tip, axis1=1, axis2=2) - along, 0.0)),
        "depth_mm": np.sqrt(along),
    }


def _limited(case: Case, found: Candidates) -> Candidates:
    """Reject what is too unlikely to hit, or too likely to touch."""
    chances, least = found.chances, case.search.min_hit
    assert chances is not None
    if least is not None:
        rows = np.flatnonzero(found.safe & (chances.hit < least))
        target = np.full(len(rows), case.target_structure, dtype=object)
        found = replace(found, verdict=found.verdict.rejected(rows, Reason.HIT_UNLIKELY, target, chances.hit[rows]))
    limits = np.array([touch_limit(case, name) for name in chances.structures])
    beyond = np.where(chances.touch > limits, chances.touch - limits, -np.inf)
    rows = np.flatnonzero(found.safe & (beyond > 0).any(axis=1))
    worst = beyond[rows].argmax(axis=1) if len(rows) else rows
    names = np.array(chances.structures, dtype=object)[worst]
    amounts = chances.touch[rows, worst]
    return replace(found, verdict=found.verdict.rejected(rows, Reason.TOUCH_LIKELY, names, amounts))


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
    cov_ct = model.error.covariance_ct(found.arm.q_insertion[rows])
    near = passing(case, anatomy, engine, model, found.outward_ct[rows], cov_ct)
    joint = found.chances.touch_joint.copy()
    joint[rows] = joint_touch_chance(near, cov_ct, case.needle.radius_mm, model.error.freedom)
    return replace(found, chances=replace(found.chances, touch_joint=joint))
