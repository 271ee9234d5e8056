"""The linear solution of A X P = Y B Q (spec 3, section 1): no start value needed, exact without noise.

Every pose gives three rows, R_A R_X p + R_A t_X + t_A = R_Y R_B t_Q + R_Y t_B + t_Y, linear in
z = [x1; x2; t_X; vec(t_Q^T (x) R_Y); vec(R_Y); t_Y] (48 unknowns), or, with a known tip, in
z = [x1; x2; t_X; vec(R_Y); t_Y] (21 unknowns). x1, x2 are the first two columns of R_X times mm per unit of P: the
image is a plane, so that its third column is never excited and is left out.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import LENGTH_MM, Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

LEAST_POSES = 16
"""48 unknowns, three rows a pose."""

LEAST_POSES_KNOWN_TIP = 7
"""21 unknowns, three rows a pose."""


def closed_form(recording: Recording, *, known_tip: Floats | None = None, scale: bool = False) -> Estimate:
    """The estimate of least algebraic error; the needle's direction is left at z.

    Args:
        recording: At least 16 poses, or 7 with a known tip.
        known_tip: t_Q, shape (3,), mm, frame end2.
        scale: Whether mm per unit of P is unknown.
    """
    A, B = recording.A, recording.B
    p = recording.P / (np.abs(recording.P).max() if scale else LENGTH_MM)
    system, t_A = _probe_columns(A, p), A[:, :3, 3] / LENGTH_MM
    if known_tip is None:
        z = _solve(np.concatenate([system, _needle_columns(B)], axis=2), t_A)
        R_Y = nearest_rotation(z[36:45].reshape(3, 3).T)
    else:
        z = _solve(np.concatenate([system, _tip_columns(B, known_tip)], axis=2), t_A)
        R_Y = nearest_rotation(z[9:18].reshape(3, 3).T)
    R_X, sizes = _image_axes(z[:3], z[3:6])
    unit = sizes * LENGTH_MM / np.abs(recording.P).max() if scale else np.ones(2)
    t_X, t_Y, t_Q = _translations(recording, R_X, R_Y, unit, known_tip)
    return Estimate(R_X, t_X, R_Y, t_Y, t_Q, unit, np.array([0.0, 0.0, 1.0]))


def nearest_rotation(M: Floats) -> Floats:
    """The rotation nearest to a matrix (3, 3), in the Frobenius norm; for -M the same as for M where det M < 0."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _probe_columns(A: Floats, p: Floats) -> Floats:
    R_A = A[:, :3, :3]
    return np.concatenate([-p[:, :1, None] * R_A, -p[:, 1:, None] * R_A, -R_A], axis=2)


def _needle_columns(B: Floats) -> Floats:
    """Columns of vec(t_Q^T (x) R_Y), vec(R_Y) and t_Y: [vec(R_B)^T (x) I, t_B^T (x) I, I], shape (n, 3, 39)."""
    transposed = B[:, :3, :3].transpose(0, 2, 1).reshape(len(B), 9)  # column-major vec
    rows = np.concatenate([transposed, B[:, :3, 3] / LENGTH_MM, np.ones((len(B), 1))], axis=1)
    return np.einsum("nk,ij->nikj", rows, np.eye(3)).reshape(len(B), 3, 39)


def _tip_columns(B: Floats, tip_end2: Floats) -> Floats:
    """Columns of vec(R_Y) and t_Y, shape (n, 3, 12)."""
    tip_base2 = (B[:, :3, :3] @ tip_end2 + B[:, :3, 3]) / LENGTH_MM
    rows = np.concatenate([tip_base2, np.ones((len(B), 1))], axis=1)
    return np.einsum("nk,ij->nikj", rows, np.eye(3)).reshape(len(B), 3, 12)


def _solve(system: Floats, right: Floats) -> Floats:
    z, *_ = np.linalg.lstsq(system.reshape(-1, system.shape[2]), right.reshape(-1), rcond=None)
    return np.asarray(z)


def _image_axes(x1: Floats, x2: Floats) -> tuple[Floats, Floats]:
    """R_X and the two lengths: [q1 q2] = U V^T of svd([x1 x2]), the third axis is their cross product."""
    U, _, Vt = np.linalg.svd(np.column_stack([x1, x2]), full_matrices=False)
    q = U @ Vt
    return np.column_stack([q, np.cross(q[:, 0], q[:, 1])]), np.array([np.linalg.norm(x1), np.linalg.norm(x2)])


def _translations(
    recording: Recording, R_X: Floats, R_Y: Floats, unit: Floats, known_tip: Floats | None
) -> tuple[Floats, Floats, Floats]:
    """t_X, t_Y, t_Q once more, with proper rotations: R_A t_X - t_Y - R_Y R_B t_Q = R_Y t_B - R_A R_X p - t_A."""
    A, B, n = recording.A, recording.B, len(recording)
    R_A, R_YB = A[:, :3, :3], R_Y @ B[:, :3, :3]
    right = B[:, :3, 3] @ R_Y.T - np.einsum("nij,nj->ni", R_A @ R_X[:, :2], recording.P * unit) - A[:, :3, 3]
    system = np.concatenate([R_A, np.tile(-np.eye(3), (n, 1, 1)), -R_YB], axis=2)
    if known_tip is not None:
        right, system = right + R_YB @ known_tip, system[:, :, :6]
    z = _solve(system, right)
    return z[:3], z[3:6], z[6:9] if known_tip is None else np.array(known_tip, dtype=np.float64)
