"""Chances of any needles that reach a case's target: to hit, to touch and to break margins, and the case's limits.

The model is made once for a case; a query is needles alone: directions, and the arm's joints with the tip on the
target. Chances are of first order; line sampling refines them on request (`refined_chances`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Bools, Columns, Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import did_you_mean
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine, normals_of
from puncture_twin.planning.reach.standoff import case_axis_lengths
from puncture_twin.planning.uncertainty.hit import (
    HitModel,
    hit_model,
    mean_over_faces,
    proximity,
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
        target, columns = self.case.target_ct, self.columns
        if axes is None:
            lengths = case_axis_lengths(self.case, self.anatomy, outward_ct)
            axes = self.engine.measure(target, outward_ct, lengths, shown=False)
        normal = normals_of(self.engine.triangles, target, outward_ct, axes)[:, columns]
        distance, depth = axes.distance[:, columns], axes.depth[:, columns]
        cov_ct = self.error.covariance_ct(q)
        surface_mm = np.sqrt(np.einsum("nka,kab,nkb->nk", normal, self.surfaces, normal))
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
    kept, least, limits = np.ones(len(q), bool), model.case.search.min_hit, model.limits
    if least is not None:
        kept &= model.hit_chance(model.error.covariance_ct(q)) >= least
    if not np.isfinite(limits).any():
        return kept
    first = model.chances(outward_ct, q)
    touch = refined_chances(model, outward_ct, q, first, np.broadcast_to(np.isfinite(limits), first.touch.shape)).touch
    return np.asarray(kept & (np.where(np.isnan(touch), np.inf, touch) <= limits).all(axis=1))


@dataclass(frozen=True, eq=False)
class Chances(Columns):
    """Chances of n candidates and k structures that demand a margin; NaN where nothing was computed."""

    structures: tuple[str, ...]
    hit: Floats  # shape (n,), that the tip is in the target's mesh, or within its radius
    touch: Floats  # shape (n, k), that the needle touches each structure
    margin: Floats  # shape (n, k), that it breaks each structure's margin
    touch_any: Floats  # shape (n,), min(1, sum of touch): never below the truth of what `touch` says
    touch_joint: Floats
    """Shape (n,), that it touches any, all linearised together; of the best candidates alone."""
    lateral_mm: Floats
    """Shape (n,), expected (rms) error of the tip across the needle, target reading included."""
    depth_mm: Floats  # shape (n,), along it
    refined: Bools  # shape (n,), whether touch and margin are line-sampled; else they are of first order

    @classmethod
    def unknown(cls, structures: tuple[str, ...], count: int) -> Chances:
        """The chances of candidates for which nothing was computed."""
        shapes = {"touch": (count, len(structures)), "margin": (count, len(structures))}
        names = {field.name for field in fields(cls)} - {"structures", "refined"}
        blank = {name: np.full(shapes.get(name, (count,)), np.nan) for name in names}
        return cls(structures, refined=np.zeros(count, bool), **blank)

    def put(self, rows: Ints, known: Chances) -> Chances:
        """These chances with those of some candidates replaced."""
        values = {field.name: getattr(self, field.name).copy() for field in fields(self) if field.name != "structures"}
        for name, value in values.items():
            value[rows] = getattr(known, name)
        return Chances(self.structures, **values)


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
