"""Poses in which the needle shows in the image, both arms can stand, and nothing touches.

The geometry of the picture is drawn first (where the tip shows, how steep the needle is, how the probe is tilted); the
arms follow by inverse kinematics. Every draw that cannot be taken falls to a reason, and the reasons are counted.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.guidance.ultrasound.simulate import needle_orientations
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
    """n draws: where the probe is to be, and how the needle is to stand in its image."""

    T_base1_image: Floats
    """Shape (n, 4, 4), mm."""
    tip_mm: Floats
    """Shape (n, 2), in the image."""
    direction_image: Floats
    """Shape (n, 2), unit, toward the tip."""
    roll: Floats
    """The needle about itself, shape (n,), rad."""


class CandidatePoses(NamedTuple):
    """Poses that can be recorded, by the drawing, and what became of the other draws."""

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
    """What is believed before anything is calibrated."""
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
    """Draw, solve, check.

    Args:
        case: The room.
        workcell: Its collision checker.
        rng: For the draws.

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
        raise NoAnswerError(f"no pose of {n} can be taken: {counts}", counts=counts)
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
    """T_base1_end1 and T_base2_end2 that make the picture, by the drawing; each (n, 4, 4)."""
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


def configurations(model: UrModel, T_base_flange: Floats, q_home: Floats) -> list[Floats]:
    """All configurations within the limits that hold each flange pose, the nearest to home first; each (k, 6), rad."""
    q = nearest_within_limits(model, inverse(model, T_base_flange), q_home)
    away = np.linalg.norm(q - q_home, axis=-1)
    order = np.argsort(np.where(np.isnan(away), np.inf, away), axis=1)
    return [rows[near][~np.isnan(rows[near, 0])] for rows, near in zip(q, order, strict=True)]


def _checked_pose(workcell: TwoArms, inside: bool, probe: Floats, needle: Floats) -> str | tuple[Floats, Floats]:
    """The first pair of configurations that stands free, or the reason why none does."""
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
