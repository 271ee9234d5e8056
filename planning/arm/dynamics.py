"""The dynamics of an arm by least squares: regressor, base parameters, and their estimate from a recording.

    tau = Y(q, qd, qdd) phi

phi, shape (78,): of each of six links, in its Denavit-Hartenberg frame, mass m, m c (3) and inertia about the frame's
origin (xx, xy, xz, yy, yz, zz), kg and m, the tool being part of the last; then of each joint the inertia of its drive,
viscous and Coulomb friction. Newton-Euler is linear in them: with a the acceleration of the frame's origin less
gravity, w and dw its rotation,

    f = m a + ([dw]x + [w]x [w]x) m c,        n = m c x a + I dw + w x I w.

Torques show only combinations (Gautier, "Numerical calculation of the base inertial parameters of robots", J. Robot.
Syst. 8, 1991): the columns that a pivoted QR of many samples finds independent, each with what it stands for.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.signal import savgol_filter
from scipy.stats import f

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, Ints, read_only
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.base.text import Facts, Shown
from puncture_twin.planning.formats.points import parse_joint_recording
from puncture_twin.planning.geometry.rigid import skew

GRAVITY_M_S2 = 9.80665
N_PARAMETERS = 78

SAME = 1e-9
"""Of the largest diagonal of R: below it a column depends on the others; the least that does not is above 1e-3."""
SLOW = 0.02
"""rad/s: below it nobody knows which way friction works, and the joint's equation is passed over."""
SMOOTHED_S = 0.2
"""Span of the quintics whose slopes are speed and acceleration; the exciting motion's fastest part takes 4 s."""
MOST_CONDITION = 1e4
"""Largest over least singular value of the base regressor, its columns of length 1: beyond, a parameter is open."""
MOST_LEFT = 0.5
"""Of the torques, each joint's in units of what its motor can give: if more is left, they belong to another motion."""
MOST_BYTES, MOST_ROWS, MOST_UNEVEN = 50_000_000, 50_000, 1.1
COLUMNS = "time_s, q1_deg .. q6_deg, tau1_nm .. tau6_nm (or RTDE's timestamp, actual_q_0 .., target_moment_0 ..)"


class TorqueRecording(NamedTuple):
    """Rows of a recording, in even steps of time."""

    step_s: float
    q: Floats  # shape (n, 6), rad
    torque_nm: Floats  # shape (n, 6)


class JointMotion(NamedTuple):
    """Joints over time, shape (n, 6) each: rad, rad/s, rad/s^2."""

    q: Floats
    speed: Floats
    acceleration: Floats


def regressor(model: UrModel, motion: JointMotion, down_base: Floats) -> Floats:
    """Y, shape (n, 6, 78), N m per unit of each parameter; ``down_base`` (3,), unit vector of gravity, base frame."""
    frames = link_poses(model, motion.q)
    R, origin = frames[..., :3, :3], frames[..., :3, 3] / 1000.0
    axes = R[:, :6, :, 2]  # joint i turns about z of the frame before it
    w, dw = np.zeros((2, len(motion.q), 3))
    a = np.tile(-GRAVITY_M_S2 * down_base, (len(motion.q), 1))
    Y = np.zeros((len(motion.q), 6, N_PARAMETERS))
    for joint in range(6):
        axis, speed = axes[:, joint], motion.speed[:, joint, None]
        dw = dw + axis * motion.acceleration[:, joint, None] + np.cross(w, axis * speed)
        w = w + axis * speed
        arm = origin[:, joint + 1] - origin[:, joint]
        a = a + np.cross(dw, arm) + np.cross(w, np.cross(w, arm))
        R_link = R[:, joint + 1]
        force, moment = _of_one_body(*(np.einsum("nji,nj->ni", R_link, one) for one in (w, dw, a)))
        before = axes[:, : joint + 1]
        levers = np.cross(before, origin[:, None, joint + 1] - origin[:, : joint + 1])
        Y[:, : joint + 1, 10 * joint : 10 * joint + 10] = before @ R_link @ moment + levers @ R_link @ force
    rates = (motion.acceleration, motion.speed, np.sign(motion.speed))
    Y[:, :, 60:] = np.concatenate([one[:, :, None] * np.eye(6) for one in rates], axis=2)
    return Y


def _of_one_body(w: Floats, dw: Floats, a: Floats) -> tuple[Floats, Floats]:
    """Force and moment about its origin by its ten parameters, shape (n, 3, 10) each, its own axes."""
    force, moment = np.zeros((2, len(w), 3, 10))
    force[:, :, 0] = a
    force[:, :, 1:4] = skew(dw) + skew(w) @ skew(w)
    moment[:, :, 1:4] = -skew(a)
    moment[:, :, 4:] = _inertia(dw) + skew(w) @ _inertia(w)
    return force, moment


def _inertia(w: Floats) -> Floats:
    """I w by (xx, xy, xz, yy, yz, zz), shape (n, 3, 6)."""
    (x, y, z), o = w.T, np.zeros(len(w))
    return np.moveaxis(np.array([[x, y, z, o, o, o], [o, x, o, y, z, o], [o, o, x, o, y, z]]), 2, 0)


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Combinations of an arm's parameters that torques determine: Y phi = Y[:, columns] K phi, whatever the motion."""

    columns: Ints  # shape (r,), of phi
    K: Floats  # shape (r, 78)


def base_parameters(model: UrModel, down_base: Floats, seed: int = 0) -> BaseParameters:
    """The base parameters of an arm at a mount, from regressors of random motions."""
    motion = JointMotion(*np.random.default_rng(seed).uniform(-3.0, 3.0, (3, 100, 6)))
    R, order = qr(regressor(model, motion, down_base).reshape(-1, N_PARAMETERS), mode="r", pivoting=True)
    size = np.abs(np.diag(R))
    count = int((size > SAME * size[0]).sum())
    K = np.zeros((count, N_PARAMETERS))
    K[:, order[:count]] = np.eye(count)
    K[:, order[count:]] = solve_triangular(R[:count, :count], R[:count, count:])
    return BaseParameters(order[:count], K)


@dataclass(frozen=True, eq=False, repr=False)
class Identified(Shown):
    """Base parameters and friction of an arm, estimated from a recording."""

    base: BaseParameters
    values: Floats  # shape (r,), of the base parameters, kg, m, N m, s, rad
    covariance: Floats  # shape (r, r)
    torque_sd_nm: Floats  # shape (6,), of a torque about the model
    rows: int
    freedom: int  # equations less parameters
    condition: float  # of the equations, columns of length 1
    unexplained: float  # what is left of the torques, rms, of the torques themselves
    correlated: Floats  # shape (6,), from one row to the next, of what is left

    def _facts(self) -> Facts:
        yield "rows", f"{self.rows:,}"
        yield "base parameters", str(len(self.values))
        yield "torque about the model, N m", ", ".join(f"{one:.3f}" for one in self.torque_sd_nm)

    def region_limit(self, level: float = 0.95) -> float:
        """Largest e' C^-1 e inside the confidence region of all base parameters."""
        return float(len(self.values) * f.ppf(level, len(self.values), self.freedom))

    @property
    def friction(self) -> Floats:
        """Viscous (N m s/rad) and Coulomb (N m) friction of each joint, shape (2, 6, 2): value, standard deviation."""
        at = [int(np.flatnonzero(self.base.columns == one)[0]) for one in range(66, N_PARAMETERS)]
        both = np.column_stack([self.values, np.sqrt(np.diag(self.covariance))])[at]
        return np.asarray(both.reshape(2, 6, 2))

    def findings(self) -> tuple[Finding, ...]:
        """Findings where the residual torques exceed their noise."""
        most = float(self.correlated.max())
        if most == 0.0:
            return ()
        text = (
            f"what is left of the torques goes together from row to row (up to {most:.2f}): the arm does what "
            "the model lacks (elastic gears, stiction, backlash); the stated deviations count rows that are independent"
        )
        return (Finding("residuals_correlated", Severity.WARNING, text, {"correlation": most}),)


def read_torques(path: Path) -> TorqueRecording:
    """A recording of joints and torques, `COLUMNS`, in even steps of time.

    Raises:
        InputError: A column is missing, something is no finite number, times are uneven, or rows too few or too many.
    """
    read = parse_joint_recording(read_input(path, max_bytes=MOST_BYTES, where=str(path)), path, timed=True)
    if read.torque_nm is None or read.time_s is None:
        refuse("no torques", path, COLUMNS, "missing_column")
    if len(read.q) > MOST_ROWS:
        refuse(f"{len(read.q)} rows", path, f"{MOST_ROWS} rows or fewer", "too_many_rows")
    steps = np.diff(read.time_s)
    if len(steps) == 0 or not 0.0 < steps.min() <= steps.max() < MOST_UNEVEN * np.median(steps):
        refuse("times in uneven steps", path, "two rows or more in steps even to a tenth", "times_uneven")
    step = float(steps.mean())
    if len(read.q) < 10 * _window(step):
        what = f"{len(read.q)} rows of {step:.3g} s are too short for slopes"
        refuse(what, path, f"{10 * _window(step)} rows or more", "too_few_rows")
    return TorqueRecording(step, read.q, read.torque_nm)


def _window(step_s: float) -> int:
    """Rows of a quintic that is fitted to joints, odd."""
    return max(9, 2 * round(SMOOTHED_S / step_s / 2) + 1)


def joint_motion(recorded: TorqueRecording) -> JointMotion:
    """Joints, speed and acceleration of a recording in even steps, by quintics (Savitzky and Golay 1964)."""
    step, window = recorded.step_s, _window(recorded.step_s)
    return JointMotion(*(savgol_filter(recorded.q, window, 5, deriv=order, delta=step, axis=0) for order in range(3)))


def identify(
    model: UrModel, recorded: TorqueRecording, down_base: Floats, *, where: str | Path = "torques"
) -> Identified:
    """Base parameters by least squares, every joint weighed by what it leaves.

    Gravity is along ``down_base`` (3,), a unit vector of the base frame.

    Raises:
        InputError: The motion leaves a parameter open, or the torques do not belong to it.
    """
    base, motion, torque = base_parameters(model, down_base), joint_motion(recorded), recorded.torque_nm
    moving = np.abs(motion.speed) > SLOW
    if len(still := np.flatnonzero(moving.mean(axis=0) < 0.1)):
        what = f"joint {still[0] + 1} hardly moves (slower than {SLOW:g} rad/s in 9 of 10 rows)"
        refuse(what, where, "a motion of all joints, as --record has it", "not_exciting")
    half = _window(recorded.step_s) // 2
    moving[:half] = moving[-half:] = False  # at the ends a quintic's slopes are those of noise
    Y, joint = regressor(model, motion, down_base)[:, :, base.columns][moving], np.nonzero(moving)[1]
    condition, tau = condition_of(Y), torque[moving]
    if condition > MOST_CONDITION:
        what = f"the motion leaves a base parameter open (condition {condition:.0e})"
        refuse(what, where, f"below {MOST_CONDITION:.0e}: an exciting motion, as --record has it", "not_exciting")
    sd = np.ones(6)
    for _ in range(3):  # the weights settle
        values, C = _least_squares(Y, tau, sd[joint])
        left, taken = tau - Y @ values, np.sum(Y @ C * Y, axis=1) / sd[joint] ** 2
        squares, free = (np.bincount(joint, one, 6) for one in (left**2, 1.0 - taken))
        sd = np.sqrt(np.maximum(squares, TINY) / free)
    part = float(np.linalg.norm(left / model.max_torques[joint]) / np.linalg.norm(tau / model.max_torques[joint]))
    if not part < MOST_LEFT:
        what = f"the motion leaves {part:.0%} of the torques"
        refuse(what, where, "torques (N m) of this arm, mount and motion", "torques_unexplained")
    correlated = np.array([_correlation(left[joint == one]) for one in range(6)])
    # a row that repeats the one before counts less: (1 + r) / (1 - r) times the variance
    values, C = _least_squares(Y, tau, (sd * np.sqrt((1.0 + correlated) / (1.0 - correlated)))[joint])
    return Identified(
        base, read_only(values), read_only(C), read_only(sd), len(torque), len(tau) - len(values), condition,
        part, read_only(correlated),
    )  # fmt: skip


TINY = 1e-18
"""N m and N^2 m^2: torques without noise leave rounding."""


def condition_of(Y: Floats) -> float:
    """Condition of a regressor (.., r), its columns of length 1."""
    rows = Y.reshape(-1, Y.shape[-1])
    length = np.linalg.norm(rows, axis=0)
    squares = np.linalg.eigvalsh((rows / length).T @ (rows / length)) if length.all() else np.array([0.0, 1.0])
    return float(np.sqrt(squares[-1] / max(float(squares[0]), TINY)))


def _least_squares(Y: Floats, tau: Floats, sd: Floats) -> tuple[Floats, Floats]:
    Q, R = np.linalg.qr(Y / sd[:, None])
    inverse = solve_triangular(R, np.eye(len(R)))
    return inverse @ (Q.T @ (tau / sd)), inverse @ inverse.T


def _correlation(left: Floats) -> float:
    """Correlation of the residuals from one row to the next; 0 where it may be chance."""
    r = float(left[1:] @ left[:-1]) / max(float(left @ left), TINY)
    return min(r, 0.99) if r > 4.0 / np.sqrt(len(left)) else 0.0
