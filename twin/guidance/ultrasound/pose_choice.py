"""Poses that both arms can take with the needle in the image, the choice of those to record, and aims by a calibration.

Each arm alone is checked as everywhere (:class:`planning.collision.fast_checker.FastChecker`: itself, the table, the
phantom); the two arms against each other as in :mod:`planning.collision.two_arms`. Everything is placed where the
*drawing* has it; the clearance covers what the truth differs by.

The geometry of the image is drawn first (where the tip shows, how steep the needle is, how the probe is tilted); the
arms follow by inverse kinematics. Every draw that cannot be taken falls to a reason, and the reasons are counted.

Those are recorded that tell most about the error at the tip. The bound can count errors of the arms that all poses
share, as unknowns with a prior behind the parameters (their deviations are 1): poses that repeat one of them do not
average it out, and poses that show it correct the aim. The choice does not count them: so chosen, a region from found
noise holds the truth less often than it says.
"""

from collections import Counter
from enum import StrEnum
from functools import cache
from itertools import product
from typing import NamedTuple

import fcl
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints, rms
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.collision.bodies import surface, touch
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.two_arms import BetweenArms, handle_tool, head_body
from puncture_twin.planning.geometry.gauss_newton import whitener
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import exp_rotation, frame_about, frame_yz, pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms, arm_errors
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import Estimate, Problem, active_columns, parameter_units
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import PhantomSection, SelfcalCase

TABLE_MM = (1800.0, 1200.0, 40.0)
TABLE_GAP_MM = 0.5
"""The table ends so far below the bases' plane: the bases stand on it, and nothing else should."""


class Touching(StrEnum):
    """Contact because of which a pair of configurations is refused."""

    PROBE_ARM = "probe_arm_collision"
    NEEDLE_ARM = "needle_arm_collision"
    BOTH = "arms_collide"


def between_arms(case: SelfcalCase, T_end1_image: Floats, T_base1_base2: Floats, clearance_mm: float) -> BetweenArms:
    """Both arms of a case, so far apart, with probe's head and needle's arm at these poses (4, 4), mm."""
    head = head_body(head_pose(case, T_end1_image), np.array(case.content.probe.head_mm), clearance_mm)
    tools = (probe_tool(case), needle_tool(case))
    return BetweenArms(case.models, tools, head, T_base1_base2, clearance_mm)


class TwoArms:
    """FCL's verdict on both arms. Not for several threads at once: FCL's objects are moved for each question."""

    def __init__(self, case: SelfcalCase) -> None:
        content = case.content
        self.probe_model, self.needle_model = case.models
        clearance = content.poses.clearance_mm
        phantom, table = phantom_mesh(content.phantom), table_box(content.phantom)
        T_base2_base1 = np.asarray(np.linalg.inv(case.T_base1_base2), dtype=np.float64)
        box = Box(table.name, T_base2_base1 @ table.T_base_box, table.size_mm)
        tools = (probe_tool(case), needle_tool(case))
        self._probe = FastChecker(self.probe_model, tools[0], [table], phantom, padding_mm=clearance)
        phantom_base2 = phantom.transformed(T_base2_base1)
        self._needle = FastChecker(self.needle_model, tools[1], [box], phantom_base2, padding_mm=clearance)
        self._between = between_arms(case, case.T_end1_image, case.T_base1_base2, clearance)
        self._phantom = fcl.CollisionObject(surface(phantom))
        placed = fcl.Transform(table.T_base_box[:3, :3], table.T_base_box[:3, 3])
        self._table = fcl.CollisionObject(fcl.Box(*table.size_mm), placed)

    def probe_free(self, q: Floats) -> bool:
        """Whether the probe's arm touches neither itself, table nor phantom at ``q`` (6,), rad."""
        if self._probe.contact(q, needle_may_touch_patient=False) is not None:
            return False
        self._between.place_probe(q)
        head = self._between.probe_bodies[-1]
        if touch(head.bare.surface.made, self._phantom) or touch(head.full.surface.made, self._table):
            return False
        return not self._between.head_touches_own_arm(q)

    def needle_free(self, q: Floats) -> bool:
        """Whether the needle's arm touches neither itself, table nor, but for the needle, the phantom."""
        return self._needle.contact(q, needle_may_touch_patient=True) is None

    def apart(self, q_probe: Floats, q_needle: Floats) -> bool:
        """Whether the two arms keep their clearance from each other."""
        return self._between.apart(q_probe, q_needle)

    def verdict(self, q_probe: Floats, q_needle: Floats) -> Touching | None:
        """The contact, or None."""
        if not self.probe_free(q_probe):
            return Touching.PROBE_ARM
        if not self.needle_free(q_needle):
            return Touching.NEEDLE_ARM
        return None if self.apart(q_probe, q_needle) else Touching.BOTH


def probe_tool(case: SelfcalCase) -> Tool:
    """The probe's handle, as a tool of the arm: to the head's back."""
    probe = case.content.probe
    return handle_tool(probe.length_mm - probe.head_mm[1], probe.handle_diameter_mm)


def needle_tool(case: SelfcalCase) -> Tool:
    """The needle and its holder."""
    needle = case.content.needle
    return Tool(needle.length_mm, needle.shaft_mm, needle.diameter_mm, needle.holder_diameter_mm)


def head_pose(case: SelfcalCase, T_end1_image: Floats) -> Floats:
    """T_end1_head: the head's middle; x along the face, y into the depth, z across the slice; shape (4, 4), mm."""
    width, _ = case.content.image.imager().size_mm
    T = np.array(T_end1_image)
    T[:3, 3] += T[:3, :3] @ [0.5 * width, -0.5 * case.content.probe.head_mm[1], 0.0]
    return T


def table_box(phantom: PhantomSection) -> Box:
    """The table under both arms, base1."""
    center = [phantom.top_mm[0], phantom.top_mm[1], -TABLE_GAP_MM - TABLE_MM[2] / 2.0]
    return Box("table", pose(np.eye(3), center), TABLE_MM)


@cache
def phantom_mesh(phantom: PhantomSection) -> TriangleMesh:
    """A block with rounded edges, base1, mm, closed: the sum of a smaller block and a ball."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=phantom.round_mm)
    inner = np.array(phantom.size_mm) - 2.0 * phantom.round_mm
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * inner
    hull = trimesh.convex.convex_hull((corners[:, None] + ball.vertices).reshape(-1, 3))
    middle = np.array(phantom.top_mm) - [0.0, 0.0, phantom.size_mm[2] / 2.0]
    return TriangleMesh(np.asarray(hull.vertices) + middle, np.asarray(hull.faces))


def inside_phantom(phantom: PhantomSection, points: Floats) -> Bools:
    """Whether points (n, 3), base1, lie in the block; exact, from its definition."""
    half = np.array(phantom.size_mm) / 2.0 - phantom.round_mm
    middle = np.array(phantom.top_mm) - [0.0, 0.0, phantom.size_mm[2] / 2.0]
    beyond = np.maximum(np.abs(points - middle) - half, 0.0)
    return np.asarray(np.linalg.norm(beyond, axis=1) < phantom.round_mm)


EDGE_MM = 6.0
"""The tip is drawn no nearer to the image's sides, nor above 12 mm: the drawing may be wrong by a few mm."""
LEAST_DEPTH_MM = 12.0
PHANTOM_FRACTION = 0.3
"""The face's middle is drawn within this fraction of the phantom's width from its middle."""
TIP_OUTSIDE = "tip_outside_phantom"
PROBE_REACH = "probe_out_of_reach"
NEEDLE_REACH = "needle_out_of_reach"
REASONS = (TIP_OUTSIDE, PROBE_REACH, NEEDLE_REACH, *(reason.value for reason in Touching))
"""In the order in which they are queried."""


class ImageGeometry(NamedTuple):
    """n drawn geometries."""

    T_base1_image: Floats  # shape (n, 4, 4), mm
    tip_mm: Floats  # shape (n, 2), in the image
    direction_image: Floats  # shape (n, 2), unit, toward the tip
    roll: Floats  # shape (n,), rad, of the needle about itself


class CandidatePoses(NamedTuple):
    """n poses that can be recorded."""

    q_probe: Floats  # shape (n, 6), rad
    q_needle: Floats  # shape (n, 6), rad
    poses: Recording  # A and B by the drawing's kinematics; the tip and the direction as they should show
    roll: Floats  # shape (n,), rad, of the needle about itself
    counts: dict[str, int]  # of the draws, by reason; ``ok`` for those that are here


def drawing(case: SelfcalCase) -> Estimate:
    """The nominal drawing, believed before anything is calibrated."""
    X, Y = case.T_end1_image, case.T_base1_base2
    V = case.tip_end2 / np.linalg.norm(case.tip_end2)
    return Estimate(X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3], case.tip_end2, np.ones(2), V)


def draw_geometry(case: SelfcalCase, n: int, rng: np.random.Generator) -> ImageGeometry:
    """Probe poses on the phantom and needles in their images."""
    poses, phantom, head = case.content.poses, case.content.phantom, case.content.probe.head_mm
    yaw = rng.uniform(-poses.yaw_deg, poses.yaw_deg, n) + case.content.needle_arm.yaw_deg - 180.0
    tilts = rng.uniform(-poses.tilt_deg, poses.tilt_deg, (n, 2))
    turn = Rotation.from_euler("ZXY", np.column_stack([yaw, tilts]), degrees=True)
    down = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # u along x, v down, z = u x v
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = turn.as_matrix() @ down
    half = PHANTOM_FRACTION * np.array(phantom.size_mm[:2])
    face = np.column_stack([rng.uniform(-half, half, (n, 2)) + phantom.top_mm[:2], np.zeros(n)])
    width, depth = case.content.image.imager().size_mm
    T[:, :3, 3] = face - 0.5 * width * T[:, :3, 0]
    u = 0.5 * width + 0.5 * head[0] * np.array([-1.0, -1.0, 1.0, 1.0])
    corners = np.stack([u, np.zeros(4), 0.5 * head[2] * np.array([-1.0, 1.0, -1.0, 1.0])])  # of the probe's face
    heights = T[:, 2, :3] @ corners + T[:, 2, 3:4]
    T[:, 2, 3] += phantom.top_mm[2] + phantom.gel_mm - heights.min(axis=1)
    tip = np.column_stack([rng.uniform(EDGE_MM, width - EDGE_MM, n), rng.uniform(LEAST_DEPTH_MM, depth - EDGE_MM, n)])
    steep = np.radians(rng.uniform(*poses.insertion_deg, n))
    side = rng.choice([-1.0, 1.0], n)  # from the image's right or left
    direction = np.column_stack([side * np.cos(steep), np.sin(steep)])
    return ImageGeometry(T, tip, direction, rng.uniform(-np.pi, np.pi, n))


def find_candidates(case: SelfcalCase, workcell: TwoArms, rng: np.random.Generator) -> CandidatePoses:
    """Draw geometries, solve for both arms, check contacts.

    Raises:
        NoAnswerError: No draw can be taken; it holds the counts.
    """
    n, belief = case.content.poses.samples, drawing(case)
    T_base1_image, tip_mm, direction_image, roll = draw_geometry(case, n, rng)
    A = T_base1_image @ np.linalg.inv(case.T_end1_image)
    T_base2_image = np.linalg.inv(case.T_base1_base2) @ T_base1_image
    tip, along = (np.column_stack([one, np.zeros(n)]) for one in (tip_mm, direction_image))
    B = needle_flange(T_base2_image, tip, along, roll, belief.t_Q, belief.V)
    homes = (np.radians(arm.home_deg) for arm in (case.content.probe_arm, case.content.needle_arm))
    probe, needle = (configurations(*one) for one in zip(case.models, (A, B), homes, strict=True))
    tips = np.einsum("nij,nj->ni", T_base1_image[:, :3, :2], tip_mm) + T_base1_image[:, :3, 3]
    inside = inside_phantom(case.content.phantom, tips)
    answers = [_checked_pose(workcell, bool(inside[i]), probe[i], needle[i]) for i in range(n)]
    counted = Counter(answer if isinstance(answer, str) else "ok" for answer in answers)
    counts = {reason: counted.get(reason, 0) for reason in ("ok", *REASONS)}
    taken = np.array([i for i, answer in enumerate(answers) if not isinstance(answer, str)], dtype=np.int64)
    if len(taken) == 0:
        raise NoAnswerError(f"no pose of {n} can be taken: {counts}", counts=counts, code="no_pose")
    q = np.array([answer for answer in answers if not isinstance(answer, str)], dtype=np.float64).reshape(-1, 2, 6)
    poses = Recording(A[taken], B[taken], tip_mm[taken], direction_image[taken], q_probe=q[:, 0], q_needle=q[:, 1])
    return CandidatePoses(q[:, 0], q[:, 1], poses, roll[taken], counts)


def needle_flange(
    T_base2_image: Floats, tip_image: Floats, along_image: Floats, roll: Floats, tip_end2: Floats, V: Floats
) -> Floats:
    """T_base2_end2 (n, 4, 4), mm: the needle's tip at points (n, 3) of the image, the needle along directions (n, 3).

    Directions are unit, toward the tip, not along the image's normal; ``roll`` (n,), rad, is about the needle. The tip
    (3,), mm, and the needle's direction V (3,), unit, are in end2.
    """
    T = np.tile(np.eye(4), (len(roll), 1, 1))
    T[:, :3, :3] = T_base2_image[:, :3, :3] @ needle_orientations(along_image, V, roll)
    tip = np.einsum("nij,nj->ni", T_base2_image[:, :3, :3], tip_image) + T_base2_image[:, :3, 3]
    T[:, :3, 3] = tip - T[:, :3, :3] @ tip_end2
    return T


def needle_orientations(along_image: Floats, direction_end2: Floats, roll: Floats) -> Floats:
    """M, from end2 to image, that lays V along given unit vectors and turns the needle about itself; (n, 3, 3)."""
    across = np.cross(along_image, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    image = frame_yz(across, along_image)
    end2 = frame_about(direction_end2)
    turn = exp_rotation(np.column_stack([np.zeros((len(roll), 2)), roll]))
    return np.asarray(image @ turn @ end2.T)


def configurations(model: UrModel, T_base_flange: Floats, q_home: Floats) -> list[Floats]:
    """Configurations within the limits that reach each flange pose, nearest to home first; each (k, 6), rad."""
    q = nearest_within_limits(model, inverse(model, T_base_flange), q_home)
    away = np.linalg.norm(q - q_home, axis=-1)
    order = np.argsort(np.where(np.isnan(away), np.inf, away), axis=1)
    return [rows[near][~np.isnan(rows[near, 0])] for rows, near in zip(q, order, strict=True)]


def _checked_pose(workcell: TwoArms, inside: bool, probe: Floats, needle: Floats) -> str | tuple[Floats, Floats]:
    for stops, reason in ((not inside, TIP_OUTSIDE), (not len(probe), PROBE_REACH), (not len(needle), NEEDLE_REACH)):
        if stops:
            return reason
    free_probe = [q for q in probe if workcell.probe_free(q)]
    if not free_probe:
        return Touching.PROBE_ARM.value
    free_needle = [q for q in needle if workcell.needle_free(q)]
    if not free_needle:
        return Touching.NEEDLE_ARM.value
    pairs = (pair for pair in product(free_probe, free_needle) if workcell.apart(*pair))
    return next(pairs, Touching.BOTH.value)


PRIOR_WEIGHT = 1e-6
"""Information that every parameter is taken to have beforehand, as a fraction of a candidate's; for the first picks."""
NO_INFORMATION = 1e-13
"""Least over largest eigenvalue of an information matrix below which nothing but rounding is left."""
N_FREE = len(active_columns(scale=False, direction=False))
"""Parameters of the calibration; the arms' errors stand behind them."""
MAX_SWEEPS = 20
"""How often all chosen poses are looked at for a better exchange."""
WORTH = 1e-4
"""An exchange must lower the mean squared error by this fraction."""


class _Design(NamedTuple):
    """Information of every candidate, and the quantity to be known; p parameters and arms' errors."""

    rows: Floats  # shape (n, 3, p), Jacobian of each candidate over its residuals' spread
    wanted: Floats  # shape (p, p), mean of J^T J over the workspace: trace(C wanted) is the tip's mean squared error

    def information(self, index: int) -> Floats:
        """Information of one candidate, shape (p, p)."""
        return np.asarray(self.rows[index].T @ self.rows[index])


def choose_poses(
    candidates: Recording, n: int, noise: Noise, prior: Estimate, *, recorded: Recording | None = None
) -> Ints:
    """Choose poses by Fisher information: greedily, then by exchange until no single exchange helps.

    What is minimised is the mean squared error at the tip over all candidates, poses that could be recorded, with the
    tip where it would show: A-optimal for that error. The prior is rough, such as the drawing's: 10 deg and 20 mm off
    will do. Poses that are recorded already count. Returns indices of n candidates, ascending.

    Raises:
        InputError: More poses wanted than there are candidates, or none.
    """
    if not 0 < n <= len(candidates):
        refuse(f"{n} poses of {len(candidates)} candidates", "pose choice", "1 to all of them", "out_of_range")
    belief = _Belief(noise, prior, None)
    rows = _whitened(candidates, belief)
    H = _with_prior(PRIOR_WEIGHT * np.diag((rows**2).sum(axis=1).mean(axis=0)))  # makes H invertible
    if recorded is not None:
        known = _whitened(recorded, belief).reshape(-1, rows.shape[2])
        H = H + known.T @ known
    design, chosen = _Design(rows, _wanted(candidates, belief)), list[int]()
    for _ in range(n):
        chosen.append(_best(design, H, chosen))  # greedy: the next one that lowers the error most
        H = H + design.information(chosen[-1])
    return np.sort(_exchanged(design, H, chosen))


class _Belief(NamedTuple):
    noise: Noise
    prior: Estimate
    arms: DeclaredArms | None


def expected_tre_mm(
    poses: Recording, noise: Noise, prior: Estimate, workspace: Recording, arms: DeclaredArms | None = None
) -> float:
    """Cramer-Rao bound of the rms error at the tip over a workspace, mm, if these poses are recorded.

    Infinite where they leave a combination of the unknowns free. ``arms``: both arms' lasting errors; every
    recording then needs joints. None takes all errors of flanges for noise.
    """
    belief = _Belief(noise, prior, arms)
    rows = _whitened(poses, belief)
    H = np.einsum("nip,niq->pq", rows, rows)
    values = np.linalg.eigvalsh(H[:N_FREE, :N_FREE])
    if values[0] <= NO_INFORMATION * values[-1]:
        return float("inf")
    return float(np.sqrt(np.trace(np.linalg.solve(_with_prior(H), _wanted(workspace, belief)))))


def _with_prior(H: Floats) -> Floats:
    """Information with the prior of the arms' errors: their deviation is 1."""
    return H + np.diag((np.arange(len(H)) >= N_FREE).astype(float))


def _slopes(recording: Recording, belief: _Belief) -> tuple[Floats, Floats]:
    """Residuals by parameters in their units and by the arms' errors, (n, 3, p), and their own noise, (n, 3, 3)."""
    active = active_columns(scale=False, direction=False)
    errors = None if belief.arms is None else arm_errors(belief.arms, recording)
    model = Problem(recording, belief.noise, active, arms=errors).linear_model(belief.prior)
    J = model.jacobian * parameter_units(active, belief.prior.scale)
    return (J if model.shared is None else np.concatenate([J, model.shared], axis=2)), model.sigma


def _whitened(recording: Recording, belief: _Belief) -> Floats:
    slopes, sigma = _slopes(recording, belief)
    return np.asarray(whitener(sigma, np.ones((len(recording), 3))) @ slopes)


def _wanted(workspace: Recording, belief: _Belief) -> Floats:
    J, _ = _slopes(workspace, belief)
    return np.asarray((J.transpose(0, 2, 1) @ J).mean(axis=0))


def _value(design: _Design, H: Floats) -> float:
    """Mean squared error at the tip, mm^2."""
    return float(np.trace(np.linalg.solve(H, design.wanted)))


def _best(design: _Design, H: Floats, without: list[int]) -> int:
    """The candidate whose addition leaves the least value; by Woodbury's identity only 3 x 3 systems are solved."""
    GC = design.rows @ np.linalg.inv(H)
    S = np.eye(3) + GC @ design.rows.transpose(0, 2, 1)
    gained = np.linalg.solve(S, GC @ design.wanted @ GC.transpose(0, 2, 1))
    values = np.asarray(_value(design, H) - np.trace(gained, axis1=1, axis2=2))
    values[without] = np.inf
    return int(np.argmin(values))


def _exchanged(design: _Design, H: Floats, chosen: list[int]) -> Ints:
    """Give each chosen pose up for the best other one, until none is worth it (Fedorov 1972)."""
    for _ in range(MAX_SWEEPS):
        changed = False
        for place, index in enumerate(list(chosen)):
            without = H - design.information(index)  # information adds up over poses
            best = _best(design, without, chosen[:place] + chosen[place + 1 :])
            after = without + design.information(best)
            if best != index and _value(design, after) < (1 - WORTH) * _value(design, H):
                chosen[place], H, changed = best, after, True
        if not changed:
            break
    return np.array(chosen)


AIM_STEPS = 3
"""Iterations of the command that counts the needle arm's errors: each leaves a thousandth of what was left before."""


def aim(
    candidates: CandidatePoses, row: int, target_mm: Floats, calibration: Calibration, models: tuple[UrModel, UrModel]
) -> Floats:
    """Commanded joints of the needle's arm by its nominal kinematics and the calibration: (6,), rad; NaN out of reach.

    A candidate's row says probe pose, insertion and roll; the target (2,), mm, is in the image; the models are the
    probe's and the needle's arm, as they are drawn.
    """
    poses = candidates.poses
    assert poses.v is not None  # candidates are made with directions
    q = candidates.q_needle[row]
    A, _ = calibration.corrected(poses.subset(slice(row, row + 1)))
    T_base2_image = np.linalg.inv(calibration.Y) @ A[0] @ calibration.X
    tip, along = np.array([[*target_mm, 0.0]]), np.array([[*poses.v[row], 0.0]])
    roll = candidates.roll[row : row + 1]
    V, Q = calibration.needle_direction_end2, calibration.tip_end2
    goal = needle_flange(T_base2_image[None], tip, along, roll, Q, V)[0]
    command = goal
    for _ in range(AIM_STEPS):
        q = nearest_configuration(models[1], command, q)
        if calibration.arms is None or np.isnan(q).any():
            break
        recorded = recorded_pose(models, candidates.q_probe[row], q, target_mm)
        command = recorded.B[0] @ np.linalg.inv(calibration.corrected(recorded)[1][0]) @ goal
    return q


def expected_error_mm(calibration: Calibration, poses: Recording) -> float:
    """Expected (rms) distance of the tip from where the image has it, over poses with joints."""
    return float(np.sqrt(np.mean(np.trace(calibration.tip_covariances(poses), axis1=1, axis2=2))))


def predicted_tre(calibration: Calibration, recording: Recording) -> float:
    """Expected (rms) error at the recorded tips, mm: from the calibration, the declared arms, an image that errs."""
    known = rms(calibration.predicted_tre_mm(recording.P, recording.A)) if calibration.arms is None else None
    image_mm = calibration.image.rms_mm if calibration.image is not None and calibration.image.significant else 0.0
    return float(np.hypot(expected_error_mm(calibration, recording) if known is None else known, image_mm))


def recorded_pose(models: tuple[UrModel, UrModel], q_probe: Floats, q_needle: Floats, tip_mm: Floats) -> Recording:
    """One pose as both controllers print it, with the tip at a point of the image."""
    A, B = flange_pose(models[0], q_probe), flange_pose(models[1], q_needle)
    return Recording(A[None], B[None], tip_mm[None, :2], q_probe=q_probe[None], q_needle=q_needle[None])


def nearest_configuration(model: UrModel, T_base_flange: Floats, q_near: Floats) -> Floats:
    """The nominal arm's configuration for a flange pose that is nearest to another, shape (6,), rad; NaN for none."""
    q = nearest_within_limits(model, inverse(model, T_base_flange)[0], q_near)
    away = np.linalg.norm(q - q_near, axis=1)
    return np.array(q[int(np.argmin(np.where(np.isnan(away), np.inf, away)))])
