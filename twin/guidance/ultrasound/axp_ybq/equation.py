"""The equation A X P = Y B Q: its unknowns, its linear solution, its residuals, and their covariance.

The linear solution (spec 3, section 1) needs no start value and is exact without noise. Every pose gives three rows,
R_A R_X p + R_A t_X + t_A = R_Y R_B t_Q + R_Y t_B + t_Y, linear in
z = [x1; x2; t_X; vec(t_Q^T (x) R_Y); vec(R_Y); t_Y] (48 unknowns). x1, x2 are the first two columns of R_X times mm per
unit of P: the image is a plane, so that its third column is never excited and is left out. Where P has a third
coordinate (a volume, a camera) it is: three more unknowns, at the end of z; the handedness of the image is measured.

F = R_Y (R_B t_Q + t_B) + t_Y - R_A (R_X S p + t_X) - t_A (mm, base1), S = diag(scale).
With R <- R exp([w]x) its derivatives by w_X, t_X, w_Y, t_Y, t_Q, scale are
R_A R_X [S p]x, -R_A, -R_Y [R_B t_Q + t_B]x, I, R_Y R_B, -R_A R_X[:, :2] diag(u, v).
(Spec 3, section 2. The patent prints the first and third without their signs; its G is -J.)

m = M V with the rotation M = (R_A R_X)^T R_Y R_B from end2 to image, V the needle's direction in end2. Two residuals:
how far m points away from the measured v inside the image, and across it: e1.m and e2.m, e1 = z x v made unit and
e2 = v x e1. dm = [m]x w_X - (R_A R_X)^T R_Y [R_B V]x w_Y + M dV.

An arm's true flange is its nominal one moved by J eta (Mooring, Roth, Driels 1991): eta are the errors of its 23
parameters (lengths, twists, joint zeros), which stay, and J follows from the joints. A calibration does not solve for
eta. It takes eta as normal with the declared deviations, and lets what the recording says of it correct the aim. In
addition the joints stop a little differently at each arrival: repeatability.

Play leaves a joint half of its width b short of where it was sent. Which way the joint rotated says the sign (the play
operator: Visintin, Differential Models of Hysteresis, 1994, chapter III):

    q = q_sent - s b (1 + c z) / 2,   s = 1 or -1,   z normal, c = PLAY_KNOWN.

b / 2 moves the recorded flanges beforehand, and c z is one more error per joint that stays. Where s is unknown, play
is an arrival's noise of variance (b / 2)^2.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import PARAMETERS as ARM_PARAMETERS, check_flanges, error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.case.errors import ArmErrors
from puncture_twin.planning.geometry.rigid import exp_rotation, nearest_rotation, skew
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
        """After a step (19,) in the order of ``PARAMETERS``: R Exp(w), sums of the rest, V on the sphere."""
        V = self.V + tangent_basis(self.V) @ step[DIRECTION]
        R_X, R_Y = self.R_X @ exp_rotation(step[W_X]), self.R_Y @ exp_rotation(step[W_Y])
        t_X, t_Y, t_Q = self.t_X + step[T_X], self.t_Y + step[T_Y], self.t_Q + step[T_Q]
        return Estimate(R_X, t_X, R_Y, t_Y, t_Q, self.scale + step[SCALE], V / np.linalg.norm(V))

    def moved_by(self, active: Ints, step: Floats) -> Estimate:
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


def closed_form(recording: Recording, *, scale: bool = False) -> Estimate:
    """The estimate of least algebraic error of 16 poses or more, with mm per unit of P; the direction is left at z."""
    A, B, n = recording.A, recording.B, len(recording)
    R_A, t_A, R_B, t_B = A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3]
    p = recording.P[:, :2] / (np.abs(recording.P).max() if scale else LENGTH_MM)  # columns of one size
    # of vec(t_Q^T (x) R_Y), vec(R_Y) and t_Y: [vec(R_B)^T (x) I, t_B^T (x) I, I], vec column-major
    rows = np.concatenate([R_B.transpose(0, 2, 1).reshape(n, 9), t_B / LENGTH_MM, np.ones((n, 1))], axis=1)
    columns = [-p[:, :1, None] * R_A, -p[:, 1:, None] * R_A, -R_A]
    columns.append(np.einsum("nk,ij->nikj", rows, np.eye(3)).reshape(n, 3, 39))
    third = recording.P.shape[1] == 3 and np.sqrt(np.mean(recording.P[:, 2] ** 2)) >= LEAST_ACROSS_MM
    if third:
        columns.append(-recording.P[:, 2:, None] / LENGTH_MM * R_A)
    z = _solve(np.concatenate(columns, axis=2), t_A / LENGTH_MM)
    R_Y = nearest_rotation(z[36:45].reshape(3, 3).T)
    U, _, Vt = np.linalg.svd(np.column_stack([z[:3], z[3:6]]), full_matrices=False)
    q = U @ Vt  # the nearest orthonormal columns
    R_X = np.column_stack([q, np.cross(q[:, 0], q[:, 1])])
    if third:
        R_X = nearest_rotation(np.column_stack([z[:3], z[3:6], z[-3:]]))
    sizes = np.array([np.linalg.norm(z[:3]), np.linalg.norm(z[3:6])])
    unit = sizes * LENGTH_MM / np.abs(recording.P).max() if scale else np.ones(2)
    # the translations once more, with proper rotations: R_A t_X - t_Y - R_Y R_B t_Q = R_Y t_B - R_A R_X p - t_A
    right = t_B @ R_Y.T - np.einsum("nij,nj->ni", R_A @ R_X, recording.points_image(unit)) - t_A
    t = _solve(np.concatenate([R_A, np.tile(-np.eye(3), (n, 1, 1)), -(R_Y @ R_B)], axis=2), right)
    return Estimate(R_X, t[:3], R_Y, t[3:6], t[6:9], unit, np.array([0.0, 0.0, 1.0]))


LEAST_ACROSS_MM = 5.0
"""Tips nearer to the plane z = 0 (rms) are a plane's, as a start: the third axis is then the others' cross product."""


def _solve(system: Floats, right: Floats) -> Floats:
    z, *_ = np.linalg.lstsq(system.reshape(-1, system.shape[2]), right.reshape(-1), rcond=None)
    return np.asarray(z)


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
FEW = 0.1
"""Fraction of the directions that may be set aside without a warning: single ones are, in one true recording of 20."""
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


def needle_direction(estimate: Estimate, recording: Recording, kept: Bools) -> SeenDirection:
    """V, from the directions that agree, or from the image plane alone; ``kept`` (n,): poses whose tip is trusted."""
    if recording.v is not None:
        return agreed_direction(estimate, recording, kept)
    V = direction_from_plane(estimate, recording.subset(kept))
    V = V if V @ estimate.t_Q > 0 else -V  # the tip lies ahead of the flange
    seen = np.ones(len(recording), dtype=bool)
    return SeenDirection(V, seen, 1.0, 1.0, ~seen, True)


def mean_direction(estimate: Estimate, recording: Recording) -> Floats:
    """V = normalise(sum M_i^T v_i), shape (3,), frame end2, of rotations M_i from end2 to image."""
    total = directions_end2(estimate, recording).sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def agreed_direction(estimate: Estimate, recording: Recording, kept: Bools) -> SeenDirection:
    """V from the poses that agree on it: the mean of those whose tip is trusted, kept (n,), toward the tip.

    It is without those far from the median axis. An axis alone does not say which way it points. The tip lies ahead of
    the flange, and where it lies along the needle that says it; else most of the directions do.

    Raises:
        InputError: The directions have no common axis, or most of them point from the tip to the hub.
    """
    seen = directions_end2(estimate, recording)
    axis, angles = _common_axis(seen, kept)
    middle = float(np.median(angles[kept]))
    if middle > SCATTERED_RAD:
        _refuse_scattered(estimate, recording, kept, middle)
    along = float(axis @ estimate.t_Q / np.linalg.norm(estimate.t_Q))
    known = abs(along) >= ALONG
    axis = axis * np.sign(along if known else np.median(seen[kept] @ axis) or 1.0)
    backward = np.asarray(seen @ axis < 0.0)
    if backward[kept].sum() > 0.5 * kept.sum():
        what = f"{_counted(recording.names, backward, REVERSED)}: the tip would then be behind the flange"
        refuse(what, "recording", ALLOWED, "directions_reversed")
    agrees = (angles <= max(FAR * middle / HALF_NORMAL, LEAST_ANGLE)) & ~backward
    total = (agrees & kept) @ seen
    V = np.asarray(total / np.linalg.norm(total))
    found = direction_residuals(estimate._replace(V=V), recording, directions_image(recording, estimate))
    inside, across = np.sqrt(np.mean(found[agrees & kept] ** 2, axis=0))
    inside, across = max(float(inside), LEAST_SPREAD), max(float(across), LEAST_SPREAD)
    return SeenDirection(V, agrees, inside, across, backward, known)


def _common_axis(seen: Floats, kept: Bools) -> tuple[Floats, Floats]:
    """The axis (3,) nearest to most of the directions (n, 3), whatever their sign, and each one's angle to it (n,)."""
    longest = np.linalg.eigh(seen[kept].T @ seen[kept])[1][:, -1]  # signs do not matter to it
    middle = np.median((seen * np.where(seen @ longest < 0.0, -1.0, 1.0)[:, None])[kept], axis=0)
    axis = middle / np.linalg.norm(middle)
    return np.asarray(axis), np.arccos(np.clip(np.abs(seen @ axis), 0.0, 1.0))


def _refuse_scattered(estimate: Estimate, recording: Recording, kept: Bools, middle: float) -> None:
    assert recording.v is not None
    what = f"the directions have no common axis in the needle's flange: they scatter by {np.degrees(middle):.0f} deg"
    for slip, undo in SLIPS.items():
        v = np.array(recording.v)
        v[:, :2] = v[:, :2] @ undo.T
        other = float(np.median(_common_axis(directions_end2(estimate, replace(recording, v=v)), kept)[1][kept]))
        if other < min(BETTER * middle, SCATTERED_RAD):
            what += f"; they would agree ({np.degrees(other):.1f} deg) if {slip}"
    refuse(what, "recording", ALLOWED, "directions_scattered")


def direction_findings(names: tuple[str, ...], aside: Bools, seen: SeenDirection) -> Iterator[Finding]:
    """Directions set aside (n,) though their tip was used, those that are reversed, and whether their sign is known."""
    for code, rows, problem, most in (
        ("directions_reversed", seen.reversed, REVERSED, 0.0),
        ("directions_aside", aside & ~seen.reversed, "v contradicts the other poses", FEW),
    ):
        if rows.any():
            severity = Severity.WARNING if rows.mean() > most else Severity.NOTE
            text = f"{_counted(names, rows, problem)}; these directions were set aside"
            yield Finding(code, severity, text, {"count": float(rows.sum())})
    if not seen.sign_known:
        said = "the tip is not on the measured axis of the needle"
        text = f"{said}: its sense, taken from most directions, could not be checked"
        yield Finding("direction_sign", Severity.WARNING, text)


def _counted(names: tuple[str, ...], rows: Bools, problem: str) -> str:
    which = "" if rows.all() else f": {', '.join(np.array(names)[rows].tolist())}"
    return f"{problem} in {int(rows.sum())} of {len(names)} poses{which}"


def direction_from_plane(estimate: Estimate, recording: Recording) -> Floats:
    """V from nothing but the fact that the needle lies in the image: z.M_i V = 0 for every pose. Its sign is not known.

    Needs poses between which the needle rotated about itself; otherwise V is not unique.
    """
    across_image = needle_in_image(estimate, recording)[:, 2, :]
    return np.asarray(np.linalg.svd(across_image)[2][-1])  # null vector: z.M_i V = 0


class Linearised(NamedTuple):
    """Residuals (n, k), and their derivatives (n, k, 19) by `PARAMETERS`."""

    residuals: Floats  # shape (n, k)
    jacobian: Floats  # shape (n, k, 19), by the parameters of ``parameters.PARAMETERS``


def linearised_tip(estimate: Estimate, recording: Recording) -> Linearised:
    """The tip's residuals with their Jacobian."""
    n, r = len(recording), tip_residuals(estimate, recording)
    R_A, R_AX = recording.A[:, :3, :3], recording.A[:, :3, :3] @ estimate.R_X
    p = recording.points_image(estimate.scale)
    _, in_base2 = tip_points(estimate, recording)
    J = np.zeros((n, 3, N_PARAMETERS))
    J[:, :, W_X] = R_AX @ skew(p)
    J[:, :, T_X] = -R_A
    J[:, :, W_Y] = -estimate.R_Y @ skew(in_base2)
    J[:, :, T_Y] = np.eye(3)
    J[:, :, T_Q] = estimate.R_Y @ recording.B[:, :3, :3]
    J[:, :, SCALE] = -R_AX[:, :, :2] * recording.P[:, None, :2]
    return Linearised(r, J)


def tip_residuals(estimate: Estimate, recording: Recording) -> Floats:
    """F = Y B Q - A X P, shape (n, 3), mm, base1."""
    in_end1, in_base2 = tip_points(estimate, recording)
    by_probe = (recording.A[:, :3, :3] @ in_end1[:, :, None])[:, :, 0] + recording.A[:, :3, 3]
    return np.asarray(in_base2 @ estimate.R_Y.T + estimate.t_Y - by_probe)


def tip_points(estimate: Estimate, recording: Recording) -> tuple[Floats, Floats]:
    """The tip in end1, by the image, and in base2, by the needle's arm; both (n, 3), mm."""
    in_end1 = recording.points_image(estimate.scale) @ estimate.R_X.T + estimate.t_X
    in_base2 = recording.B[:, :3, :3] @ estimate.t_Q + recording.B[:, :3, 3]
    return in_end1, in_base2


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


def direction_residuals(estimate: Estimate, recording: Recording, v_image: Floats) -> Floats:
    """The direction's residuals alone, shape (n, 2)."""
    return np.asarray(across(v_image) @ needle_in_image(estimate, recording) @ estimate.V)


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


def facing(estimate: Estimate, recording: Recording) -> Bools:
    """Whether a pose's measured direction points along V at all, shape (n,): a reversed one has no residual."""
    m = needle_in_image(estimate, recording) @ estimate.V
    return np.asarray(np.einsum("ni,ni->n", m, directions_image(recording, estimate)) > 0)


N_ARM = ARM_PARAMETERS["joint"].stop
"""Parameters of one arm that move its flange: 23. Those of the tip are unknowns of the calibration itself."""
PLAY_KNOWN = 0.25
"""Standard deviation of each joint's play, over the declared one."""


class DeclaredArm(NamedTuple):
    """One arm: its nominal model, and what is declared of its errors; half the play stops a joint short."""

    model: UrModel
    errors: ArmErrors

    def deviations(self) -> Floats:
        """Deviations of the 23 parameters, shape (23,), mm and rad."""
        sigma, errors = np.zeros(N_ARM), self.errors
        for kind, value in (("link", errors.link_mm), ("twist", errors.twist), ("joint", errors.joint)):
            sigma[ARM_PARAMETERS[kind]] = value
        return sigma

    def motions(self, q: Floats, turn: Floats) -> FlangeMotions:
        """How the arm's errors move its flange at joints (n, 6), rad, that turned last by signs (n, 6), 0 unknown."""
        J, half = error_jacobian(self.model, q, 0.0), self.errors.backlash / 2
        slopes, joints = J[..., :N_ARM] * self.deviations(), J[..., ARM_PARAMETERS["joint"]]
        play = -half * joints * turn[:, None, :]  # -half the width times the direction of rotation
        if half:
            slopes = np.concatenate([slopes, PLAY_KNOWN * play], axis=2)
        variance = self.errors.repeatability**2 + half**2 * (turn == 0.0)  # play is noise where its sign is unknown
        arrival = (joints * variance[:, None, :]) @ np.swapaxes(joints, -1, -2)
        return FlangeMotions(slopes, play.sum(axis=2), arrival)


class FlangeMotions(NamedTuple):
    """How the errors of one arm move its flange at n poses: shift (mm) and turn (rad) along the base's axes."""

    slopes: Floats  # shape (n, 6, 23), per standard deviation of each parameter; (n, 6, 29) with each joint's play
    play: Floats  # shape (n, 6), by the declared play from where the joints say
    arrival: Floats  # shape (n, 6, 6), the covariance between arrivals at one pose


class DeclaredArms(NamedTuple):
    """Declared errors of both arms."""

    probe: DeclaredArm
    needle: DeclaredArm


class FlangeErrors(NamedTuple):
    """How both arms' errors move the flanges of a recording."""

    probe: FlangeMotions
    needle: FlangeMotions


def arm_errors(declared: DeclaredArms, recording: Recording) -> FlangeErrors:
    """The errors of declared arms at a recording's joints.

    Raises:
        InputError: Joints that the recording has not, or that do not belong to its flanges.
    """
    r = recording
    if r.q_probe is None or r.q_needle is None:
        refuse("the arms' errors need the joints", "recording", "columns A_q1_deg to B_q6_deg", "missing_column")
    found = []
    for arm, q, T, turn, of in (
        (declared.probe, r.q_probe, r.A, r.turn_probe, "A"),
        (declared.needle, r.q_needle, r.B, r.turn_needle, "B"),
    ):
        check_flanges(arm.model, q, T, names=[f"{of} in pose {name}" for name in r.names], where="recording")
        found.append(arm.motions(q, np.zeros(q.shape) if turn is None else turn))
    return FlangeErrors(*found)


def corrected(T_base_flange: Floats, motion: Floats) -> Floats:
    """Flange poses (n, 4, 4) after a small shift and turn (n, 6) along the base's axes, about the flange's origin."""
    T = np.array(T_base_flange)
    T[..., :3, :3] = exp_rotation(motion[..., 3:]) @ T[..., :3, :3]
    T[..., :3, 3] += motion[..., :3]
    return T


def without_play(recording: Recording, errors: FlangeErrors) -> Recording:
    """The recording with its flanges where the declared play leaves them."""
    if not (errors.probe.play.any() or errors.needle.play.any()):
        return recording
    A, B = corrected(recording.A, errors.probe.play), corrected(recording.B, errors.needle.play)
    return replace(recording, A=A, B=B)


Weights = Floats | Bools
LEAST_MM = 1e-9
"""Below this there is no noise, only rounding."""


class Spread(NamedTuple):
    """One spread for every pose: of the tip's residual along each axis of the image, across it, of the direction's.

    With equal parts inside and across the image this is unweighted least squares.
    """

    inside_mm: float
    across_mm: float
    direction_rad: float


UNWEIGHTED = Spread(1.0, 1.0, 1.0)
"""Every residual counts the same."""


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


def residual_weights(problem: Problem, tip_weights: Weights, direction_weights: Weights) -> Floats:
    """One weight per residual, shape (n, k), from one per pose for tip and direction (a flag counts as 1 or 0)."""
    columns = [tip_weights] * 3 + [direction_weights] * (2 if problem.with_direction else 0)
    return np.column_stack(columns).astype(np.float64)


class LinearModel(NamedTuple):
    """A problem at an estimate: n residuals of k = 3 parts, or 5 with directions, by p free parameters."""

    residuals: Floats  # shape (n, k)
    jacobian: Floats  # shape (n, k, p)
    sigma: Floats  # shape (n, k, k), the expected covariance of each pose's own noise
    shared: Floats | None  # shape (n, k, m), by the arms' lasting errors in standard deviations; None undeclared


def linear_model(problem: Problem, estimate: Estimate) -> LinearModel:
    """The linearised problem at one estimate, for a fit or a test of it."""
    recording, shared = problem.recording, None
    tip = linearised_tip(estimate, recording)
    r, J, v_image = tip.residuals, tip.jacobian, None
    if problem.with_direction:
        v_image = directions_image(recording, estimate)
        turn = linearised_direction(estimate, recording, v_image)
        r, J = np.concatenate([r, turn.residuals], axis=1), np.concatenate([J, turn.jacobian], axis=1)
    sigma = covariances(estimate, recording, problem.noise, v_image, problem.lean_rad)
    if problem.arms is not None:
        by_flange = flange_slopes(estimate, recording, v_image)
        for slopes, arm in zip(by_flange, problem.arms, strict=True):
            sigma = sigma + slopes @ arm.arrival @ slopes.transpose(0, 2, 1)
        both = [slopes @ arm.slopes for slopes, arm in zip(by_flange, problem.arms, strict=True)]
        shared = np.concatenate(both, axis=2)
    return LinearModel(r, J[:, :, problem.active], sigma, shared)


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


def residuals(problem: Problem, estimate: Estimate) -> Floats:
    """All residuals alone, shape (n, 3 or 5)."""
    tip = tip_residuals(estimate, problem.recording)
    if not problem.with_direction:
        return tip
    v_image = directions_image(problem.recording, estimate)
    return np.concatenate([tip, direction_residuals(estimate, problem.recording, v_image)], axis=1)


def median_spread(problem: Problem, estimate: Estimate) -> Spread:
    """The tip's spread inside and across the image, from medians: outliers hardly move it."""
    to_image = (problem.recording.A[:, :3, :3] @ estimate.R_X).transpose(0, 2, 1)
    r = np.abs(to_image @ tip_residuals(estimate, problem.recording)[:, :, None])[:, :, 0]
    inside, across = (max(float(np.median(part)) / HALF_NORMAL, LEAST_MM) for part in (r[:, :2], r[:, 2]))
    return Spread(max(inside, across / 3), max(across, inside / 3), 1.0)
