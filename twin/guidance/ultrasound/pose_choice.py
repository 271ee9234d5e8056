"""Poses that both arms can take with the needle in the image, and the choice of those to record.

The geometry of the image is drawn first (where the tip shows, how steep the needle is, how the probe is tilted); the
arms follow by inverse kinematics. Every draw that cannot be taken falls to a reason, and the reasons are counted.

Those are recorded that tell most about the error at the tip. The bound can count errors of the arms that all poses
share, as unknowns with a prior behind the parameters (their deviations are 1): poses that repeat one of them do not
average it out, and poses that show it correct the aim. The choice does not count them: so chosen, a region from found
noise holds the truth less often than it says.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.geometry.rigid import exp_rotation, frame_about, frame_yz
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms, arm_errors
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import Estimate, active_columns, parameter_units
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, linear_model
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import whitener
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.guidance.ultrasound.two_arms import Touching, TwoArms, inside_phantom

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
    """n drawn geometries: pose of the probe, and the needle in its image."""

    T_base1_image: Floats
    """Shape (n, 4, 4), mm."""
    tip_mm: Floats
    """Shape (n, 2), in the image."""
    direction_image: Floats
    """Shape (n, 2), unit, toward the tip."""
    roll: Floats
    """The needle about itself, shape (n,), rad."""


class CandidatePoses(NamedTuple):
    """Poses that can be recorded, by the drawing, and the reasons of the other draws."""

    q_probe: Floats
    """Shape (n, 6), rad."""
    q_needle: Floats
    """Shape (n, 6), rad."""
    poses: Recording
    """A and B by the drawing's kinematics; the tip and the direction as they should show."""
    roll: Floats
    """The needle about itself, shape (n,), rad."""
    counts: dict[str, int]
    """Draws by reason; ``ok`` for those that are here."""


def drawing(case: SelfcalCase) -> Estimate:
    """The nominal drawing, believed before anything is calibrated."""
    X, Y = case.T_end1_image, case.T_base1_base2
    V = case.tip_end2 / np.linalg.norm(case.tip_end2)
    return Estimate(X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3], case.tip_end2, np.ones(2), V)


def draw_geometry(case: SelfcalCase, n: int, rng: np.random.Generator) -> ImageGeometry:
    """Probe poses on the phantom and needles in their images."""
    poses, phantom = case.content.poses, case.content.phantom
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
    T[:, 2, 3] += phantom.top_mm[2] + phantom.gel_mm - _lowest_corner(case, T)
    tip = np.column_stack([rng.uniform(EDGE_MM, width - EDGE_MM, n), rng.uniform(LEAST_DEPTH_MM, depth - EDGE_MM, n)])
    steep = np.radians(rng.uniform(*poses.insertion_deg, n))
    side = rng.choice([-1.0, 1.0], n)  # from the image's right or left
    direction = np.column_stack([side * np.cos(steep), np.sin(steep)])
    return ImageGeometry(T, tip, direction, rng.uniform(-np.pi, np.pi, n))


def _lowest_corner(case: SelfcalCase, T_base1_image: Floats) -> Floats:
    """Height of the lowest corner of the probe's face, base1, shape (n,)."""
    width, _ = case.content.image.imager().size_mm
    head = case.content.probe.head_mm
    u = 0.5 * width + 0.5 * head[0] * np.array([-1.0, -1.0, 1.0, 1.0])
    z = 0.5 * head[2] * np.array([-1.0, 1.0, -1.0, 1.0])
    corners = np.stack([u, np.zeros(4), z])
    heights = T_base1_image[:, 2, :3] @ corners + T_base1_image[:, 2, 3:4]
    return np.asarray(heights.min(axis=1))


def find_candidates(case: SelfcalCase, workcell: TwoArms, rng: np.random.Generator) -> CandidatePoses:
    """Draw geometries, solve for both arms, check contacts.

    Raises:
        NoAnswerError: No draw can be taken; it holds the counts.
    """
    n = case.content.poses.samples
    seen = draw_geometry(case, n, rng)
    belief = drawing(case)
    goals = _flange_goals(case, belief, seen)
    homes = [np.radians(arm.home_deg) for arm in (case.content.probe_arm, case.content.needle_arm)]
    branches = [
        configurations(model, goal, home)
        for model, goal, home in zip((workcell.probe_model, workcell.needle_model), goals, homes, strict=True)
    ]
    tips = np.einsum("nij,nj->ni", seen.T_base1_image[:, :3, :2], seen.tip_mm) + seen.T_base1_image[:, :3, 3]
    inside = inside_phantom(case.content.phantom, tips)
    answers = [_checked_pose(workcell, bool(inside[i]), branches[0][i], branches[1][i]) for i in range(n)]
    taken = np.array([i for i, answer in enumerate(answers) if not isinstance(answer, str)], dtype=np.int64)
    counted = Counter(answer if isinstance(answer, str) else "ok" for answer in answers)
    counts = {reason: counted.get(reason, 0) for reason in ("ok", *REASONS)}
    pairs = [answer for answer in answers if not isinstance(answer, str)]
    q = np.array(pairs, dtype=np.float64).reshape(-1, 2, 6)
    if len(taken) == 0:
        raise NoAnswerError(f"no pose of {n} can be taken: {counts}", counts=counts, code="no_pose")
    poses = Recording(
        goals[0][taken],
        goals[1][taken],
        seen.tip_mm[taken],
        seen.direction_image[taken],
        q_probe=q[:, 0],
        q_needle=q[:, 1],
    )
    return CandidatePoses(q[:, 0], q[:, 1], poses, seen.roll[taken], counts)


def _flange_goals(case: SelfcalCase, belief: Estimate, seen: ImageGeometry) -> tuple[Floats, Floats]:
    """T_base1_end1 and T_base2_end2 that make the image, by the drawing; each (n, 4, 4)."""
    A = seen.T_base1_image @ np.linalg.inv(case.T_end1_image)
    T_base2_image = np.linalg.inv(case.T_base1_base2) @ seen.T_base1_image
    along = np.column_stack([seen.direction_image, np.zeros(len(seen.roll))])
    tip = np.column_stack([seen.tip_mm, np.zeros(len(seen.roll))])
    return A, needle_flange(T_base2_image, tip, along, seen.roll, belief.t_Q, belief.V)


def needle_flange(
    T_base2_image: Floats, tip_image: Floats, along_image: Floats, roll: Floats, tip_end2: Floats, V: Floats
) -> Floats:
    """T_base2_end2 with the needle's tip at points of the image and the needle along directions there.

    Args:
        T_base2_image: Shape (n, 4, 4), mm.
        tip_image: Shape (n, 3), mm.
        along_image: Shape (n, 3), unit, toward the tip, not along the image's normal.
        roll: Shape (n,), rad, about the needle.
        tip_end2: Shape (3,), mm.
        V: The needle's direction in end2, shape (3,), unit.
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
    """The first pair of configurations that is free, or the reason why none is."""
    if not inside:
        return TIP_OUTSIDE
    if len(probe) == 0:
        return PROBE_REACH
    if len(needle) == 0:
        return NEEDLE_REACH
    free_probe = [q for q in probe if workcell.probe_free(q)]
    if not free_probe:
        return Touching.PROBE_ARM.value
    free_needle = [q for q in needle if workcell.needle_free(q)]
    if not free_needle:
        return Touching.NEEDLE_ARM.value
    for q_probe in free_probe:
        for q_needle in free_needle:
            if workcell.apart(q_probe, q_needle):
                return q_probe, q_needle
    return Touching.BOTH.value


PRIOR_WEIGHT = 1e-6
"""Information that every parameter is taken to have beforehand, as a fraction of a candidate's; for the first picks."""

NO_INFORMATION = 1e-13
"""Least over largest eigenvalue of an information matrix below which nothing but rounding is left."""

N_FREE = len(active_columns(tip=True, scale=False, direction=False))
"""Parameters of the calibration; the arms' errors stand behind them."""

MAX_SWEEPS = 20
"""How often all chosen poses are looked at for a better exchange."""

WORTH = 1e-4
"""An exchange must lower the mean squared error by this fraction."""


class _Design(NamedTuple):
    """Information of every candidate, and the quantity to be known."""

    rows: Floats
    """Jacobian of each candidate over its residuals' spread, shape (n, 3, p), p of parameters and arms' errors: its
    information is rows^T rows."""
    wanted: Floats
    """Mean of J^T J over the workspace, shape (p, p): trace(C wanted) is the mean squared error at the tip."""
    base: Floats
    """Information held beforehand, shape (p, p)."""

    def information(self, index: int) -> Floats:
        """Information of one candidate, shape (p, p)."""
        return np.asarray(self.rows[index].T @ self.rows[index])


def choose_poses(
    candidates: Recording,
    n: int,
    noise: Noise,
    prior: Calibration | Estimate,
    *,
    recorded: Recording | None = None,
) -> NDArray[np.int_]:
    """Choose poses by Fisher information: greedily, then by exchange until no single exchange helps.

    What is minimised is the mean squared error at the tip over all candidates: A-optimal for that error.

    Args:
        candidates: Poses that could be recorded, with the tip where it would show.
        n: How many to choose.
        prior: A rough calibration, such as the drawing's: 10 deg and 20 mm off will do.
        recorded: Poses that are recorded already and count.

    Returns:
        Indices into the candidates, ascending.

    Raises:
        InputError: More poses wanted than there are candidates, or none.
    """
    if not 0 < n <= len(candidates):
        refuse(f"{n} poses of {len(candidates)} candidates", "pose choice", "1 to all of them", "out_of_range")
    prior = prior.estimate if isinstance(prior, Calibration) else prior
    design = _design(candidates, _Belief(noise, prior, None), recorded)
    chosen: list[int] = []
    H = design.base
    for _ in range(n):
        chosen.append(_best(design, H, chosen))  # greedy: the next one that lowers the error most
        H = H + design.information(chosen[-1])
    return np.sort(_exchanged(design, H, chosen))


class _Belief(NamedTuple):
    """The belief before anything is recorded."""

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
    active = active_columns(tip=True, scale=False, direction=False)
    errors = None if belief.arms is None else arm_errors(belief.arms, recording)
    model = linear_model(Problem(recording, belief.noise, active, arms=errors), belief.prior)
    J = model.jacobian * parameter_units(active, belief.prior.scale)
    return (J if model.shared is None else np.concatenate([J, model.shared], axis=2)), model.sigma


def _whitened(recording: Recording, belief: _Belief) -> Floats:
    slopes, sigma = _slopes(recording, belief)
    return np.asarray(whitener(sigma, np.ones((len(recording), 3))) @ slopes)


def _wanted(workspace: Recording, belief: _Belief) -> Floats:
    J, _ = _slopes(workspace, belief)
    return np.asarray((J.transpose(0, 2, 1) @ J).mean(axis=0))


def _design(candidates: Recording, belief: _Belief, recorded: Recording | None) -> _Design:
    rows = _whitened(candidates, belief)
    base = _with_prior(PRIOR_WEIGHT * np.diag((rows**2).sum(axis=1).mean(axis=0)))  # makes H invertible
    if recorded is not None:
        known = _whitened(recorded, belief).reshape(-1, rows.shape[2])
        base = base + known.T @ known
    return _Design(rows, _wanted(candidates, belief), base)


def _value(design: _Design, H: Floats) -> float:
    """Mean squared error at the tip, mm^2."""
    return float(np.trace(np.linalg.solve(H, design.wanted)))


def _values_with(design: _Design, H: Floats) -> Floats:
    """The value with each candidate added, shape (n,), by Woodbury's identity: only 3 x 3 systems are solved."""
    C = np.linalg.inv(H)
    GC = design.rows @ C
    S = np.eye(3) + GC @ design.rows.transpose(0, 2, 1)
    gained = np.linalg.solve(S, GC @ design.wanted @ GC.transpose(0, 2, 1))
    return np.asarray(_value(design, H) - np.trace(gained, axis1=1, axis2=2))


def _best(design: _Design, H: Floats, without: list[int]) -> int:
    """The candidate whose addition leaves the least value."""
    values = _values_with(design, H)
    values[without] = np.inf
    return int(np.argmin(values))


def _exchanged(design: _Design, H: Floats, chosen: list[int]) -> NDArray[np.int_]:
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
