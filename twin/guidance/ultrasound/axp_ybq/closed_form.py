"""The unknowns of A X P = Y B Q (names, free ones, estimate, small steps), and their linear solution as a start.

The linear solution (spec 3, section 1) needs no start value and is exact without noise. Every pose gives three rows,
R_A R_X p + R_A t_X + t_A = R_Y R_B t_Q + R_Y t_B + t_Y, linear in
z = [x1; x2; t_X; vec(t_Q^T (x) R_Y); vec(R_Y); t_Y] (48 unknowns), or, with a known tip, in
z = [x1; x2; t_X; vec(R_Y); t_Y] (21 unknowns). x1, x2 are the first two columns of R_X times mm per unit of P: the
image is a plane, so that its third column is never excited and is left out. Where P has a third coordinate (a volume,
a camera) it is: three more unknowns, at the end of z, and the handedness of the image is measured.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import exp_rotation, nearest_rotation, skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

PARAMETERS = (
    *(f"w_X_{axis}_rad" for axis in "xyz"),
    *(f"t_X_{axis}_mm" for axis in "xyz"),
    *(f"w_Y_{axis}_rad" for axis in "xyz"),
    *(f"t_Y_{axis}_mm" for axis in "xyz"),
    *(f"t_Q_{axis}_mm" for axis in "xyz"),
    "scale_u",
    "scale_v",
    "V_1_rad",
    "V_2_rad",
)
"""Every parameter that may be estimated, in the order of the Jacobians' columns."""

N_PARAMETERS = len(PARAMETERS)
W_X, T_X, W_Y, T_Y, T_Q, SCALE, DIRECTION = (
    slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15), slice(15, 17), slice(17, 19),
)  # fmt: skip


LENGTH_MM = 100.0
"""Lengths are counted in this unit, so that the columns of a system are of one size."""


def active_columns(*, tip: bool, scale: bool, direction: bool) -> NDArray[np.int_]:
    """Columns of the 19 parameters that are estimated."""
    wanted = np.ones(N_PARAMETERS, dtype=bool)
    wanted[T_Q], wanted[SCALE], wanted[DIRECTION] = tip, scale, direction
    return np.flatnonzero(wanted)


def parameter_units(active: NDArray[np.int_], scale: Floats) -> Floats:
    """Unit of each free parameter: 1 rad, 100 mm, the scale itself."""
    units = np.ones(N_PARAMETERS)
    for part in (T_X, T_Y, T_Q):
        units[part] = LENGTH_MM
    units[SCALE] = scale
    return units[active]


class Estimate(NamedTuple):
    """One value of every unknown."""

    R_X: Floats
    """Shape (3, 3), rotation of T_end1_image."""
    t_X: Floats  # noqa: N815 - the equation's letter
    """Shape (3,), mm."""
    R_Y: Floats
    """Shape (3, 3), rotation of T_base1_base2."""
    t_Y: Floats  # noqa: N815 - the equation's letter
    """Shape (3,), mm."""
    t_Q: Floats  # noqa: N815 - the equation's letter
    """Shape (3,), mm: the tip in end2."""
    scale: Floats
    """Shape (2,): mm per unit of P."""
    V: Floats
    """Shape (3,), unit: the needle's direction in end2."""

    def moved(self, step: Floats) -> Estimate:
        """After a step (19,) in the order of ``PARAMETERS``: R Exp(w), sums of the rest, V on the sphere."""
        V = self.V + tangent_basis(self.V) @ step[DIRECTION]
        return Estimate(
            self.R_X @ exp_rotation(step[W_X]),
            self.t_X + step[T_X],
            self.R_Y @ exp_rotation(step[W_Y]),
            self.t_Y + step[T_Y],
            self.t_Q + step[T_Q],
            self.scale + step[SCALE],
            V / np.linalg.norm(V),
        )

    def moved_by(self, active: NDArray[np.int_], step: Floats) -> Estimate:
        """The estimate after a step (p,) of the free parameters, in `parameter_units`."""
        full = np.zeros(N_PARAMETERS)
        full[active] = parameter_units(active, self.scale) * step
        return self.moved(full)


def tangent_basis(direction: Floats) -> Floats:
    """Two unit vectors across a direction (3,) and each other, as columns, shape (3, 2)."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]  # farthest from parallel
    first = skew(direction) @ helper
    first /= np.linalg.norm(first)
    return np.column_stack([first, skew(direction) @ first])


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
    p = recording.P[:, :2] / (np.abs(recording.P).max() if scale else LENGTH_MM)  # columns of one size
    third = _third_columns(recording)
    system, t_A = _probe_columns(A, p), A[:, :3, 3] / LENGTH_MM
    if known_tip is None:
        z = _solve(np.concatenate([system, _needle_columns(B), third], axis=2), t_A)
        R_Y = nearest_rotation(z[36:45].reshape(3, 3).T)  # column-major vec
    else:
        z = _solve(np.concatenate([system, _tip_columns(B, known_tip), third], axis=2), t_A)
        R_Y = nearest_rotation(z[9:18].reshape(3, 3).T)
    R_X, sizes = _image_axes(z[:3], z[3:6])
    if third.shape[2]:
        R_X = nearest_rotation(np.column_stack([z[:3], z[3:6], z[-3:]]))
    unit = sizes * LENGTH_MM / np.abs(recording.P).max() if scale else np.ones(2)
    t_X, t_Y, t_Q = _translations(recording, R_X, R_Y, unit, known_tip)
    return Estimate(R_X, t_X, R_Y, t_Y, t_Q, unit, np.array([0.0, 0.0, 1.0]))


def _probe_columns(A: Floats, p: Floats) -> Floats:
    R_A = A[:, :3, :3]
    return np.concatenate([-p[:, :1, None] * R_A, -p[:, 1:, None] * R_A, -R_A], axis=2)


LEAST_ACROSS_MM = 5.0
"""Tips nearer to the plane z = 0 (rms) are a plane's, as a start: the third axis is then the others' cross product."""


def _third_columns(recording: Recording) -> Floats:
    """Columns of R_X's third axis, shape (n, 3, 3); (n, 3, 0) where the tips lie in a plane."""
    if recording.P.shape[1] == 2 or np.sqrt(np.mean(recording.P[:, 2] ** 2)) < LEAST_ACROSS_MM:
        return np.zeros((len(recording), 3, 0))
    return np.asarray(-recording.P[:, 2:, None] / LENGTH_MM * recording.A[:, :3, :3])


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
    right = B[:, :3, 3] @ R_Y.T - np.einsum("nij,nj->ni", R_A @ R_X, recording.points_image(unit)) - A[:, :3, 3]
    system = np.concatenate([R_A, np.tile(-np.eye(3), (n, 1, 1)), -R_YB], axis=2)
    if known_tip is not None:
        right, system = right + R_YB @ known_tip, system[:, :, :6]  # its columns are known
    z = _solve(system, right)
    return z[:3], z[3:6], z[6:9] if known_tip is None else np.array(known_tip, dtype=np.float64)
