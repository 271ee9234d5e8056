"""The planning of touches: poses in which the arm's errors cancel best at the target, a short tour, its motions.

`plan_touches` is the list of its stages: markers that can be touched, a pose for each, a tour through them.

For a pivot calibration the tip stays on one place, and the needle is tilted to several sides (`plan_pivot`).
The place is a hole or a dimple next to the patient. Of the free poses those are taken that leave the tip least
uncertain: greedily, the next one that adds most to det(A'A) of `R_i x + p_i = c` (D-optimal design).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import away_from_singularities, flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import InputError, NoAnswerError, refuse
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.case.case import bed_frame
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.workcell import case_boxes, case_tool, home_configuration, outside_surface
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import Method
from puncture_twin.planning.registration.marker_noise import marker_noise, reading_noise
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS, MarkerPairs
from puncture_twin.planning.registration.placement import aim_at, aimed
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.tour_motions import (
    TIP_MM,
    ApproachCheckers,
    NoMotionError,
    Stops,
    TouchPlan,
    TouchTour,
    tour_through,
    why_not,
)
from puncture_twin.planning.uncertainty.pose_error import PoseError, expected_error_mm, least_error, touch_candidates

PLANNED_PADDING_MM = 4.0
"""Distance of a touching needle's shaft from the patient in a plan: the markers are only believed to be there."""
TOUCHING_PADDING_MM = 1.0
"""Distance of the needle's shaft from the patient while touching, when the needle's line was set onto the marker."""
ALLOWED = "a case with [errors] and markers"

MOST_MARKERS = 12
"""Markers at most: the shortest tour of more takes too long to find."""


def plan_touches(context: CaseContext, q_insertion: Floats, *, seed: int, progress: Count) -> TouchPlan:
    """Plan to touch every marker that can be touched, for an insertion: joints (6,), rad, the tip on the target.

    Raises:
        InputError: The case declares no errors, or has no markers, or too many.
        NoAnswerError: Fewer than three can be touched, or they lie on a line, or no motion home was found.
    """
    every = _task(context, q_insertion)
    touchable = _touchable(every)
    while True:  # until a motion leads to each marker that is left
        task = every.of(touchable.rows)
        error = _error(task, every, touchable.left_out)
        chosen, worst = (least_error(error, touchable.candidates, q_insertion, worst=worst) for worst in (False, True))
        stops = Stops(task.markers.names, task.markers.points_base, chosen)
        try:
            tour = tour_through(context, stops, seed=seed, progress=progress)
        except NoMotionError as none:
            touchable = touchable.without(none.place, task.markers.names[none.place], str(none))
            continue
        expected_mm, worst_mm = task.expected_mm(chosen), task.expected_mm(worst)
        return TouchPlan(**vars(tour), left_out=touchable.left_out, expected_mm=expected_mm, worst_mm=worst_mm)


@dataclass(frozen=True, eq=False)
class _Task:
    """Some markers of a case, and the insertion that they are touched for."""

    context: CaseContext
    markers: MarkerPairs
    method: Method
    q_insertion: Floats  # shape (6,), rad, the tip on the target

    @property
    def model(self) -> UrModel:
        """The arm."""
        return self.context.case.robot.model

    @property
    def tip_mm(self) -> float:
        """Flange to tip."""
        return self.context.case.needle.length_mm

    def of(self, rows: Sequence[int]) -> _Task:
        """The task for some of its markers."""
        at, names = list(rows), self.markers.names
        points_ct, points_base = self.markers.points_ct[at], self.markers.points_base[at]
        return replace(self, markers=MarkerPairs(tuple(names[row] for row in at), points_ct, points_base))

    def error(self, q_touch: Floats) -> PoseError:
        """The pose error after touches in configurations (n, 6) or one (6,), rad."""
        case = self.context.case
        assert case.errors is not None
        q = np.broadcast_to(q_touch, (len(self.markers), 6))
        noise = reading_noise(case.errors, self.model, self.tip_mm, q, known=True)
        target_ct = case.target_ct
        fitted = register(self.markers, method=self.method, target_ct=target_ct, noise=noise, accept_residuals=True)
        if self.method == "joint":  # the pose is corrected for the insertion
            fitted = aimed(fitted, aim_at(self.model, self.tip_mm, target_ct, self.q_insertion))
        assert fitted.uncertainty is not None
        target = apply(fitted.T_base_ct, target_ct)
        return PoseError(self.model, self.tip_mm, target, case.errors, fitted.uncertainty)

    def expected_mm(self, q_touch: Floats) -> float:
        """Expected (rms) error of the tip at the target, mm."""
        return expected_error_mm(self.error(q_touch), self.q_insertion)


class _Touchable(NamedTuple):
    """The markers that can be touched, as rows, with free touch poses (n, 6) for each, and why the others cannot."""

    rows: tuple[int, ...]
    candidates: tuple[Floats, ...]
    left_out: dict[str, str]

    def without(self, place: int, name: str, why: str) -> _Touchable:
        """The touchable markers without that at index ``place`` of ``rows``."""
        rows = self.rows[:place] + self.rows[place + 1 :]
        candidates = self.candidates[:place] + self.candidates[place + 1 :]
        return _Touchable(rows, candidates, {**self.left_out, name: why})


def _error(task: _Task, every: _Task, left_out: Mapping[str, str]) -> PoseError:
    why = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
    count = f"{len(task.markers)} of {len(every.markers)} markers can be touched"
    if len(task.markers) < MIN_MARKERS:
        raise NoAnswerError(f"{count}; {MIN_MARKERS} are needed: {why}", code="too_few_markers")
    try:
        return task.error(task.q_insertion)
    except InputError as error:
        what = f"{count}, too few: {error.what}" + (f"; {why}" if why else "")
        raise NoAnswerError(what, code=error.code) from error


def expected_of_touches(context: CaseContext, q_insertion: Floats, read: NamedPoints) -> float:
    """Expected (rms) error of the tip at the target, mm, with these touches alone, for an insertion (6,), rad."""
    task, read = _task(context, q_insertion), _in_order(context, read)
    assert read.joints is not None
    return task.of([task.markers.names.index(name) for name in read.names]).expected_mm(read.joints)


def _in_order(context: CaseContext, read: NamedPoints) -> NamedPoints:
    """Touches in the order of the case's markers, in which its own registration takes them: a triad depends on it."""
    assert context.placement is not None and context.placement.registration is not None and read.joints is not None
    names = context.placement.registration.markers.names
    rows = sorted(range(len(read.names)), key=lambda row: names.index(read.names[row]))
    return NamedPoints(tuple(read.names[row] for row in rows), read.points[rows], read.space, None, read.joints[rows])


def registered(context: CaseContext, read: NamedPoints) -> Registration:
    """The registration by touched markers: names, points (N, 3), mm, and joints (N, 6), rad, in any order."""
    placement, case = context.placement, context.case
    assert placement is not None and placement.registration is not None and case.errors is not None
    markers, read = placement.registration.markers, _in_order(context, read)
    rows = [markers.names.index(name) for name in read.names]
    pairs = MarkerPairs(read.names, markers.points_ct[rows], read.points, read.joints)
    noise = marker_noise(case, case.errors, pairs, where="touched markers")
    method = cast(Method, placement.registration.method)
    fitted = register(pairs, method=method, target_ct=case.target_ct, noise=noise, accept_residuals=True)
    aim = placement.registration.aim
    return fitted if aim is None else aimed(fitted, aim)


def _task(context: CaseContext, q_insertion: Floats) -> _Task:
    placement = context.placement
    if context.reach is None or placement is None or placement.registration is None or context.case.errors is None:
        refuse("no touches can be planned", context.case.path, ALLOWED, "no_markers")
    markers = placement.registration.markers
    if len(markers) > MOST_MARKERS:
        allowed = f"at most {MOST_MARKERS}; choose with registration.use"
        refuse(plural(len(markers), "marker"), f"{context.case.path}: registration", allowed, "too_many")
    believed = MarkerPairs(markers.names, markers.points_ct, apply(placement.T_base_ct, markers.points_ct))
    return _Task(context, believed, cast(Method, placement.registration.method), q_insertion)


def approach_checkers(context: CaseContext, needle_padding_mm: float) -> ApproachCheckers:
    """Two checkers of the workcell: with the case's needle, and with one without tip and with more padding."""
    assert context.reach is not None
    tool = case_tool(context.case)
    short = replace(tool, needle_length_mm=tool.needle_length_mm - TIP_MM, shaft_mm=tool.shaft_mm - TIP_MM)
    case, anatomy, T_base_ct = context.case, context.anatomy, context.reach.T_base_ct
    model, boxes, skin = case.robot.model, case_boxes(case, T_base_ct), anatomy.skin.mesh.transformed(T_base_ct)
    outside = outside_surface(anatomy)
    outside = None if outside is None else outside.transformed(T_base_ct)
    blunted = FastChecker(model, short, boxes, skin, outside=outside, padding_mm=needle_padding_mm, cache=user_cache())
    return ApproachCheckers(context.reach.checker, blunted)


def _touchable(task: _Task) -> _Touchable:
    checkers = approach_checkers(task.context, PLANNED_PADDING_MM)
    rows, candidates, left_out = [], [], {}
    for row, (name, point) in enumerate(zip(task.markers.names, task.markers.points_base, strict=True)):
        reasons: list[str] = []
        for q in touch_candidates(task.model, task.tip_mm, point, task.q_insertion):  # the insertion's own branch first
            blocked_by = [why_not(checkers, task.tip_mm, one) for one in q]
            free = q[[not reason for reason in blocked_by]]
            if len(free):
                rows.append(row)
                candidates.append(free)
                break
            reasons += blocked_by
        else:  # what blocks most often
            left_out[name] = max(set(reasons), key=reasons.count) if reasons else "out of the arm's reach"
    return _Touchable(tuple(rows), tuple(candidates), left_out)


LEAST_POSES, MOST_POSES = 4, 12
"""Poses of a pivot: for more the best order takes too long to find."""
SPREAD = 2
"""So many free poses are wanted for each that is taken: else they lean to one side."""
RADII = (0.6, 0.8, 0.45)
"""Distances from the shoulder at which the flange is tried, over the arm's reach without its wrist."""
HEIGHTS = (0.0, 0.3, -0.3, 0.6)
"""Heights above the shoulder at which the flange is tried, over the same reach."""
SIDES = 12
"""Directions from the base in which the flange is tried."""
ROLLS = (0.0, 2 * np.pi / 3, -2 * np.pi / 3)
"""Rolls of the flange about the needle, added to each tilt: they tell how far the tip is off the flange's axis."""
RIDGE = 1e-6
"""Added to A'A, so that fewer poses than unknowns can be compared."""


def plan_pivot(context: CaseContext, count: int, *, place_base: Floats | None, seed: int, progress: Count) -> TouchTour:
    """Plan to set the tip onto one place in several poses, named P1, P2 and so on.

    The place (3,), mm, base frame, is found next to the patient where none is given.

    Raises:
        InputError: The case has no arm.
        NoAnswerError: No place, or not this one, can be touched in so many poses, or no motion was found.
    """
    context.require_arm()
    checkers = approach_checkers(context, PLANNED_PADDING_MM)
    places, most = _places(context) if place_base is None else [place_base], 0
    for place in places:
        free = _free_poses(context, checkers, place, count)
        most = max(most, len(free))
        if len(free) < count:
            continue
        q = free[spread_poses(flange_pose(checkers.whole.model, free)[:, :3, :3], count)]
        stops = Stops(tuple(f"P{row + 1}" for row in range(count)), np.tile(place, (count, 1)), q)
        try:
            return tour_through(context, stops, seed=seed, progress=progress)
        except NoMotionError:
            continue
    where = "no point was found that can" if place_base is None else "this point cannot"
    what = f"{where} be touched in {count} poses by collision-free motions: {most} poses at most"
    raise NoAnswerError(what, code="too_few_poses")


def spread_poses(R_base_flange: Floats, count: int) -> list[int]:
    """Rows of ``count`` rotations (n, 3, 3) that determine the tip best, the first one first."""
    A = np.concatenate([R_base_flange, np.broadcast_to(-np.eye(3), R_base_flange.shape)], axis=2)
    squares = np.swapaxes(A, 1, 2) @ A
    rows, whole = [0], squares[0] + RIDGE * np.eye(6)
    while len(rows) < count:
        gains = np.linalg.slogdet(whole + squares).logabsdet
        gains[rows] = -np.inf
        rows.append(int(np.argmax(gains)))
        whole = whole + squares[rows[-1]]
    return rows


def _places(context: CaseContext) -> Iterator[Floats]:
    """Places about the base, base frame, mm: those opposite the patient first."""
    assert context.reach is not None
    model, up = context.case.robot.model, _up_base(context)
    reach = abs(model.a2) + abs(model.a3)
    target = apply(context.reach.T_base_ct, context.case.target_ct)
    away = (target @ up) * up - target
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    across = np.cross(up, away)
    for radius in RADII:
        for height in HEIGHTS:
            for side in sorted(np.linspace(-np.pi, np.pi, SIDES, endpoint=False), key=abs):
                flange = model.shoulder_base + reach * (radius * (np.cos(side) * away + np.sin(side) * across))
                yield flange + (reach * height - context.case.needle.length_mm) * up


def _up_base(context: CaseContext) -> Floats:
    """Unit direction against gravity, base frame."""
    assert context.reach is not None
    return np.asarray(context.reach.T_base_ct[:3, :3] @ bed_frame(context.case)[:3, 2])


def _free_poses(context: CaseContext, checkers: ApproachCheckers, place_base: Floats, count: int) -> Floats:
    """Joints (n, 6), rad, with the tip on a place that nothing obstructs, from above first."""
    model, tip_mm = checkers.whole.model, context.case.needle.length_mm
    home = home_configuration(context.case)
    down = inverse(model, flange_poses(place_base, _up_base(context), tip_mm)).reshape(-1, 6)
    down = nearest_within_limits(model, down, home)
    down = down[~np.isnan(down).any(axis=1)]
    down = down[away_from_singularities(model, down)]
    for q in down[np.argsort(np.abs(down - home).max(axis=1), kind="stable")]:
        if why_not(checkers, tip_mm, q):
            continue
        tilted = touch_candidates(model, tip_mm, place_base, q).alike
        if len(tilted) < SPREAD * count:
            continue
        every = (tilted + roll * np.eye(6)[5] for roll in ROLLS)
        free = np.array([one for q in every for one in q if not why_not(checkers, tip_mm, one)]).reshape(-1, 6)
        if len(free) >= count:
            return np.asarray(free)
    return np.empty((0, 6))
