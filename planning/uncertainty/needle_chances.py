"""Chances of any needles that reach the target: to hit, to touch and to break margins, and whether they keep limits.

To first order, or by line sampling where it is wanted.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine
from puncture_twin.planning.reach.standoff import axis_lengths
from puncture_twin.planning.uncertainty.chance_model import ChanceModel, demanding, touch_limit
from puncture_twin.planning.uncertainty.refined_touch import Needles, Surroundings, refined
from puncture_twin.planning.uncertainty.touch import Proximity, proximity, touch_chance


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


def needles_of(
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
    needles = needles_of(case, anatomy, engine, model, outward_ct, q, axes)
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
    posed, (touching, breaking) = (
        needles_of(case, anatomy, engine, model, outward_ct, q),
        _thresholds(case, anatomy),
    )
    touch = refined(around, posed, touching, first[0], every if wanted is None else wanted)
    margin = first[1] if wanted is not None else refined(around, posed, breaking, first[1], every)
    return {"touch": touch, "margin": margin, "touch_any": _any(touch)}


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
    model_of, settings = (case, anatomy, engine, model), case.search
    kept = np.ones(len(q), bool)
    if settings.min_hit is not None:
        kept &= model.hit.chance(model.error, model.error.covariance_ct(q)) >= settings.min_hit
    limits = np.array([touch_limit(case, anatomy.checked[column].name) for column in demanding(anatomy.checked)])
    if not np.isfinite(limits).any():
        return kept
    first = chances_of(*model_of, outward_ct, q)
    wanted = np.broadcast_to(np.isfinite(limits), first["touch"].shape)
    touch = refined_chances(*model_of, (outward_ct, q), (first["touch"], first["margin"]), wanted)["touch"]
    return np.asarray(kept & (np.where(np.isnan(touch), np.inf, touch) <= limits).all(axis=1))
