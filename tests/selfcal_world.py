"""What the tests of the self-calibration share: recordings that show too little, and the truth as an estimate."""

import numpy as np

from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import Estimate, tip_residuals
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import OPTIONAL, Recording
from puncture_twin.twin.guidance.ultrasound.pose_choice import needle_orientations
from puncture_twin.twin.plant.simulated_recording import (
    ImagePose,
    draw_image_poses,
    draw_probe_poses,
    draw_truth,
    exact_recording,
)

DEGENERATE = {
    "probe never turns": ("probe_orientation", 3),
    "probe turns about one axis": ("probe_axis", 1),
    "needle never turns": ("needle_orientation", 3),
    "needle turns about one axis": ("needle_axis", 1),
    "tip never moves in the image": ("tip_position", 3),
    "tip moves on a line": ("tip_line", 1),
    "constant insertion angle": ("insertion_angle", 1),
    "insertion angle 45 +- 1 deg": ("insertion_angle", 1),
    "needle never rolls": ("needle_roll", 1),
    "needle never turns in the image": ("needle_in_image", 3),
}
"""Name of the set, cause that must be named, and how many motions are free."""


def as_estimate(truth):
    X, Y = truth.X, truth.Y
    return Estimate(X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3], truth.tip_end2, np.ones(2), truth.direction_end2)


def degenerate_set(name, seed=3, n=24):
    rng = np.random.default_rng(seed)
    truth = draw_truth(rng)
    A, seen = np.array(draw_probe_poses(rng, truth, n)), draw_image_poses(rng, n)
    if name == "probe never turns":
        A[:, :3, :3] = A[0, :3, :3]
    elif name == "probe turns about one axis":
        A[:, :3, :3] = A[0, :3, :3] @ exp_rotation(np.outer(rng.uniform(-0.43, 0.43, n), [0.6, 0.8, 0.0]))
    elif name.startswith("needle never turns") and not name.endswith("image"):
        A = with_needle_turns(truth, A, seen, np.zeros((n, 3)))
    elif name == "needle turns about one axis":
        A = with_needle_turns(truth, A, seen, np.outer(rng.uniform(-1, 1, n), [0.0, 0.6, 0.8]))
    elif name == "tip never moves in the image":
        seen = seen._replace(tip_mm=np.tile([5.0, 30.0], (n, 1)))
    elif name == "tip moves on a line":
        u = rng.uniform(-25, 25, n)
        seen = seen._replace(tip_mm=np.column_stack([u, 30 + 0.5 * u]))
    elif name == "constant insertion angle":
        seen = seen._replace(insertion=np.full(n, np.radians(45)))
    elif name == "insertion angle 45 +- 1 deg":
        seen = seen._replace(insertion=np.radians(45 + rng.uniform(-1, 1, n)))
    elif name == "needle never rolls":
        seen = seen._replace(roll=np.zeros(n))
    elif name == "needle never turns in the image":
        seen = seen._replace(roll=np.zeros(n), insertion=np.full(n, np.radians(45)))
    else:
        raise KeyError(name)
    return truth, A, seen


def with_needle_turns(truth, A, seen, turns):
    """A such that the needle's flange has these orientations and the needle shows as wished."""
    along = np.column_stack([np.cos(seen.insertion), np.sin(seen.insertion), np.zeros(len(A))])
    M = needle_orientations(along, truth.direction_end2, seen.roll)
    R_B = truth.Y[:3, :3].T @ A[0, :3, :3] @ truth.X[:3, :3] @ M[0] @ exp_rotation(turns)
    turned = np.array(A)
    turned[:, :3, :3] = truth.Y[:3, :3] @ R_B @ M.transpose(0, 2, 1) @ truth.X[:3, :3].T
    return turned


def cured(truth, recording, seen, suggestion):
    """The proposed poses as the two arms would really record them: the needle brought into the image by the truth."""
    rows = [recording.names.index(pose.reference) for pose in suggestion.poses]
    A = np.array([pose.A for pose in suggestion.poses])
    wished = ImagePose(
        seen.tip_mm[rows] + np.array([pose.tip_shift_mm for pose in suggestion.poses]),
        seen.insertion[rows] + np.array([pose.insertion_change for pose in suggestion.poses]),
        seen.roll[rows] + np.array([pose.needle_roll for pose in suggestion.poses]),
        np.zeros(len(rows)),
    )
    return exact_recording(truth, A, wished)


def tre(found, A, B, P):
    """Length of Y B Q - A X P of a calibration where the true poses and the true tip are given, shape (n,), mm."""
    return np.linalg.norm(tip_residuals(found.estimate, Recording(A, B, P)), axis=1)


def joined(first, second):
    A, B, P = (np.concatenate([getattr(one, key) for one in (first, second)]) for key in "ABP")
    parts = {
        key: np.concatenate([getattr(one, key) for one in (first, second)])
        for key in OPTIONAL
        if getattr(first, key) is not None and getattr(second, key) is not None
    }
    return Recording(A, B, P, pixels=first.pixels, **parts)
