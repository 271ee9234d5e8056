"""The equation A X P = Y B Q: unknowns, residuals, their linearisation, covariance, and the closed solution.

F = R_Y (R_B t_Q + t_B) + t_Y - R_A (R_X S p + t_X) - t_A (mm, base1), S = diag(scale).
With R <- R exp([w]x) its derivatives by w_X, t_X, w_Y, t_Y, t_Q, scale are
R_A R_X [S p]x, -R_A, -R_Y [R_B t_Q + t_B]x, I, R_Y R_B, -R_A R_X[:, :2] diag(u, v).
(Spec 3, section 2. The patent prints the first and third without their signs; its G is -J.)

m = M V with the rotation M = (R_A R_X)^T R_Y R_B from end2 to image, V the needle's direction in end2. Two residuals:
how far m points away from the measured v inside the image, and across it: e1.m and e2.m, e1 = z x v made unit and
e2 = v x e1. dm = [m]x w_X - (R_A R_X)^T R_Y [R_B V]x w_Y + M dV.

The closed solution (spec 3, section 1) needs no start value and is exact without noise. Every pose gives three rows,
R_A R_X p + R_A t_X + t_A = R_Y R_B t_Q + R_Y t_B + t_Y, linear in
z = [x1; x2; t_X; vec(t_Q^T (x) R_Y); vec(R_Y); t_Y] (48 unknowns). x1, x2 are the first two columns of R_X times mm per
unit of P: the image is a plane, so that its third column is never excited and is left out. Where P has a third
coordinate (a volume, a camera) it is: three more unknowns, at the end of z; the handedness of the image is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.gauss_newton import System, Whitening
from puncture_twin.planning.geometry.rigid import exp_rotation, nearest_rotation, skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import FlangeErrors
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording

PARTS = ("w_X_{}_rad", "t_X_{}_mm", "w_Y_{}_rad", "t_Y_{}_mm", "t_Q_{}_mm")
PARAMETERS = (*(part.format(axis) for part in PARTS for axis in "xyz"), "scale_u", "scale_v", "V_1_rad", "V_2_rad")
"""Every parameter that may be estimated, in the order of the Jacobians' columns."""
N_PARAMETERS = len(PARAMETERS)
W_X, T_X, W_Y, T_Y, T_Q = (slice(start, start + 3) for start in range(0, 15, 3))
SCALE, DIRECTION = slice(15, 17), slice(17, 19)
LENGTH_MM = 100.0
"""Lengths are counted in this unit, so that the columns of a system are of one size."""


def active_columns(*, scale: bool, direction: bool) -> Ints:
    """Columns of the 19 parameters that are estimated."""
    wanted = np.ones(N_PARAMETERS, dtype=bool)
    wanted[SCALE], wanted[DIRECTION] = scale, direction
    return np.flatnonzero(wanted)


def parameter_units(active: Ints, scale: Floats) -> Floats:
    """Unit of each free parameter: 1 rad, 100 mm, the scale itself."""
    units = np.ones(N_PARAMETERS)
    for part in (T_X, T_Y, T_Q):
        units[part] = LENGTH_MM
    units[SCALE] = scale
    return units[active]


class Estimate(NamedTuple):
    """One value of every unknown: R_X, t_X of T_end1_image; R_Y, t_Y of T_base1_base2; t_Q, the tip in end2, mm."""

    R_X: Floats
    t_X: Floats  # noqa: N815 - the equation's letter
    R_Y: Floats
    t_Y: Floats  # noqa: N815 - the equation's letter
    t_Q: Floats  # noqa: N815 - the equation's letter
    scale: Floats  # shape (2,), mm per unit of P
    V: Floats  # shape (3,), unit, the needle's direction in end2

    def moved(self, step: Floats) -> Estimate:
        """The estimate after a step (19,), as ``PARAMETERS``: R Exp(w), sums of the rest, V on the sphere."""
        V = self.V + tangent_basis(self.V) @ step[DIRECTION]
        R_X, R_Y = self.R_X @ exp_rotation(step[W_X]), self.R_Y @ exp_rotation(step[W_Y])
        t_X, t_Y, t_Q = self.t_X + step[T_X], self.t_Y + step[T_Y], self.t_Q + step[T_Q]
        return Estimate(R_X, t_X, R_Y, t_Y, t_Q, self.scale + step[SCALE], V / np.linalg.norm(V))


def tangent_basis(direction: Floats) -> Floats:
    """Two unit vectors across a direction (3,) and each other, as columns, shape (3, 2)."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]  # farthest from parallel
    first = skew(direction) @ helper
    first /= np.linalg.norm(first)
    return np.column_stack([first, skew(direction) @ first])


class Linearised(NamedTuple):
    """Residuals (n, k), and their derivatives (n, k, 19) by `PARAMETERS`."""

    residuals: Floats  # shape (n, k)
    jacobian: Floats  # shape (n, k, 19), by the parameters of `PARAMETERS`


def tip_residuals(estimate: Estimate, recording: Recording) -> Floats:
    """F = Y B Q - A X P, shape (n, 3), mm, base1."""
    in_end1, in_base2 = tip_points(estimate, recording)
    by_probe = (recording.A[:, :3, :3] @ in_end1[:, :, None])[:, :, 0] + recording.A[:, :3, 3]
    return np.asarray(in_base2 @ estimate.R_Y.T + estimate.t_Y - by_probe)


def tip_points(estimate: Estimate, recording: Recording) -> tuple[Floats, Floats]:
    """The tip in end1, by the image, and in base2, by the needle's arm; both (n, 3), mm."""
    in_end1 = tips_image(recording, estimate.scale) @ estimate.R_X.T + estimate.t_X
    in_base2 = recording.B[:, :3, :3] @ estimate.t_Q + recording.B[:, :3, 3]
    return in_end1, in_base2


def tips_image(recording: Recording, scale: Floats) -> Floats:
    """S p of every pose: the tips in the image, shape (n, 3), mm; those measured in a plane have z = 0."""
    points = np.zeros((len(recording), 3))
    points[:, : recording.P.shape[1]] = recording.P
    points[:, :2] *= scale
    return points


def linearised_tip(estimate: Estimate, recording: Recording) -> Linearised:
    """The tip's residuals with their Jacobian."""
    n, r = len(recording), tip_residuals(estimate, recording)
    R_A, R_AX = recording.A[:, :3, :3], recording.A[:, :3, :3] @ estimate.R_X
    p = tips_image(recording, estimate.scale)
    _, in_base2 = tip_points(estimate, recording)
    J = np.zeros((n, 3, N_PARAMETERS))
    J[:, :, W_X] = R_AX @ skew(p)
    J[:, :, T_X] = -R_A
    J[:, :, W_Y] = -estimate.R_Y @ skew(in_base2)
    J[:, :, T_Y] = np.eye(3)
    J[:, :, T_Q] = estimate.R_Y @ recording.B[:, :3, :3]
    J[:, :, SCALE] = -R_AX[:, :, :2] * recording.P[:, None, :2]
    return Linearised(r, J)


def needle_in_image(estimate: Estimate, recording: Recording) -> Floats:
    """M = (R_A R_X)^T R_Y R_B, the rotation from end2 to image, shape (n, 3, 3)."""
    R_AX = recording.A[:, :3, :3] @ estimate.R_X
    return np.asarray(R_AX.transpose(0, 2, 1) @ estimate.R_Y @ recording.B[:, :3, :3])


def directions_image(recording: Recording, estimate: Estimate) -> Floats:
    """The measured directions in mm, as unit vectors (n, 3); one that was measured in the image only has z = 0.

    Raises:
        ValueError: The recording holds no directions.
    """
    if recording.v is None:
        raise ValueError("the recording has no directions")
    v = np.zeros((len(recording), 3))
    v[:, : recording.v.shape[1]] = recording.v
    v[:, :2] *= estimate.scale
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def directions_end2(estimate: Estimate, recording: Recording) -> Floats:
    """The measured directions as every pose has them in end2, M^T v: shape (n, 3), unit."""
    back = needle_in_image(estimate, recording).transpose(0, 2, 1)
    return np.asarray(np.einsum("nij,nj->ni", back, directions_image(recording, estimate)))


def across(v: Floats) -> Floats:
    """e1 (inside the image, across v) and e2 (across the image) of unit vectors (n, 3), as rows: shape (n, 2, 3)."""
    rows = np.zeros((len(v), 2, 3))
    a, b, c = v.T
    flat = np.hypot(a, b)
    rows[:, 0, 0], rows[:, 0, 1] = -b / flat, a / flat
    rows[:, 1, 0], rows[:, 1, 1], rows[:, 1, 2] = -a * c / flat, -b * c / flat, flat
    return rows


def direction_residuals(estimate: Estimate, recording: Recording, v_image: Floats) -> Floats:
    """The direction's residuals alone, shape (n, 2)."""
    return np.asarray(across(v_image) @ needle_in_image(estimate, recording) @ estimate.V)


def linearised_direction(estimate: Estimate, recording: Recording, v_image: Floats) -> Linearised:
    """The direction's residuals (n, 2), rad for small ones, with their Jacobian; ``v_image`` unit, shape (n, 3)."""
    M = needle_in_image(estimate, recording)
    m = M @ estimate.V
    rows = across(v_image)
    R_AXY = (recording.A[:, :3, :3] @ estimate.R_X).transpose(0, 2, 1) @ estimate.R_Y
    J = np.zeros((len(recording), 2, N_PARAMETERS))
    J[:, :, W_X] = rows @ skew(m)  # dm = [m]x w_X
    J[:, :, W_Y] = -rows @ R_AXY @ skew(recording.B[:, :3, :3] @ estimate.V)
    J[:, :, DIRECTION] = rows @ M @ tangent_basis(estimate.V)
    return Linearised((rows @ m[:, :, None])[:, :, 0], J)


LEAST_POSES = 16
"""48 unknowns, three rows a pose."""
LEAST_ACROSS_MM = 5.0
"""Tips nearer to the plane z = 0 (rms) are a plane's, as a start: the third axis is then the others' cross product."""


def closed_form(recording: Recording, *, scale: bool = False) -> Estimate:
    """The estimate of least algebraic error of 16 poses or more, with mm per unit of P; the direction is left at z."""
    A, B, n = recording.A, recording.B, len(recording)
    R_A, t_A, R_B, t_B = A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3]
    P = tips_image(recording, np.ones(2))
    p = P[:, :2] / (np.abs(P).max() if scale else LENGTH_MM)  # columns of one size
    # of vec(t_Q^T (x) R_Y), vec(R_Y) and t_Y: [vec(R_B)^T (x) I, t_B^T (x) I, I], vec column-major
    rows = np.concatenate([R_B.transpose(0, 2, 1).reshape(n, 9), t_B / LENGTH_MM, np.ones((n, 1))], axis=1)
    columns = [-p[:, :1, None] * R_A, -p[:, 1:, None] * R_A, -R_A]
    columns.append(np.einsum("nk,ij->nikj", rows, np.eye(3)).reshape(n, 3, 39))
    third = recording.P.shape[1] == 3 and np.sqrt(np.mean(P[:, 2] ** 2)) >= LEAST_ACROSS_MM
    if third:
        columns.append(-P[:, 2:, None] / LENGTH_MM * R_A)
    z = _solve(np.concatenate(columns, axis=2), t_A / LENGTH_MM)
    R_Y = nearest_rotation(z[36:45].reshape(3, 3).T)
    U, _, Vt = np.linalg.svd(np.column_stack([z[:3], z[3:6]]), full_matrices=False)
    q = U @ Vt  # the nearest orthonormal columns
    R_X = np.column_stack([q, np.cross(q[:, 0], q[:, 1])])
    if third:
        R_X = nearest_rotation(np.column_stack([z[:3], z[3:6], z[-3:]]))
    sizes = np.array([np.linalg.norm(z[:3]), np.linalg.norm(z[3:6])])
    unit = sizes * LENGTH_MM / np.abs(P).max() if scale else np.ones(2)
    # the translations once more, with proper rotations: R_A t_X - t_Y - R_Y R_B t_Q = R_Y t_B - R_A R_X p - t_A
    right = t_B @ R_Y.T - np.einsum("nij,nj->ni", R_A @ R_X, P * np.append(unit, 1.0)) - t_A
    t = _solve(np.concatenate([R_A, np.tile(-np.eye(3), (n, 1, 1)), -(R_Y @ R_B)], axis=2), right)
    return Estimate(R_X, t[:3], R_Y, t[3:6], t[6:9], unit, np.array([0.0, 0.0, 1.0]))


def _solve(system: Floats, right: Floats) -> Floats:
    z, *_ = np.linalg.lstsq(system.reshape(-1, system.shape[2]), right.reshape(-1), rcond=None)
    return np.asarray(z)


class Spread(NamedTuple):
    """One spread for every pose: of the tip's residual along each axis of the image, across it, of the direction's.

    With equal parts inside and across the image this is unweighted least squares.
    """

    inside_mm: float
    across_mm: float
    direction_rad: float


UNWEIGHTED = Spread(1.0, 1.0, 1.0)
"""Every residual counts the same."""


class LinearModel(NamedTuple):
    """A problem at an estimate: n residuals of k = 3 parts, or 5 with directions, by p free parameters."""

    residuals: Floats  # shape (n, k)
    jacobian: Floats  # shape (n, k, p)
    sigma: Floats  # shape (n, k, k), the expected covariance of each pose's own noise
    shared: Floats | None  # shape (n, k, m), by the arms' lasting errors in standard deviations; None undeclared


class Problem(NamedTuple):
    """A least-squares problem: a recording, its declared errors, and which of the 19 parameters are free."""

    recording: Recording
    noise: Noise | Spread
    active: Ints
    lean_rad: float = 0.0  # that a needle may lean out of the slice and still be seen: across, the image shows no more
    arms: FlangeErrors | None = None

    @property
    def with_direction(self) -> bool:
        """Whether the measured directions take part."""
        return bool(self.active[-1] >= DIRECTION.start)

    def residuals(self, estimate: Estimate) -> Floats:
        """All residuals alone, shape (n, 3 or 5)."""
        tip = tip_residuals(estimate, self.recording)
        if not self.with_direction:
            return tip
        v_image = directions_image(self.recording, estimate)
        return np.concatenate([tip, direction_residuals(estimate, self.recording, v_image)], axis=1)

    def linear_model(self, estimate: Estimate) -> LinearModel:
        """The problem linearised at one estimate, for a fit or a test of it."""
        recording, shared = self.recording, None
        v_image = directions_image(recording, estimate) if self.with_direction else None
        sigma = covariances(estimate, recording, self.noise, v_image, self.lean_rad)
        r, J = linearised_tip(estimate, recording)
        if v_image is not None:
            direction = linearised_direction(estimate, recording, v_image)
            r, J = np.concatenate([r, direction.residuals], axis=1), np.concatenate([J, direction.jacobian], axis=1)
        if self.arms is not None:
            by_flange = flange_slopes(estimate, recording, v_image)
            for slopes, arm in zip(by_flange, self.arms, strict=True):
                sigma = sigma + slopes @ arm.arrival @ slopes.transpose(0, 2, 1)
            both = [slopes @ arm.slopes for slopes, arm in zip(by_flange, self.arms, strict=True)]
            shared = np.concatenate(both, axis=2)
        return LinearModel(r, J[:, :, self.active], sigma, shared)


class WeightedProblem(NamedTuple):
    """A problem for Gauss-Newton, whose residuals have weights, shape (n, k); covariances follow them."""

    problem: Problem
    weights: Floats

    def linearised(self, estimate: Estimate) -> System[Estimate]:
        """The whitened problem at an estimate, free parameters in `parameter_units`."""
        units = parameter_units(self.problem.active, estimate.scale)
        r, J, sigma, shared = self.problem.linear_model(estimate)
        whitening = Whitening.of(sigma, shared, self.weights)

        def cost(near: Estimate) -> float:
            return float(np.sum(whitening.residuals(self.problem.residuals(near)) ** 2))

        return System(whitening.residuals(r), whitening.slopes(J) * units, cost)

    def moved(self, estimate: Estimate, step: Floats) -> Estimate:
        """The estimate after a step (p,) of the free parameters, in `parameter_units`."""
        full = np.zeros(N_PARAMETERS)
        full[self.problem.active] = parameter_units(self.problem.active, estimate.scale) * step
        return estimate.moved(full)


def covariances(
    estimate: Estimate, recording: Recording, noise: Noise | Spread, v_image: Floats | None, lean_rad: float
) -> Floats:
    """Covariance of each pose's residuals, shape (n, 3, 3) of the tip, or (n, 5, 5) with the direction's two behind it.

    The noise is propagated to first order through both arms and the image, or taken as it is; ``v_image`` (n, 3), unit,
    are the measured directions, where they are used; the needle leans by ``lean_rad`` out of the plane across the
    image.
    """
    n, size = len(recording), 3 if v_image is None else 5
    sigma = np.zeros((n, size, size))
    if isinstance(noise, Spread):
        in_image = recording.A[:, :3, :3] @ estimate.R_X * [noise.inside_mm, noise.inside_mm, noise.across_mm]
        sigma[:, :3, :3] = in_image @ in_image.transpose(0, 2, 1)
    else:
        sigma += _propagated(estimate, recording, noise, v_image)
    if v_image is not None:
        sigma[:, 3, 3] += (noise.direction_rad * recording.direction_spread) ** 2
        sigma[:, 4, 4] += lean_rad**2
    return sigma


def _propagated(estimate: Estimate, recording: Recording, noise: Noise, v_image: Floats | None) -> Floats:
    """Covariance of the residuals from the noise of flanges and tip; every source is independent and isotropic."""
    R_A, R_B = recording.A[:, :3, :3], recording.B[:, :3, :3]
    in_end1, _ = tip_points(estimate, recording)
    turn_A, turn_B = R_A @ skew(in_end1), -estimate.R_Y @ R_B @ skew(estimate.t_Q)
    if v_image is not None:
        M, rows = needle_in_image(estimate, recording), across(v_image)
        end1 = (M @ estimate.V) @ estimate.R_X.T
        turn_A = np.concatenate([turn_A, rows @ estimate.R_X.T @ skew(end1)], axis=1)
        turn_B = np.concatenate([turn_B, -rows @ M @ skew(estimate.V)], axis=1)
    sigma = noise.robot_rad**2 * (turn_A @ turn_A.transpose(0, 2, 1) + turn_B @ turn_B.transpose(0, 2, 1))
    in_image = (R_A @ estimate.R_X)[:, :, : recording.P.shape[1]]
    sigma[:, :3, :3] += noise.image_mm**2 * in_image @ in_image.transpose(0, 2, 1)
    sigma[:, :3, :3] += 2 * noise.robot_mm**2 * np.eye(3)
    if noise.off_plane_mm and recording.P.shape[1] == 2:
        normal = (R_A @ estimate.R_X)[:, :, 2]
        sigma[:, :3, :3] += noise.off_plane_mm**2 * normal[:, :, None] * normal[:, None, :]
    return np.asarray(sigma)


def flange_slopes(estimate: Estimate, recording: Recording, v_image: Floats | None) -> tuple[Floats, Floats]:
    """The residuals' derivatives by a small motion of the probe's and of the needle's flange, each (n, k, 6).

    A motion is a shift and a turn about the flange's origin, along the axes of the arm's own base:
    dF = -(dt_A - [R_A p1]x dw_A) + R_Y (dt_B - [R_B t_Q]x dw_B), p1 = R_X S p + t_X, and of the direction
    dm = (R_A R_X)^T [R_Y R_B V]x dw_A - (R_A R_X)^T R_Y [R_B V]x dw_B.

    The measured directions ``v_image`` (n, 3) are unit; None where they are not used.
    """
    n, size = len(recording), 3 if v_image is None else 5
    R_A, R_B = recording.A[:, :3, :3], recording.B[:, :3, :3]
    in_end1, _ = tip_points(estimate, recording)
    probe, needle = np.zeros((2, n, size, 6))
    probe[:, :3, :3], needle[:, :3, :3] = -np.eye(3), estimate.R_Y
    probe[:, :3, 3:] = skew((R_A @ in_end1[:, :, None])[:, :, 0])
    needle[:, :3, 3:] = -estimate.R_Y @ skew(R_B @ estimate.t_Q)
    if v_image is not None:
        rows = across(v_image) @ (R_A @ estimate.R_X).transpose(0, 2, 1)
        along = R_B @ estimate.V
        probe[:, 3:, 3:] = rows @ skew(along @ estimate.R_Y.T)
        needle[:, 3:, 3:] = -rows @ estimate.R_Y @ skew(along)
    return probe, needle


HALF_NORMAL = 0.6745
"""Median of |x| for a standard normal x."""
FAR = 5.0
"""A direction this many standard deviations from the median one does not agree with it."""
LEAST_ANGLE = 1e-6
"""Rad: closer than this all directions agree; it is rounding."""
LEAST_SPREAD = 1e-9
"""Rad: no spread is taken to be less."""
SCATTERED_RAD = float(np.radians(15.0))
"""Directions whose median is farther from a common axis show none: 5 mm of a shaft read to .5 mm leave 8 deg; turned by
a right angle, mirrored or exchanged ones leave 40 deg and more."""
BETTER = 1 / 3
"""Another reading whose median angle is below this part of the given one's is the right one."""
ALONG = 0.5
"""Cosine between the needle's axis and the direction from flange to tip from which on the latter says where the tip
is: a straight needle on a flange has .9 and more, one that a holder turns aside by 60 deg has this."""
REVERSED = "v points from the tip to the hub"
ALLOWED = "v: the needle's direction from hub to tip, in the image's axes u and v"
SLIPS: Mapping[str, Floats] = MappingProxyType(
    {
        "v is rotated by a right angle": np.array([[0.0, -1.0], [1.0, 0.0]]),
        "one axis of v has the other sign": np.diag([1.0, -1.0]),
        "v_x and v_y are swapped": np.array([[0.0, 1.0], [1.0, 0.0]]),
    }
)
"""What people write instead, and how it is undone, but for the sign of the whole."""


class SeenDirection(NamedTuple):
    """The needle's direction as the poses agree on it, and rms angles between measured ones and those by V."""

    V: Floats  # shape (3,), unit, frame end2
    agrees: Bools  # shape (n,)
    spread_rad: float  # inside the image
    lean_rad: float  # out of its plane
    reversed: Bools  # shape (n,)
    sign_known: bool  # whether the direction from flange to tip says which end is the tip


def needle_direction(estimate: Estimate, recording: Recording, trusted: Bools) -> SeenDirection:
    """V, from the directions that agree, or from the image plane alone; ``trusted`` (n,): poses of usable tips."""
    if recording.v is not None:
        return agreed_direction(estimate, recording, trusted)
    V = direction_from_plane(estimate, recording.subset(trusted))
    V = V if V @ estimate.t_Q > 0 else -V  # the tip lies ahead of the flange
    seen = np.ones(len(recording), dtype=bool)
    return SeenDirection(V, seen, 1.0, 1.0, ~seen, True)


def mean_direction(estimate: Estimate, recording: Recording) -> Floats:
    """V = normalise(sum M_i^T v_i), shape (3,), frame end2, of rotations M_i from end2 to image."""
    total = directions_end2(estimate, recording).sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def direction_from_plane(estimate: Estimate, recording: Recording) -> Floats:
    """V from nothing but the fact that the needle lies in the image: z.M_i V = 0 for every pose. Its sign is not known.

    Needs poses between which the needle rotated about itself; otherwise V is not unique.
    """
    across_image = needle_in_image(estimate, recording)[:, 2, :]
    return np.asarray(np.linalg.svd(across_image)[2][-1])  # null vector: z.M_i V = 0


def agreed_direction(estimate: Estimate, recording: Recording, trusted: Bools) -> SeenDirection:
    """V from the poses that agree on it: the mean of those whose tip is trusted (n,), toward the tip.

    It is without those far from the median axis. An axis alone does not say which way it points. The tip lies ahead of
    the flange, and where it lies along the needle that says it; else most of the directions do.

    Raises:
        InputError: The directions have no common axis, or most of them point from the tip to the hub.
    """
    seen = directions_end2(estimate, recording)
    axis, angles = _common_axis(seen, trusted)
    middle = float(np.median(angles[trusted]))
    if middle > SCATTERED_RAD:
        _refuse_scattered(estimate, recording, trusted, middle)
    along = float(axis @ estimate.t_Q / np.linalg.norm(estimate.t_Q))
    known = abs(along) >= ALONG
    axis = axis * np.sign(along if known else np.median(seen[trusted] @ axis) or 1.0)
    backward = np.asarray(seen @ axis < 0.0)
    if backward[trusted].sum() > 0.5 * trusted.sum():
        what = f"{counted(recording.names, backward, REVERSED)}: the tip would then be behind the flange"
        refuse(what, "recording", ALLOWED, "directions_reversed")
    agrees = (angles <= max(FAR * middle / HALF_NORMAL, LEAST_ANGLE)) & ~backward
    total = (agrees & trusted) @ seen
    V = np.asarray(total / np.linalg.norm(total))
    residuals = direction_residuals(estimate._replace(V=V), recording, directions_image(recording, estimate))
    inside, across = np.sqrt(np.mean(residuals[agrees & trusted] ** 2, axis=0))
    inside, across = max(float(inside), LEAST_SPREAD), max(float(across), LEAST_SPREAD)
    return SeenDirection(V, agrees, inside, across, backward, known)


def _common_axis(seen: Floats, trusted: Bools) -> tuple[Floats, Floats]:
    """The axis (3,) nearest to most of the directions (n, 3), whatever their sign, and each one's angle to it (n,)."""
    longest = np.linalg.eigh(seen[trusted].T @ seen[trusted])[1][:, -1]  # signs do not matter to it
    middle = np.median((seen * np.where(seen @ longest < 0.0, -1.0, 1.0)[:, None])[trusted], axis=0)
    axis = middle / np.linalg.norm(middle)
    return np.asarray(axis), np.arccos(np.clip(np.abs(seen @ axis), 0.0, 1.0))


def _refuse_scattered(estimate: Estimate, recording: Recording, trusted: Bools, middle: float) -> None:
    assert recording.v is not None
    what = f"the directions have no common axis in the needle's flange: they scatter by {np.degrees(middle):.0f} deg"
    for slip, undo in SLIPS.items():
        v = np.array(recording.v)
        v[:, :2] = v[:, :2] @ undo.T
        other = float(np.median(_common_axis(directions_end2(estimate, replace(recording, v=v)), trusted)[1][trusted]))
        if other < min(BETTER * middle, SCATTERED_RAD):
            what += f"; they would agree ({np.degrees(other):.1f} deg) if {slip}"
    refuse(what, "recording", ALLOWED, "directions_scattered")


def counted(names: tuple[str, ...], rows: Bools, problem: str) -> str:
    """A problem, with the poses that have it: how many, and which where not all."""
    which = "" if rows.all() else f": {', '.join(np.array(names)[rows].tolist())}"
    return f"{problem} in {int(rows.sum())} of {len(names)} poses{which}"
