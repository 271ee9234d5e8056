"""Guidance of a case along one direction: looks of the devices, motion of the anatomy, range of corrections.

A correction moves the needle parallel to itself. Part of it takes back what registration and arm had wrong; the rest
takes the needle to another place in the body than was planned, because the target has moved there, or is there. That
part s is what touches and the way's readings together say of it, with the body at rest. As certificates do, the
corridor trusts the clearances of the plan's own needle: with slack_j = distance to structure j - radius - margin, no
point of the needle is displaced by more than |s|, so that every needle with

    |s| <= min_j slack_j

keeps every margin in the anatomy as the CT shows it. What would go farther is not executed: the needle is stopped, and
does not hit.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.breathing.breathing import position_at
from puncture_twin.planning.budget.chain import bent_path
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import stereo_of, ultrasound_of
from puncture_twin.planning.case.tables import ControlScanSection, StereoSection, UltrasoundSection
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.needle.insertion_force import Pushed, pushed
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.reach.standoff import case_axis_lengths, case_paths, standoffs
from puncture_twin.planning.registration.fits import FitUncertainty, NoiseTest
from puncture_twin.planning.registration.marker_noise import reading_noise, touches
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.bending import path_layers
from puncture_twin.planning.search.chances import ChanceModel
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import Explanation
from puncture_twin.planning.search.phases import moving_weights
from puncture_twin.planning.uncertainty import guided
from puncture_twin.planning.uncertainty.pose_error import PoseError
from puncture_twin.planning.visibility.cameras import CameraView, Watched, camera_view
from puncture_twin.planning.visibility.probe import ProbeView, probe_view

LOOKS = 3
"""One at the standoff, the others evenly on the way in, the last with the tip at the target."""


def declared_ways(case: Case) -> tuple[str, ...]:
    """Names of the guidance whose devices a case declares, ct first."""
    lacking = {device for device, one in _DEVICES.items() if getattr(case, one) is None}
    return tuple(way for way, used in guided.WAYS.items() if not used & lacking)


_DEVICES = MappingProxyType({"cameras": "stereo", "target": "ultrasound", "tip": "ultrasound", "scan": "control_scan"})
"""Tables of a case that declare what a way reads."""


def check_way(way: str) -> None:
    """Refuse a name of guidance that is not known."""
    if way not in guided.WAYS:
        refuse(f"guidance '{way}' is not known", "--guidance", ", ".join(guided.WAYS), "unknown_guidance")


MOST_STEPS = 10


def stepped(way: str | None, steps: int | None) -> str | None:
    """The way that reads a control scan after each of so many steps; without steps, the way as it is."""
    if steps is None:
        return way
    if way != "ct":
        refuse("a control scan after each step is for one way", "--steps", "--guidance ct", "conflicting_options")
    if not 1 <= steps <= MOST_STEPS:
        refuse(f"{steps} steps", "--steps", f"1 to {MOST_STEPS} steps", "out_of_range")
    return guided.SCANS


def ways_of(text: str) -> tuple[str, ...]:
    """Names of guidance from a list with commas between them, each once."""
    ways = tuple(part.strip() for part in text.split(","))
    for row, way in enumerate(ways):
        check_way(way)
        if way in ways[:row]:
            refuse(f"guidance '{way}' is listed twice", "--guidance", "each way once", "stated_twice")
    return ways


def equipped(case: Case, way: str) -> tuple[Case, tuple[str, ...]]:
    """A case with all devices of a way: undeclared ones have the reference's defaults, and a sentence each."""
    needed, sentences = {_DEVICES[device] for device in guided.READS[way] if device in _DEVICES}, []
    if "stereo" in needed and case.stereo is None:
        cameras = stereo_of(StereoSection(), case.space, case.path)
        assert cameras is not None
        short, shaft_mm = cameras.balls_mm[-1] >= case.needle.length_mm, case.needle.shaft_mm
        cameras = replace(cameras, balls_mm=(shaft_mm / 2.0, shaft_mm)) if short else cameras
        where = " and ".join(f"{mm:g}" for mm in cameras.balls_mm)
        why = f" (half of the shaft and the hub: the needle is {case.needle.length_mm:g} mm long)" if short else ""
        sentences.append(f"[stereo] balls {where} mm behind the tip{why}, seen to {cameras.sd_mm:g} mm")
        case = replace(case, stereo=cameras)
    if "ultrasound" in needed and case.ultrasound is None:
        probe = ultrasound_of(UltrasoundSection(), case.space, case.path)
        assert probe is not None
        both = "{0[0]:g} mm in the picture and {0[1]:g} mm across"
        target, tip = both.format(probe.target_sd_mm), both.format(probe.tip_sd_mm)
        sentences.append(
            f"[ultrasound] target read to {target}, tip to {tip}, calibrated to {probe.calibration_sd_mm:g} mm"
        )
        case = replace(case, ultrasound=probe)
    if "control_scan" in needed and case.control_scan is None:
        scan = ControlScanSection()
        cost = f"{scan.dose_msv:g} mSv and {scan.seconds:g} s each"
        sentences.append(f"[control_scan] slices of {scan.slice_mm:g} mm that show the target, {cost}")
        case = replace(case, control_scan=scan)
    return case, tuple(f"assumed: {one}" for one in sentences)


def as_rehearsed(error: PoseError, q_touch: Floats) -> PoseError:
    """The pose error of trials: touched in configurations (N, 6), errors of the estimated size as if declared."""
    errors, fit = error.errors.scaled(error.fit.test.scale), error.fit
    noise = reading_noise(errors, error.model, error.tip_mm, q_touch, known=True)
    test = NoiseTest(fit.test.count, float(fit.test.freedom))
    return replace(error, errors=errors, fit=FitUncertainty(noise, fit.R_base_ct, fit.center_base, fit.fit_map, test))


@dataclass(frozen=True, eq=False)
class Sight:
    """Views of an insertion by the queried devices, and the reason where cameras have no place."""

    cameras: CameraView | None = None
    probe: ProbeView | None = None
    no_cameras: str = ""

    def sentences(self) -> Iterator[tuple[str, str]]:
        """Sentences on what the queried cameras and probe see, or why they see nothing."""
        if self.cameras is not None or self.no_cameras:
            yield "cameras", self.no_cameras if self.cameras is None else self.cameras.sentence
        if self.probe is not None:
            yield "probe", self.probe.sentence

    def hidden(self, out_mm: float) -> dict[str, str]:
        """What is out of sight with the tip so far from the target, by the names of readings, and why."""
        reasons = {}
        if self.probe is not None and self.probe.T_ct_image is None:
            reasons = dict.fromkeys(("target", "tip"), self.probe.sentence)
        if self.no_cameras:
            reasons[guided.CAMERAS] = self.no_cameras
        if self.cameras is not None:
            row = int(np.abs(self.cameras.tip_to_target_mm - out_mm).argmin())
            named = zip(self.cameras.names, self.cameras.hidden[row], strict=True)
            behind = {name: f"behind the {by.replace('_', ' ')}" for name, by in named if by}
            markers = [name for name in self.cameras.names[self.cameras.balls :] if name not in behind]
            reasons |= behind if len(markers) >= MIN_MARKERS else {**behind, guided.CAMERAS: FEW_MARKERS}
        return reasons


FEW_MARKERS = f"fewer than {MIN_MARKERS} markers are seen"


def sight_of(context: CaseContext, plan: Plan | Watched, *ways: str) -> Sight:
    """What those devices of some ways that the case declares see during a plan's insertion.

    Raises:
        InputError: The case states a place for them that cannot be used.
    """
    used, cameras, probe, lost = frozenset[str]().union(*(guided.READS[way] for way in ways)), None, None, ""
    if "cameras" in used and context.case.stereo is not None:
        try:
            cameras = camera_view(context, plan)
        except NoAnswerError as error:
            lost = str(error)
    if used & {"target", "tip"} and context.case.ultrasound is not None:
        probe = probe_view(context, plan)
    return Sight(cameras, probe, lost)


def guided_model(
    case: Case,
    anatomy: Anatomy,
    error: PoseError,
    registration: Registration,
    outward_ct: Floats,
    q: Floats,
    sight: Sight | None = None,
    steps: int | None = None,
) -> guided.GuidedModel:
    """Linear model of one insertion of a case that declares its devices.

    Joints (6,), rad, have the tip on the target. The direction (3,), unit, is from the target along the needle, whose
    error is as rehearsed. Sight None hides nothing, and has the picture along the body. With steps a control scan is
    read after each, and nothing else looks.
    """
    R, breathing = registration.T_base_ct[:3, :3], case.breathing
    breath, skin_weight = np.zeros((3, 2)), 0.0
    if breathing is not None:
        breath, skin_weight = breathing.spread_ct, moving_weights(case, breathing, anatomy).skin
    motion = np.zeros((3, 3)) if case.motion is None else case.motion.target_cov_ct
    sight = sight or Sight()
    looks = _looks(case, anatomy, error, outward_ct, q, sight, steps)
    push, push_mm = target_push(case, anatomy, outward_ct), None
    if push is not None:  # at each look, and at the end
        push_mm = push.at(push.target_mm - np.array([*(look.out_mm for look in looks), 0.0]))
    if sight.probe is not None and sight.probe.T_ct_image is not None:
        across = sight.probe.T_ct_image[:3, 2]
    else:  # the normal of the plane of the needle that comes nearest to the body's long axis
        across = np.cross(outward_ct, [0.0, 0.0, 1.0] if abs(outward_ct[2]) < 0.9 else [1.0, 0.0, 0.0])
        across = across / np.linalg.norm(across)
    return guided.GuidedModel(
        error=error,
        markers=registration.markers.names,
        points_base=apply(registration.T_base_ct, registration.markers.points_ct),
        q_insertion=q,
        looks=looks,
        motion=R @ motion @ R.T,
        breath=R @ breath,
        skin_weight=skin_weight,
        stereo=case.stereo if steps is None else None,
        ultrasound=case.ultrasound if steps is None else None,
        scan=None if steps is None else case.control_scan,
        across=R @ across,
        push=None if push_mm is None else np.outer(push_mm, -R @ outward_ct),
    )


BEYOND_TARGET_MM = 10.0
"""How far behind the target its tissues are followed: a correction may lead there."""


def target_push(case: Case, anatomy: Anatomy, outward_ct: Floats) -> Pushed | None:
    """Displacement of the target by the needle of one direction (3,), unit; None where its tissue does not say it."""
    if case.bending is None:
        return None
    length = float(case_paths(case, anatomy.skin, outward_ct[None]).path_length[0])
    if not np.isfinite(length):
        return None
    end = case.target_ct - BEYOND_TARGET_MM * outward_ct
    return pushed(path_layers(case.bending, anatomy, end, outward_ct, length + BEYOND_TARGET_MM), length)


def _looks(
    case: Case, anatomy: Anatomy, error: PoseError, outward_ct: Floats, q: Floats, sight: Sight, steps: int | None
) -> tuple[guided.Look, ...]:
    paths = case_paths(case, anatomy.skin, outward_ct[None])
    length = float(paths.path_length[0])
    standoff = float(standoffs(case.needle, length, paths.skin_angle[0]))
    parts = LOOKS - 1 if steps is None else steps
    outs = [length * (1 - step / parts) for step in range(1, parts + 1)]
    outs, looks = [standoff, *outs] if steps is None else outs, []
    for out, there in zip(outs, _drawn_back(error.model, q, outs), strict=True):
        inserted = (length - out) / length
        hidden = sight.hidden(out) | ({} if inserted > 0 else {"tip": OUTSIDE})
        looks.append(guided.Look(there, out, inserted, hidden))
    return tuple(looks)


def _drawn_back(model: UrModel, q: Floats, outs: Sequence[float] | Floats) -> Floats:
    """Joints with the needle drawn back along itself by so many mm from joints q (6,), nearest to them: (n, 6), rad."""
    T = flange_pose(model, q)
    back = np.repeat(T[None], len(outs), axis=0)
    back[:, :3, 3] -= np.asarray(outs)[:, None] * T[:3, 2]
    there = nearest_within_limits(model, inverse(model, back), q)
    off = np.where(np.isnan(there).any(axis=2), np.inf, np.abs(there - q).max(axis=2))
    return np.asarray(there[np.arange(len(there)), off.argmin(axis=1)])


def way_chances(
    context: CaseContext, outward_ct: Floats, q: Floats, sight: Sight | None = None
) -> tuple[guided.WayChance, ...]:
    """Expected error and chances of an insertion under each kind of guidance, ct first; none without devices.

    The direction (3,), unit, is from the target along the needle; joints (6,), rad, have the tip on the target; sight
    None hides nothing.
    """
    case, chance = context.case, context.chance
    ways = declared_ways(case)
    if len(ways) == 1 or chance is None or context.placement is None or context.placement.registration is None:
        return ()
    registration = context.placement.registration
    path = bent_path(case, context.anatomy, outward_ct)
    error = as_rehearsed(chance.error, touches(case, registration.markers))
    error = replace(error, bend=None if path is None else path.bend)
    model = guided_model(case, context.anatomy, error, registration, outward_ct, q, sight)
    corridor, chances = corridor_mm(case, chance, outward_ct), []
    for way in ways:
        lost = "; ".join(lost_sight(model, way))
        try:
            error_left = guided_error(model, way)
        except NoAnswerError as refused:
            chances.append(guided.WayChance(way, np.nan, np.nan, np.nan, lost or str(refused)))
            continue
        rms_mm = float(np.sqrt(np.trace(error_left.tip_covariance(q[None])[0])))
        chances.append(guided.WayChance(way, rms_mm, *guided_chances(model, way, chance, corridor), lost))
    return tuple(chances)


def with_ways(context: CaseContext, plan: Plan) -> Plan:
    """A plan with what each way of guidance would leave, the devices as the case's geometry lets them see."""
    if len(declared_ways(context.case)) == 1 or context.chance is None:
        return replace(plan, guidance=())
    sight = sight_of(context, plan, "all")
    return replace(plan, guidance=way_chances(context, plan.outward_ct, plan.insertion.q[-1], sight))


def check_ways(context: CaseContext, plan: Plan, where: str | Path) -> None:
    """Refuse a plan that states other chances by guidance than its case gives: people read them."""
    known = with_ways(context, plan).guidance
    same = len(known) == len(plan.guidance) and all(
        a.way == b.way
        and a.lost_sight == b.lost_sight
        and np.allclose(a[1:4], b[1:4], rtol=0, atol=1e-6, equal_nan=True)
        for a, b in zip(known, plan.guidance, strict=True)
    )
    if not same:
        refuse("guidance is another than the case gives", where, "plan again", "plan_of_another")


def explained_ways(context: CaseContext, explained: Explanation) -> Explanation:
    """A checked direction with what each way of guidance would leave, and what its devices see of the insertion.

    The approach, of which only a plan knows, is in nobody's way here.
    """
    case, row = context.case, explained.candidates
    q, placement = row.arm.q_insertion[0], context.placement
    declared = case.stereo is not None or case.ultrasound is not None
    if not declared or placement is None or np.isnan(q).any() or np.isnan(row.path.length[0]):
        return explained
    standoff = float(standoffs(case.needle, row.path.length[0], row.path.skin_angle[0]))
    outs = np.linspace(standoff, 0.0, max(2, int(np.ceil(standoff / WATCHED_MM))))
    joints = _drawn_back(case.robot.model, q, outs)
    if not np.isfinite(joints).all():
        return explained
    insertion = Trajectory(np.arange(len(outs), dtype=np.float64), joints)
    watched = Watched(
        case.robot.model, placement.T_base_ct, case.target_ct, row.outward_ct[0], row.path.entry_ct[0],
        case.needle.length_mm, Trajectory(insertion.times_s[:1], insertion.q[:1]), insertion,
    )  # fmt: skip
    sight = sight_of(context, watched, "all")
    return replace(explained, guidance=way_chances(context, row.outward_ct[0], q, sight), sight=dict(sight.sentences()))


WATCHED_MM = 1.0
"""Between two states of an insertion that is watched without a plan."""


def followers(case: Case, anatomy: Anatomy) -> tuple[guided.Follows, ...]:
    """How each of ``anatomy.checked`` follows the target; what is outside of the body does not but with the breath."""
    breath = np.ones(len(anatomy.checked))
    pushes = case.bending is not None and any(one.held_n_mm for one in case.bending.tissues.of_pattern.values())
    if case.breathing is not None:
        breath = moving_weights(case, case.breathing, anatomy).structures
    return tuple(  # what the needle pushes is the target's own structure alone
        guided.Follows(0.0 if one.outside else 1.0, weight, float(not pushes or one.name == case.target_structure))
        for one, weight in zip(anatomy.checked, breath.tolist(), strict=True)
    )


def lost_sight(model: guided.GuidedModel, way: str) -> tuple[str, ...]:
    """What a way's devices do not see, where and why, a sentence each; that the tip is not yet in the body is none."""
    sentences = []
    for look in model.looks:
        where = "at the target" if look.out_mm <= 0 else f"{look.out_mm:.0f} mm before the target"
        for what, why in look.hidden.items():
            if guided.device_of(what) in guided.READS[way] and why != OUTSIDE:
                sentences.append(f"{where}: {what} out of sight: {why}")
    return tuple(sentences)


OUTSIDE = "it is not in the body yet"


def guided_error(model: guided.GuidedModel, way: str, follows: guided.Follows = guided.WHOLLY) -> guided.GuidedError:
    """The pose error that a way leaves, against anatomy that follows the target so.

    Raises:
        NoAnswerError: What is in sight does not determine the tip against the target.
    """
    estimate, one = model.guided(way), model.error
    if estimate is None:
        lost = "; ".join(lost_sight(model, way)) or "its readings leave the needle's place against the CT open"
        raise NoAnswerError(f"guidance '{way}' does not see enough: {lost}", code="lost_sight")
    if follows != guided.WHOLLY:
        cov, breath = model.left(estimate.gain, follows)
        estimate = estimate._replace(cov=cov, breath=breath, tip_cov=cov[:3, :3])  # no picture shows this anatomy
    return guided.GuidedError(one.model, one.tip_mm, one.target_base, one.errors, one.fit, one.bend, estimate)


PHASES = 8
"""Positions of the breath, of equal chances, over which chances are averaged: it is neither about 0 nor normal."""


def at_phases(
    model: guided.GuidedModel, way: str, chance: ChanceModel, follows: guided.Follows = guided.WHOLLY
) -> list[ChanceModel]:
    """The chances of a way's needle against such anatomy at each position of the breath in the gate, known there."""
    error, breathing, deviations = guided_error(model, way, follows), chance.case.breathing, np.zeros(1)
    if breathing is not None:
        gate = 1.0 if breathing.gate is None else breathing.gate
        s = position_at((np.arange(PHASES) + 0.5) / PHASES, gate, breathing.exponent)
        mean_mm, deviation_mm = breathing.direction_ct @ breathing.spread_ct
        moved_mm = (s - breathing.scanned_at) * breathing.amplitude_mm
        deviations = (moved_mm - mean_mm) / max(deviation_mm, guided.ALIKE_MM)
    return [chance.led(*error.about_breath(deviation)) for deviation in deviations.tolist()]


def guided_chances(model: guided.GuidedModel, way: str, chance: ChanceModel, corridor_mm: float) -> tuple[float, float]:
    """The chance that a way's needle is not stopped, and hits, and the chance that it is stopped."""
    q, p_stop = model.q_insertion[None], model.stop_chance(way, corridor_mm)
    hit = [one.hit_chance(one.error.covariance_ct(q))[0] for one in at_phases(model, way, chance)]
    return (1.0 - p_stop) * float(np.mean(hit)), p_stop


def corridor_mm(case: Case, chance: ChanceModel, outward_ct: Floats) -> float:
    """Largest correction of the needle in the body away from its plan, mm; see the module."""
    lengths = case_axis_lengths(case, chance.anatomy, outward_ct[None])
    distance = chance.engine.measure(case.target_ct, outward_ct[None], lengths).distance[0][chance.columns]
    return float(max((distance - chance.breaking).min(initial=np.inf), 0.0))
