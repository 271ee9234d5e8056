"""`calibrate dynamics`: an arm's dynamics from recorded torques, and the tip error that their error causes.

The controller of `twin.world.control` feeds the identified dynamics forward; what they err by, tau = Y_b db with db of
the covariance C, its spring takes, with the masses L of the tip halfway along the insertion:

    L e'' + D e' + K (e + K_i int e) = J^-T Y_b db less that at rest at the standoff,        e = 0 there,

which is linear in db: e = G db, and the tip's covariance is G C G'.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import cont2discrete

from puncture_twin.planning.anatomy.anatomy import load_anatomy
from puncture_twin.planning.arm.dynamics import Identified, JointMotion, identify, read_torques, regressor
from puncture_twin.planning.arm.insertion import first_stop
from puncture_twin.planning.arm.inverse_kinematics import branch_of, inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose, slowed
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.text import Facts, Shown
from puncture_twin.planning.budget.what_if import source_costs
from puncture_twin.planning.case.case import Case, bed_frame
from puncture_twin.planning.collision.workcell import case_tool, home_configuration
from puncture_twin.planning.motion.exciting import PERIOD_S, exciting_motion
from puncture_twin.planning.motion.follow import follow_smoothly
from puncture_twin.planning.motion.path_check import dense_states, first_contact
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Trajectory
from puncture_twin.planning.registration.placement import reached_insertion
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.uncertainty.hit import radius_for_chance
from puncture_twin.planning.uncertainty.sources import SOURCES
from puncture_twin.twin.jobs.patient.budget import budget_chain
from puncture_twin.twin.plant.torque_recording import recorded_torques, recording_text
from puncture_twin.twin.report.present import Block, Field, Section, Warn, facts, grid, text
from puncture_twin.twin.world.client import to_m, to_mm
from puncture_twin.twin.world.control import Stiffness, damping, reference_of, tips

STEP_RAD = 0.02  # between two states of an exciting motion that are checked for contact
HOLD_S = 0.5  # after the insertion


@dataclass(frozen=True, eq=False, repr=False)
class Dynamics(Shown):
    """Identified dynamics, and the tip that is controlled by them.

    ``tip_cov`` (m, 3, 3), mm^2, is of the tip about its path along an insertion, base frame, a row a sample; ``budget``
    of the declared errors, rms by source, mm, None where none are declared.
    """

    identified: Identified
    tip_cov: Floats
    budget: dict[str, float] | None

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        fit, worst = self.identified, self.tip_cov[np.trace(self.tip_cov, axis1=1, axis2=2).argmax()]
        path_mm, end_mm = (float(np.sqrt(np.trace(one))) for one in (worst, self.tip_cov[-1]))
        costs = None if self.budget is None else {"the identified dynamics": end_mm, **self.budget}
        friction = fit.friction.transpose(1, 0, 2).tolist()
        return {
            "rows": fit.rows,
            "base_parameters": len(fit.values),
            "condition": fit.condition,
            "unexplained": fit.unexplained,
            "columns": fit.base.columns.tolist(),
            "values": fit.values.tolist(),
            "covariance": fit.covariance.tolist(),
            "joints": [
                {
                    "joint": joint + 1,
                    "coulomb_nm": coulomb,
                    "coulomb_sd_nm": coulomb_sd,
                    "viscous_nm_s": viscous,
                    "viscous_sd_nm_s": viscous_sd,
                    "torque_sd_nm": float(fit.torque_sd_nm[joint]),
                }
                for joint, ((viscous, viscous_sd), (coulomb, coulomb_sd)) in enumerate(friction)
            ],
            "tip_path_mm": path_mm,
            "tip_path_95_mm": path_mm * radius_for_chance(worst / path_mm**2, 0.95),
            "tip_end_mm": end_mm,
            "budget": None if costs is None else [{"text": name, "alone_mm": mm} for name, mm in costs.items()],
            "expected_mm": None if costs is None else float(np.linalg.norm(list(costs.values()))),
            "findings": [one.document() for one in fit.findings()],
        }

    def _facts(self) -> Facts:
        yield from self.identified._facts()
        off = "{tip_path_mm:.4f}, {tip_end_mm:.4f}".format_map(self.summary())
        yield "tip off its path, mm (rms at most, at the end)", off

    def text(self) -> str:
        """For a person."""
        report = self.summary()
        budget: list[Block] = [] if report["budget"] is None else [
            f"Expected tip error with the identified dynamics: {report['expected_mm']:.4f} mm (rms)",
            grid((Field("source", "text"), Field("alone", "alone_mm", 4, "mm")), report["budget"]),
        ]  # fmt: skip
        return text([
            Section(f"dynamics, {report['rows']:,} rows", [facts(FACTS, report), grid(JOINTS, report["joints"])]),
            Section("error budget", budget),
            Section("", [Warn(tuple(one["sentence"] for one in report["findings"]))]),
        ])  # fmt: skip


FACTS = (
    Field("base parameters", "base_parameters"),
    Field("condition of the motion", "condition", 1),
    Field("tip off its path along an insertion, rms where it is most", "tip_path_mm", 4, "mm"),
    Field("tip off its path there, 95 %", "tip_path_95_mm", 4, "mm"),
    Field("tip off its path at the target, rms", "tip_end_mm", 4, "mm"),
)
JOINTS = (
    Field("joint", "joint"),
    Field("Coulomb friction", "coulomb_nm", 3, "N m"),
    Field("sd", "coulomb_sd_nm", 4),
    Field("viscous friction", "viscous_nm_s", 3, "N m s/rad"),
    Field("sd", "viscous_sd_nm_s", 4),
    Field("torque about the model", "torque_sd_nm", 3, "N m"),
)


def calibrate_dynamics(context: CaseContext, recording: Path) -> Dynamics:
    """The identified dynamics of a case's arm, with what their error costs at the tip.

    Raises InputError: The arm's base is not stated, no insertion is reached, or the recording cannot be used.
    """
    case, T_base_ct = context.case, context.require_arm().T_base_ct
    fit = identify(case.robot.model, read_torques(recording), gravity(case, T_base_ct), where=recording)
    placed = context.placement
    registration = None if placed is None else placed.registration
    anatomy = partial(load_anatomy, case, cache=user_cache())
    chain = None if registration is None else budget_chain(case, registration, anatomy)
    q_end = reached_insertion(case, T_base_ct) if chain is None else chain.q_insertion
    if q_end is None:
        refuse("the arm reaches no insertion", case.path, "a target within the arm's reach", "out_of_reach")
    budget = None if chain is None else {SOURCES[one.source].text: one.alone_mm for one in source_costs(chain)}
    return Dynamics(fit, tip_covariances(case, fit, insertion_to(case, q_end), gravity(case, T_base_ct)), budget)


def gravity(case: Case, T_base_ct: Floats) -> Floats:
    """Gravity in the base frame, shape (3,), unit."""
    return np.asarray(-T_base_ct[:3, :3] @ bed_frame(case)[:3, 2])


def insertion_to(case: Case, q_end: Floats) -> Trajectory:
    """Insertion of the needle along itself to q_end (6,), rad: over its shaft, or as much of it as the arm can."""
    model, T_end = case.robot.model, flange_pose(case.robot.model, q_end)
    back = np.arange(0.0, case.needle.shaft_mm + 1.0)
    T = np.tile(T_end, (len(back), 1, 1))
    T[:, :3, 3] -= back[:, None] * T_end[:3, 2]
    q = nearest_within_limits(model, inverse(model, T)[:, branch_of(model, q_end[None])[0]], q_end)
    stop = first_stop(model, q, back)
    q = q if stop is None else q[back < stop.depth_mm]
    if len(q) < 2:
        refuse("the arm cannot move the needle along itself", case.path, "a target within reach", "out_of_reach")
    speeds = case.robot.speeds
    return follow_smoothly(
        slowed(model, speeds), q[::-1], back[: len(q)], max_tip_speed_mm_s=speeds.insertion_speed_mm_s
    )


def _loop(model: UrModel, fit: Identified, q: Floats, J: Floats, down_base: Floats) -> tuple[Floats, Floats]:
    """A (18, 18) and B (18, 6) of a sample's step of e, e' and int e, under a wrench, about the joints q (6,), rad."""
    motion = JointMotion(np.tile(q, (7, 1)), np.zeros((7, 6)), np.eye(7, 6))
    torque = regressor(model, motion, down_base)[:, :, fit.base.columns] @ fit.values
    M = np.asarray((torque[:6] - torque[6]).T)  # kg m^2, drives included: of unit accelerations less those of none
    stiffness, inverse_mass = Stiffness(), J @ np.linalg.solve(M, J.T)
    K, D = np.diag(stiffness.diagonal), damping(stiffness, J, M)
    spring = [-inverse_mass @ part for part in (K, D, stiffness.integral_per_s * K)]
    none, one = np.zeros((6, 6)), np.eye(6)
    A = np.block([[none, one, none], spring, [one, none, none]])
    stepped = cont2discrete((A, np.vstack([none, inverse_mass, none]), np.eye(18), np.zeros((18, 6))), SAMPLE_S)
    return stepped[0], stepped[1]


def tip_covariances(case: Case, fit: Identified, insertion: Trajectory, down_base: Floats) -> Floats:
    """Covariance of the tip about its path, shape (m, 3, 3), mm^2, base frame, by the equation above.

    A sample's step takes the wrench of its middle: friction begins and ends with the motion, at once.
    """
    model, tip_m = case.robot.model, float(to_m(case.needle.length_mm))
    reference = reference_of(model, tip_m, insertion, SAMPLE_S / 2, HOLD_S)
    motion = JointMotion(reference.q, reference.speed, reference.acceleration)
    Y = regressor(model, motion, down_base)[:, :, fit.base.columns]
    J = tips(model, tip_m, reference.q).J
    wrench = np.linalg.solve(J.transpose(0, 2, 1), Y)
    half = len(J) // 2
    A, B = _loop(model, fit, reference.q[half], J[half], down_base)
    pushes = wrench[1::2] - wrench[0]
    state, G = np.zeros((18, len(fit.values))), np.empty((len(pushes), 3, len(fit.values)))
    for row, push in enumerate(pushes):
        G[row] = to_mm(state[:3])
        state = A @ state + B @ push
    return np.asarray(G @ fit.covariance @ G.transpose(0, 2, 1))


def recorded_or_given(context: CaseContext, recording: Path | None, record: Path | None, seed: int) -> Path:
    """The recording that is named, or a new one, of `record_dynamics`; not both, nor neither."""
    if recording is not None and record is None:
        return recording
    if record is None or recording is not None:
        refuse("one recording is needed", "calibrate dynamics", "--recording FILE or --record FILE", "missing_option")
    return record_dynamics(context, record, seed)


def record_dynamics(context: CaseContext, path: Path, seed: int) -> Path:
    """Record torques of the simulated arm in an exciting motion, twice over, into a new CSV; the seed draws both.

    Raises InputError: The arm's base is not stated, or the file cannot be written. NoAnswerError: No exciting motion is
    free of contact.
    """
    case, reach = context.case, context.require_arm()
    model, down, checker = slowed(case.robot.model, case.robot.speeds), gravity(case, reach.T_base_ct), reach.checker
    free = lambda q: first_contact(checker, dense_states(checker, q, STEP_RAD)) is None  # noqa: E731 - one of the arguments
    series = exciting_motion(model, down, home_configuration(case), free, seed)
    times = np.arange(0.0, 2.0 * PERIOD_S, SAMPLE_S)
    motion = series.at(times)
    torque = recorded_torques(case.robot.model, case_tool(case), down, motion, np.random.default_rng(seed))
    with atomic(path) as temporary:
        temporary.write_text(recording_text(times, motion, torque))
    return path
