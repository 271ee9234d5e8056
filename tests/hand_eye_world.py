"""Hand-eye problems with known truth."""

import numpy as np

from puncture_twin.planning.formats.csv_table import pose_columns, pose_values, table_text
from puncture_twin.planning.geometry.rigid import exp_rotation, inverse, pose
from puncture_twin.planning.registration.hand_eye import PosePairs


def hand_eye_problem(rng, n, noise=None, *, motions=False, turns=None):
    """Pairs of n poses or motions, with X and Z."""
    X = pose(exp_rotation(rng.uniform(-2, 2, 3)), rng.uniform(-100, 100, 3))
    Z = X if motions else pose(exp_rotation(rng.uniform(-2, 2, 3)), rng.uniform(-800, 800, 3))
    turns = rng.uniform(-0.5, 0.5, (n, 3)) if turns is None else turns
    mean = np.eye(3) if motions else exp_rotation(rng.uniform(-1, 1, 3))
    place = rng.uniform(-150, 150, (n, 3)) + ([0.0, 0.0, 0.0] if motions else [400.0, 0.0, 300.0])
    A = pose(mean @ exp_rotation(turns), place)
    B = inverse(Z) @ A @ X
    if noise is not None:
        A, B = shaken(rng, A, *noise[:2]), shaken(rng, B, *noise[2:])
    return PosePairs(A, B, motions=motions), X, Z


def shaken(rng, T, mm, rad):
    n = len(T)
    return pose(T[:, :3, :3] @ exp_rotation(rng.normal(0, rad, (n, 3))), T[:, :3, 3] + rng.normal(0, mm, (n, 3)))


def write_pairs(path, pairs):
    values = np.column_stack([pose_values(pairs.A), pose_values(pairs.B)]).tolist()
    rows = [(name, *row) for name, row in zip(pairs.names, values, strict=True)]
    path.write_text(table_text(("name", *pose_columns("A"), *pose_columns("B")), rows))
