"""The distribution of a puncture over many Monte Carlo trials: what was realised, next to what was predicted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from puncture_twin.planning.anatomy.anatomy import Anatomy, surface_distance
from puncture_twin.planning.base.arrays import Bools, Floats, rms
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.budget.chain import bent_path
from puncture_twin.planning.budget.guidance import (
    Sight,
    as_rehearsed,
    at_phases,
    check_way,
    corridor_mm,
    equipped,
    followers,
    guided_chances,
    guided_error,
    guided_model,
    lost_sight,
    stepped,
    target_push,
)
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.case.tables import ControlScanSection
from puncture_twin.planning.clearance.engine import normals_of
from puncture_twin.planning.geometry.containment import inside_each
from puncture_twin.planning.reach.standoff import case_axis_lengths
from puncture_twin.planning.registration.fits import INTERVAL
from puncture_twin.planning.registration.marker_noise import touches
from puncture_twin.planning.search.chances import ChanceModel, chance_model, demanding, refined_chances
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import finite
from puncture_twin.planning.uncertainty.hit import LEAST_VARIANCE, mean_over_faces
from puncture_twin.planning.uncertainty.pose_error import Bend, ErrorBudget, PoseError, error_budget, pose_error
from puncture_twin.planning.uncertainty.sources import not_modelled
from puncture_twin.twin.rehearsal.guided_trials import GuidedTrials, Way, guided_trials
from puncture_twin.twin.rehearsal.trials import Moving, Puncture, Trials, draw_trials, draw_truths

CONTACT_MM = 1e-6
"""Distance of an axis from a surface that counts as contact."""
ALLOWED = "a case with [errors] and markers: trials are drawn from them"


class Stepwise(NamedTuple):
    """Gain and cost of control scans on the path in, mean of a trial; their open loop has the same patients."""

    steps: int
    passes: float  # corrections that were executed
    correction_mm: tuple[float | None, ...]  # rms of each step's, of trials not stopped
    scans: float
    dose_msv: float  # of the scans
    seconds: float  # of the scans, to when the needle goes on
    open_loop: Distribution
    moving_s: float = 0.0  # of approach and insertion

    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        own = ("realised_rms_mm", "predicted_rms_mm", "coverage_95", "hit_share", "mean_p_hit", "touch_share")
        stated = self.open_loop.summary()
        open_loop = {name: stated[name] for name in own} | {"dose_msv": 0.0, "minutes": self.moving_s / 60.0}
        return {
            **{name: getattr(self, name) for name in ("steps", "passes", "scans", "dose_msv")},
            "minutes": (self.moving_s + self.seconds) / 60.0,
            "correction_mm": list(self.correction_mm),
            "open_loop": open_loop,
        }


@dataclass(frozen=True, eq=False)
class Distribution:
    """n trials of one puncture in which the arm reached the pose; mm."""

    seed: int
    unreached: int  # further trials, whose registration put the pose out of the arm's reach; `stopped` by the corridor
    puncture: Puncture
    trials: Trials
    cov_ct: Floats  # shape (3, 3), predicted of it, mm^2
    in_region: Bools  # shape (n,), whether it lies in the predicted 95 % ellipsoid, about the mean where one is known
    hit: Bools  # shape (n,)
    p_hit: float  # predicted; of a guided needle that it is not stopped, and hits
    structures: tuple[str, ...]
    touched: Bools  # shape (n, k)
    p_touch: Floats  # shape (k,), predicted
    wrong_belief: bool  # whether the truth was drawn from other errors than the belief declares, on purpose
    budget: ErrorBudget
    guessed_touches: bool  # whether it is not stated how the arm touched the markers, so that a posture was assumed
    not_modelled: str
    physics: Mapping[str, Any] | None = None
    """What `physics_trials` says of some of the trials in the simulator, if any."""
    guidance: str | None = None
    stopped: int = 0
    p_stop: float = 0.0
    hidden: tuple[str, ...] = ()
    looks: Mapping[str, int] = field(default_factory=dict)
    assumed: tuple[str, ...] = ()
    stepwise: Stepwise | None = None

    def __len__(self) -> int:
        return len(self.trials.tip_ct)

    @property
    def error_ct(self) -> Floats:
        """Shape (n, 3), true tip minus true target."""
        return np.asarray(self.trials.tip_ct - self.trials.target_ct)

    @property
    def tip_error_mm(self) -> Floats:
        """Distance of true tip and true target, shape (n,), mm."""
        return np.asarray(np.linalg.norm(self.error_ct, axis=1))

    @property
    def hit_share(self) -> float | None:
        """Of the trials that the arm could reach, the fraction that hit; None of none."""
        tried = len(self) + self.stopped
        return float(self.hit.sum() / tried) if tried else None

    @property
    def realised_rms_mm(self) -> float:
        """Of the tip's error."""
        return rms(self.tip_error_mm)

    @property
    def predicted_rms_mm(self) -> float:
        """Of the tip's error."""
        return float(np.sqrt(np.trace(self.cov_ct)))

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "rooms": len(self) + self.unreached + self.stopped,
            "unreached": self.unreached,
            **({} if self.guidance is None else self._guided()),
            "seed": self.seed,
            "realised_rms_mm": finite(self.realised_rms_mm),
            "predicted_rms_mm": self.predicted_rms_mm,
            "median_mm": finite(np.median(self.tip_error_mm) if len(self) else np.nan),
            "coverage_95": _fraction(self.in_region),
            "hit_share": self.hit_share,
            "mean_p_hit": self.p_hit,
            "touch_share": _fraction(np.asarray(self.touched.any(axis=1))),
            "mean_p_touch": float(min(1.0, self.p_touch.sum())),
            "touch_share_by_structure": dict(zip(self.structures, map(_fraction, self.touched.T), strict=True)),
            "p_touch_by_structure": dict(zip(self.structures, self.p_touch.tolist(), strict=True)),
            "predicted_share": dict(self.budget.fraction),
            "wrong_belief": self.wrong_belief,
            "guessed_touches": self.guessed_touches,
            **({} if self.puncture.bend is None else {"deflection_mm": self.puncture.bend.tip_mm}),
            "not_modelled": self.not_modelled,
            **({} if self.physics is None else {"physics": dict(self.physics)}),
        }

    def _guided(self) -> dict[str, Any]:
        stated = {"lost_sight": list(self.hidden), "assumed": list(self.assumed), "looks": dict(self.looks)}
        steps = {} if self.stepwise is None else self.stepwise.document()
        push = self.puncture.push
        pushed = {} if push is None else {"pushed_mm": float(push.at(np.array(push.target_mm)))}
        return {"guidance": self.guidance, "stopped": self.stopped, "p_stop": self.p_stop, **pushed, **stated, **steps}


def _fraction(trials: Bools) -> float | None:
    return float(trials.mean()) if len(trials) else None


def rehearse_trials(
    context: CaseContext, outward_ct: Floats, q_insertion: Floats, count: int, seed: int,
    guidance: str | None = None, sight: Sight | None = None, steps: int | None = None,
) -> Distribution:  # fmt: skip
    """Rehearse one direction in many trials, one at least, each with a truth of its own.

    The case declares errors and markers. The direction (3,), unit, is from the target along the needle; joints (6,),
    rad, have the tip on the target. Guidance is one of `WAYS`, in bodies that move as the case declares: every way has
    the same patients by a seed; None is by registration, in bodies at rest. Devices that the case does not declare are
    assumed; sight is what they see of the insertion, None hides nothing. Of ct with steps: after each of so many equal
    ones, the last at the target, a control scan is read and the needle corrected.

    Raises:
        InputError: The case declares no errors, has no markers, or the way is unknown, or has no steps.
        NoAnswerError: What the way's devices see does not determine the needle against the target.
    """
    query = _query(context, outward_ct, q_insertion)
    rng = np.random.default_rng(seed)
    led = stepped(guidance, steps)
    if guidance is None or led is None:
        return _measured(context, query, draw_trials(query.puncture, query.truth, count, rng), rng, seed)
    check_way(guidance)
    case, assumed = equipped(context.case, led)
    context = replace(context, case=case)
    push = target_push(case, context.anatomy, outward_ct)
    query = query._replace(puncture=replace(query.puncture, push=push))
    way, moving = _way(context, query, led, sight, steps)
    truths = draw_truths(query.puncture, query.truth, count, rng, moving)
    done = guided_trials(query.puncture, truths, query.truth, way, np.random.default_rng([seed, 4]))
    distribution = replace(_measured(context, query, done.trials, rng, seed, way, done.stopped), assumed=assumed)
    if steps is None:
        return distribution
    open_loop = rehearse_trials(context, outward_ct, q_insertion, count, seed, guidance, sight)
    return replace(distribution, stepwise=_stepwise(case.control_scan, steps, done, open_loop))


def _stepwise(scan: ControlScanSection | None, steps: int, done: GuidedTrials, open_loop: Distribution) -> Stepwise:
    assert scan is not None
    went = np.isfinite(done.moved_mm)
    sizes = tuple(rms(column[own]) if own.any() else None for column, own in zip(done.moved_mm.T, went.T, strict=True))
    passes = went.sum(axis=1)
    scans = float(np.where(done.stopped, passes + 1, steps).mean())  # the last one where a correction was refused
    return Stepwise(steps, float(passes.mean()), sizes, scans, scans * scan.dose_msv, scans * scan.seconds,
                    open_loop)  # fmt: skip


def _way(
    context: CaseContext, query: _Query, name: str, sight: Sight | None = None, steps: int | None = None
) -> tuple[Way, Moving]:
    case, puncture = context.case, query.puncture
    assert context.placement is not None and context.placement.registration is not None
    registration = context.placement.registration
    along = puncture.outward_ct, puncture.q_insertion
    model = guided_model(case, context.anatomy, query.believed, registration, *along, sight, steps)
    chance = chance_model(case, context.anatomy, context.engine, query.believed)
    assert chance is not None
    motion = np.zeros((3, 3)) if case.motion is None else case.motion.target_cov_ct
    corridor = corridor_mm(case, chance, puncture.outward_ct)
    return Way(name, model, corridor), Moving(motion, case.breathing, model.skin_weight)


def misregistered(context: CaseContext, outward_ct: Floats, q_insertion: Floats, seed: int) -> Floats:
    """E with T_believed = T_true E, shape (4, 4), mm: one registration of a case that its declared errors allow.

    Arguments and errors as of `rehearse_trials`.
    """
    query = _query(context, outward_ct, q_insertion)
    truth_trial = draw_trials(query.puncture, query.truth, 1, np.random.default_rng(seed))
    return np.asarray(np.linalg.inv(query.puncture.T_base_ct) @ truth_trial.T_base_ct[0])


class _Query(NamedTuple):
    believed: PoseError
    puncture: Puncture
    truth: ErrorModel
    guessed: bool


def _query(context: CaseContext, outward_ct: Floats, q_insertion: Floats) -> _Query:
    case = context.case
    registration = None if context.placement is None else context.placement.registration
    error = pose_error(case, registration)
    if error is None or registration is None:
        refuse("no trials can be drawn", case.path, ALLOWED, "no_markers")
    q_touch = touches(case, registration.markers)
    bend = bend_along(context, outward_ct)
    believed = replace(as_rehearsed(error, q_touch), bend=bend)
    truth = (case.truth_errors or case.errors or error.errors).scaled(error.fit.test.scale)
    puncture = Puncture(
        case.robot.model, case.needle.length_mm, registration.method, believed.fit.noise,
        registration.markers.points_ct, q_touch, registration.T_base_ct, case.target_ct, outward_ct, q_insertion, bend,
        registration.aim,
    )  # fmt: skip
    return _Query(believed, puncture, truth, registration.markers.joints is None)


def bend_along(context: CaseContext, outward_ct: Floats) -> Bend | None:
    """Deflection along one direction (3,), unit, outward, if the bevel never rotates; None for a straight needle."""
    path = bent_path(context.case, context.anatomy, outward_ct)
    return None if path is None else path.bend


def _measured(
    context: CaseContext, query: _Query, trials: Trials, rng: np.random.Generator, seed: int,
    way: Way | None = None, stopped: Bools | None = None,
) -> Distribution:  # fmt: skip
    case, puncture, q = context.case, query.puncture, query.puncture.q_insertion[None]
    off = rng.normal(size=(len(trials.reached), len(context.anatomy.checked)))  # of each surface, in deviations
    went = trials.reached if stopped is None else trials.reached & ~stopped
    unreached, trials = int((~trials.reached).sum()), trials.of(went)
    believed = about = query.believed
    model, mean_ct = chance_model(case, context.anatomy, context.engine, believed), np.zeros(3)
    assert model is not None
    if way is not None:
        believed = left = guided_error(way.model, way.name)
        about, mean_ct = left.about_breath()
    off_mm = off[went] * _surfaces(model, puncture, query.truth)
    error_ct = trials.tip_ct - trials.target_ct - mean_ct
    inverse = np.linalg.inv(about.tip_covariance_ct(q)[0] + LEAST_VARIANCE * np.eye(3))
    square = np.einsum("na,ab,nb->n", error_ct, inverse, error_ct)
    counted = () if puncture.bend is None else ("bending",)
    distribution = Distribution(
        seed=seed, unreached=unreached, puncture=puncture, trials=trials, cov_ct=believed.tip_covariance_ct(q)[0],
        in_region=square <= chdtri(3, 1 - INTERVAL), hit=_hits(context, trials, off_mm),
        p_hit=float(model.hit_chance(believed.covariance_ct(q))[0]), structures=model.structures,
        touched=_touches(context, puncture, trials, off_mm), p_touch=_touch_chances(context, puncture, model, way),
        budget=error_budget(believed, q[0], puncture.T_base_ct[:3, :3] @ puncture.outward_ct),
        wrong_belief=case.truth_errors is not None, guessed_touches=query.guessed,
        not_modelled=not_modelled(case, counted=counted),
    )  # fmt: skip
    if way is None:
        return distribution
    moving = tuple(name for name in ("breathing", "motion") if getattr(case, name) is not None)
    p_hit, p_stop = guided_chances(way.model, way.name, model, way.corridor_mm)
    return replace(
        distribution, guidance=way.name, stopped=len(went) - unreached - int(went.sum()), p_stop=p_stop, p_hit=p_hit,
        hidden=lost_sight(way.model, way.name), looks=way.model.looks_of(way.name),
        not_modelled=not_modelled(case, counted=(*counted, *moving)),
    )  # fmt: skip


def _touch_chances(context: CaseContext, puncture: Puncture, model: ChanceModel, way: Way | None) -> Floats:
    """Predicted chances to touch, shape (k,): under guidance each structure follows the target in its own way."""
    outward_ct, q = puncture.outward_ct[None], puncture.q_insertion[None]

    def touch(of: ChanceModel) -> Floats:
        return refined_chances(of, outward_ct, q, of.chances(outward_ct, q)).touch[0]

    if way is None:
        return touch(model)
    follows = [followers(context.case, context.anatomy)[column] for column in model.columns]
    chosen = np.zeros(len(follows))
    for one in set(follows):
        chances = np.mean([touch(of) for of in at_phases(way.model, way.name, model, one)], axis=0)
        chosen = np.where([its == one for its in follows], chances, chosen)
    return chosen


def _surfaces(model: ChanceModel, puncture: Puncture, truth: ErrorModel) -> Floats:
    """Deviation of each structure's surface as a whole where the needle passes it; of the target's anywhere; mm."""
    checked, outward_ct = model.anatomy.checked, puncture.outward_ct[None]
    lengths = case_axis_lengths(model.case, model.anatomy, outward_ct)
    axes = model.engine.measure(puncture.target_ct, outward_ct, lengths)
    normals = normals_of(model.engine.triangles, puncture.target_ct, outward_ct, axes)[0]
    covs = [truth.surface_cov_ct(one.voxel_ct) for one in checked]
    passed = np.nan_to_num(np.sqrt(np.einsum("ka,kab,kb->k", normals, np.array(covs), normals)))
    column = _target_column(model.anatomy, model.case)
    passed[column] = mean_over_faces(checked[column].mesh, covs[column])
    return np.asarray(passed)


def _hits(context: CaseContext, trials: Trials, off_mm: Floats) -> Bools:
    """Trials that hit: within the radius of the true target, or in the mesh of the target's own scan."""
    case = context.case
    if case.hit_radius_mm is not None:
        return np.asarray(np.linalg.norm(trials.tip_ct - trials.target_ct, axis=1) < case.hit_radius_mm)
    mesh, off = context.anatomy.structure(case.target_structure).mesh, off_mm[:, _target_column(context.anatomy, case)]
    hit = inside_each(mesh, trials.tip_ct)
    shift = np.linalg.norm(trials.tip_ct - case.target_ct, axis=1)
    for row in np.flatnonzero((off != 0) & (surface_distance(mesh, case.target_ct) - shift <= abs(off))):
        if surface_distance(mesh, trials.tip_ct[row]) <= abs(off[row]):
            hit[row] = off[row] > 0  # within the shell that moved: inside if the surface moved out
    return hit


def _target_column(anatomy: Anatomy, case: Case) -> int:
    return [one.name for one in anatomy.checked].index(case.target_structure)


def _touches(context: CaseContext, puncture: Puncture, trials: Trials, off_mm: Floats) -> Bools:
    """Structures that each trial's needle touches, shape (n, k), by FCL's capsule where no bound excludes it.

    A surface that lies farther out is touched from farther; one that lies deeper than the needle is thick is touched
    where the axis hits it as it was drawn, as in `line_chance`.
    """
    case, checked = context.case, context.anatomy.checked
    columns, outward_ct = demanding(checked), puncture.outward_ct[None]
    lengths = case_axis_lengths(case, context.anatomy, outward_ct)[0]
    distance = context.engine.measure(case.target_ct, outward_ct, lengths).distance[0]
    follows = followers(case, context.anatomy)
    turn = np.linalg.norm(trials.outward_ct - puncture.outward_ct, axis=1)
    touched = np.zeros((len(trials.tip_ct), len(columns)), bool)
    for place, column in enumerate(columns):
        length, radius = float(lengths[column]), np.maximum(case.needle.radius_mm + off_mm[:, column], CONTACT_MM)
        own = follows[column]
        tip_ct = trials.tip_ct + (1 - own.motion) * trials.motion_ct + (1 - own.breath) * trials.breath_ct
        tip_ct = tip_ct + (1 - own.push) * trials.pushed_ct
        shift = np.linalg.norm(tip_ct - case.target_ct, axis=1)
        for row in np.flatnonzero(distance[column] - shift - length * turn <= radius):  # others are surely clear
            needle = tip_ct[row], trials.outward_ct[row], length, float(radius[row])
            touched[row, place] = context.engine.collides(int(column), *needle)
    return touched
