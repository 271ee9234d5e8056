"""Hand-eye calibration: where a camera is on an arm's flange, from pairs of poses, with its covariance.

A: T_base_flange, B: T_board_camera of every pose; unknown are X: T_flange_camera and Z: T_base_board, with A X = Z B.
Of motions (A: T_flange1_flange2, B: T_camera1_camera2) X alone is unknown: A X = X B, the same with Z = X.

1. A start that is exact without noise: vec(R_Z) = (R_B (x) R_A) vec(R_X), so R_X and R_Z are the first singular vectors
   of the sum over all poses (Shah, "Solving the robot-world/hand-eye calibration problem using the Kronecker product",
   J. Mech. Robot. 5, 2013); for motions R_X is its first eigenvector. Translations follow linearly.
2. Gauss-Newton over both residuals of every pose, with R <- R Exp(w):

    rho = Log((R_Z R_B)^T R_A R_X),            drho = w_X - R_B^T w_Z
    tau = R_A t_X + t_A - R_Z t_B - t_Z,       dtau = R_A dt_X + R_Z [t_B]x w_Z - dt_Z

   An error of the flange's rotation (robot_rad) turns rho and, at the end of t_X, moves tau: both are weighed together.
   Without a stated noise one spread of rho and one of tau are found from what the unknowns leave free.
   A and B both inverse are the same equation with X and Z exchanged: no residual shows it.
3. Poses whose rotations have no two axes cannot show X: refused, and the motion that slides is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from scipy.special import gammaincinv
from scipy.stats import chi2, f, t as student

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import Finding, InputError, Severity, refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.base.text import Shown, brief
from puncture_twin.planning.formats.csv_table import Layout, parse_table, pose_columns, pose_names, rigid_poses
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.planning.geometry.rigid import exp_rotation, inverse, log_rotation, nearest_rotation, pose, skew

LENGTH_MM = 100.0
"""Lengths are counted in this unit where columns are compared."""
LEAST_RATIO = 9e-3
"""Least over largest singular value of the Jacobian below which poses are refused: rotations of about a degree."""
LEAST_TURN = float(np.radians(2.0))
"""Rotations (rms) about an axis below which it does not count, where a refusal says what is missing."""
SUSPECT_MM = 3.0
"""Residuals, mm + 100 mm x rad (rms), from which on other readings are tried."""
SOUND_MM = 20.0
"""Residuals beyond which the poses do not belong together."""
BETTER = 1 / 3
"""A reading whose residuals are below this part of the given one's is the right one."""
METRES = 20.0
"""Translations none of which is longer may be in metres."""
FAR_MM = 1000.0
"""A camera is hardly farther from the flange."""
MOST_STEPS, SMALL_STEP = 50, 1e-9
LEAST = 1e-9
"""Rad and mm: below it there is rounding alone."""
ALLOWED = "A = T_base_flange and B = T_board_camera in mm (with motions: of flange and of camera), rotations by rows"
MAX_BYTES = 50_000_000


class HandEyeNoise(NamedTuple):
    """Standard deviations per axis of the poses, normal errors."""

    robot_mm: float
    robot_rad: float
    camera_mm: float
    camera_rad: float


def noise_of(stated: Sequence[float | None]) -> HandEyeNoise | None:
    """The noise from mm, degrees, mm, degrees: flange, then camera; None of four times None.

    Raises InputError: Some of them alone, or what is no positive noise of places and of rotations.
    """
    known = [value for value in stated if value is not None]
    if not known:
        return None
    allowed = "MM, DEG, MM, DEG of flange and camera; of places and of rotations at least one positive, none negative"
    mm, deg = known[::2], known[1::2]
    if len(known) != 4 or not np.isfinite(known).all() or min(known) < 0.0 or min(max(mm), max(deg)) <= 0.0:
        refuse(f"noise {list(stated)}", "hand-eye", allowed, "not_positive")
    robot_rad, camera_rad = np.radians(deg).tolist()
    return HandEyeNoise(mm[0], robot_rad, mm[1], camera_rad)


@dataclass(frozen=True, eq=False)
class PosePairs(Shown):
    """Paired poses of arm and camera, checked when made; the arrays are read-only.

    Raises InputError: Other shapes, names that are used twice, or a matrix that is no rigid motion.
    """

    A: Floats
    """T_base_flange, shape (n, 4, 4), mm; of motions T_flange1_flange2."""
    B: Floats
    """T_board_camera, shape (n, 4, 4), mm; of motions T_camera1_camera2."""
    names: tuple[str, ...] = ()
    """One per pair; numbers where nothing is given."""
    motions: bool = False
    """Whether A and B are motions from one pose to another."""

    @brief
    def __repr__(self) -> str:
        return f"{len(self.names)} pairs of {'motions' if self.motions else 'poses'}"

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", pose_names(self.names, len(np.atleast_1d(self.A))))
        for name in "AB":
            object.__setattr__(self, name, rigid_poses(getattr(self, name), name, self.names))


def read_pose_pairs(path: Path, *, motions: bool = False) -> PosePairs:
    """Pairs of poses from a CSV: ``name``, ``A_r11 .. A_r33, A_x_mm, A_y_mm, A_z_mm``, and the same for B.

    With ``motions`` its rows are motions.

    Raises InputError: Another header, a field that is no finite number, or a matrix that is no rigid motion.
    """
    content = read_input(path, max_bytes=MAX_BYTES, where=str(path))
    layout = Layout({letter: pose_columns(letter) for letter in "AB"}, (frozenset("A"), frozenset("B")))
    table = parse_table(content, path, layout, ("A", "B"))
    try:
        return PosePairs(table.poses["A"], table.poses["B"], table.names, motions)
    except InputError as error:
        raise error.at(f"{path}: {error.where}") from error


class _Value(NamedTuple):
    X: Floats
    Z: Floats

    def moved(self, step: Floats) -> _Value:
        """After a step (12,), or (6,) of X = Z: rotation and translation of X, then of Z."""
        X = _step(self.X, step[:6])
        return _Value(X, X if len(step) == 6 else _step(self.Z, step[6:]))


def _step(T: Floats, step: Floats) -> Floats:
    return pose(T[:3, :3] @ exp_rotation(step[:3]), T[:3, 3] + step[3:])


@dataclass(frozen=True, eq=False)
class HandEye(Shown):
    """The calibration of a camera on a flange."""

    X: Floats
    """T_flange_camera, shape (4, 4), mm."""
    Z: Floats | None
    """T_base_board, shape (4, 4), mm; None for motions."""
    names: tuple[str, ...]
    residuals: Floats
    """Residuals of rotation (rad) and translation (mm), shape (n, 6)."""
    covariance: Floats
    """Shape (12, 12), or (6, 6) for motions: rotation (rad, on the right) and translation (mm) of X, of Z."""
    freedom: int
    noise: HandEyeNoise | None
    """The stated noise; None where the spreads were estimated."""
    spread: tuple[float, float]
    """Of the residuals, rad and mm: their rms over what the unknowns leave free."""
    least_freedom: float
    """Of the spread that is known least; infinite where the noise was stated."""
    chi_squared: float | None
    """Chi-squared of the residuals, where the noise was stated."""
    condition: float
    """Least over largest singular value of the Jacobian, lengths in 100 mm."""
    outliers: tuple[str, ...]
    """Poses that do not fit the others; they are used."""

    @brief
    def __repr__(self) -> str:
        rad, mm = self.spread
        return f"{len(self.names)} pairs of poses, residuals {np.degrees(rad):.3f} deg and {mm:.3f} mm"

    @property
    def deviations(self) -> Floats:
        """Standard deviation of each unknown, shape (12,) or (6,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def intervals(self, level: float = 0.95) -> Floats:
        """Half width of each unknown's interval: Student's where the spread was found, normal where it was stated."""
        return np.asarray(self.deviations * student.ppf(0.5 + level / 2, self.least_freedom))

    def region_limit(self, level: float = 0.95) -> float:
        """Largest e^T C^-1 e inside the confidence region of all unknowns."""
        p = len(self.covariance)
        if self.noise is not None:
            return float(chi2.ppf(level, p))
        return float(p * f.ppf(level, p, self.least_freedom))

    def error(self, X: Floats, Z: Floats | None = None) -> Floats:
        """Another value minus this one in the order of the covariance, shape (12,) or (6,)."""
        pairs = [(self.X, X)] if self.Z is None or Z is None else [(self.X, X), (self.Z, Z)]
        steps = [(log_rotation(own[:3, :3].T @ other[:3, :3]), other[:3, 3] - own[:3, 3]) for own, other in pairs]
        return np.concatenate([part for step in steps for part in step])

    def findings(self) -> tuple[Finding, ...]:
        """Residuals that the stated noise does not explain, and poses that stand out."""
        found = []
        if self.chi_squared is not None and (chance := float(chi2.sf(self.chi_squared, self.freedom))) < 0.01:
            text = (
                f"chi-squared of the residuals is {self.chi_squared / self.freedom:.2f} times their degrees of freedom "
                f"({self.freedom}): the stated noise is probably too small, and so are the stated errors"
            )
            found.append(Finding("residuals_large", Severity.WARNING, text, {"p": chance}))
        if self.Z is not None and (far := float(np.linalg.norm(self.X[:3, 3]))) > FAR_MM:
            text = f"the camera is {far:.0f} mm from the flange; if A and B are both inverse, X and Z are exchanged"
            found.append(Finding("both_inverse", Severity.WARNING, text, {"mm": far}))
        if self.outliers:
            text = f"poses that do not fit the others: {', '.join(self.outliers)}; they are used"
            found.append(Finding("poses_aside", Severity.WARNING, text, {"count": float(len(self.outliers))}))
        return tuple(found)


def calibrate_hand_eye(pairs: PosePairs, noise: HandEyeNoise | None = None) -> HandEye:
    """Solve A X = Z B of three poses or more, or A X = X B of two motions, with rotations about two axes.

    ``noise`` is of both; None finds the residuals' spreads.

    Raises InputError: Too few poses, rotations that cannot show X, or poses that fit only in another reading, or in
    none.
    """
    least = 2 if pairs.motions else 3
    if len(pairs.names) < least:
        refuse(f"{len(pairs.names)} pairs of poses", "hand-eye", f"{least} or more, preferably 15", "too_few_poses")
    farthest = float(np.linalg.norm(pairs.A[:, :3, 3], axis=1).max())
    if not pairs.motions and farthest < METRES:
        refuse(f"the flange is never farther than {farthest:.3g} mm from its base: metres?", "A", ALLOWED, "wrong_unit")
    value = _start(pairs)
    J = _slopes(pairs, value, pairs.B[:, :3, 3].mean(axis=0))
    rows = np.repeat([1.0, LENGTH_MM], 3)
    units = np.tile(rows, J.shape[2] // 6)
    values = np.linalg.svd((J * units / rows[:, None]).reshape(-1, J.shape[2]), compute_uv=False)
    condition = float(values[-1] / values[0])
    if condition < LEAST_RATIO:
        _refuse_rotations(pairs)
    value, sigma = _fit(pairs, value, noise)
    _refuse_slip(pairs, _size_mm(pairs, value))
    J, r = _slopes(pairs, value), _residuals(pairs, value)
    C, free = _covariance(J, sigma), _free(pairs, value, sigma)
    rad, mm = np.sqrt(_squares(pairs, value) / free)
    own = np.einsum("ni,ni->n", r, np.linalg.solve(sigma, r[:, :, None])[:, :, 0])
    limit = float(2 * gammaincinv(3, 1 - 0.01 / len(own)))
    return HandEye(
        read_only(value.X),
        None if pairs.motions else read_only(value.Z),
        pairs.names,
        read_only(r),
        read_only(C),
        r.size - J.shape[2],
        noise,
        (float(rad), float(mm)),
        np.inf if noise is not None else float(free.min()),
        None if noise is None else float(own.sum()),
        condition,
        tuple(name for name, size in zip(pairs.names, own, strict=True) if size > limit),
    )


def _start(pairs: PosePairs) -> _Value:
    """Exact without noise."""
    A, B, n = pairs.A, pairs.B, len(pairs.names)
    K = np.einsum("nij,nkl->ikjl", B[:, :3, :3], A[:, :3, :3]).reshape(9, 9)
    if pairs.motions:
        vectors = [np.linalg.eigh(K + K.T)[1][:, -1]] * 2
    else:
        U, _, Vt = np.linalg.svd(K)
        vectors = [Vt[0], U[:, 0]]
    matrices = [one.reshape(3, 3).T for one in vectors]  # column-major vec, of either sign
    R_X, R_Z = (nearest_rotation(M * np.sign(np.linalg.det(M) or 1.0)) for M in matrices)
    right = B[:, :3, 3] @ R_Z.T - A[:, :3, 3]
    columns = [A[:, :3, :3], np.tile(-np.eye(3), (n, 1, 1))]
    system = columns[0] + columns[1] if pairs.motions else np.concatenate(columns, axis=2)
    z = np.linalg.lstsq(system.reshape(3 * n, -1), right.ravel(), rcond=None)[0]
    return _Value(pose(R_X, z[:3]), pose(R_Z, z[-3:]))


def _residuals(pairs: PosePairs, value: _Value) -> Floats:
    """Both, rho and tau, of every pose, shape (n, 6)."""
    A, B, X, Z = pairs.A, pairs.B, value.X, value.Z
    E = (Z[:3, :3] @ B[:, :3, :3]).transpose(0, 2, 1) @ A[:, :3, :3] @ X[:3, :3]
    tau = A[:, :3, :3] @ X[:3, 3] + A[:, :3, 3] - B[:, :3, 3] @ Z[:3, :3].T - Z[:3, 3]
    return np.column_stack([log_rotation(E), tau])


def _slopes(pairs: PosePairs, value: _Value, centre: Floats | None = None) -> Floats:
    """Their derivatives by (w_X, t_X, w_Z, t_Z), (n, 6, 12), or (n, 6, 6) of motions; Z turns about a centre (3,)."""
    J = np.zeros((len(pairs.names), 6, 12))
    J[:, :3, :3] = np.eye(3)
    J[:, 3:, 3:6] = pairs.A[:, :3, :3]
    J[:, :3, 6:9] = -pairs.B[:, :3, :3].transpose(0, 2, 1)
    arm = pairs.B[:, :3, 3] - (0.0 if centre is None else centre)
    J[:, 3:, 6:9] = value.Z[:3, :3] @ skew(arm)
    J[:, 3:, 9:] = -np.eye(3)
    return J[:, :, :6] + J[:, :, 6:] if pairs.motions else J


def _covariances(pairs: PosePairs, value: _Value, noise: HandEyeNoise) -> Floats:
    """Covariance of each pose's residuals, shape (n, 6, 6)."""
    sigma = np.zeros((len(pairs.names), 6, 6))
    R_A, S = pairs.A[:, :3, :3], skew(value.X[:3, 3])
    lever = -R_A @ S  # of tau by the flange's rotation; that of rho is R_X^T
    sigma[:, :3, :3] = (noise.robot_rad**2 + noise.camera_rad**2) * np.eye(3)
    sigma[:, 3:, 3:] = (noise.robot_mm**2 + noise.camera_mm**2) * np.eye(3)
    sigma[:, 3:, 3:] += noise.robot_rad**2 * lever @ lever.transpose(0, 2, 1)
    sigma[:, :3, 3:] = noise.robot_rad**2 * value.X[:3, :3].T @ lever.transpose(0, 2, 1)
    sigma[:, 3:, :3] = sigma[:, :3, 3:].transpose(0, 2, 1)
    return sigma


ROUNDS = 4
"""How often the spreads are found and the fit repeated with them; they settle to a percent in two."""


def _fit(pairs: PosePairs, start: _Value, noise: HandEyeNoise | None) -> tuple[_Value, Floats]:
    """The value of least squares, and the covariance of each pose's residuals (n, 6, 6)."""
    if noise is not None:
        value = start
        for _ in range(2):  # the weights follow t_X
            sigma = _covariances(pairs, value, noise)
            value = _least_squares(pairs, value, sigma)
        return value, sigma
    spread, value = np.array([1.0 / LENGTH_MM, 1.0]), start
    for _ in range(ROUNDS):
        sigma = np.tile(np.diag(np.repeat(spread**2, 3)), (len(pairs.names), 1, 1))
        value = _least_squares(pairs, value, sigma)
        spread = np.maximum(np.sqrt(_squares(pairs, value) / _free(pairs, value, sigma)), LEAST)
    return value, np.tile(np.diag(np.repeat(spread**2, 3)), (len(pairs.names), 1, 1))


def _squares(pairs: PosePairs, value: _Value) -> Floats:
    """Sums of squares of rho and of tau, shape (2,)."""
    return np.asarray((_residuals(pairs, value) ** 2).reshape(-1, 2, 3).sum(axis=(0, 2)))


def _free(pairs: PosePairs, value: _Value, sigma: Floats) -> Floats:
    """Degrees of freedom that the unknowns leave to rho and to tau, shape (2,)."""
    J = _slopes(pairs, value)
    taken = np.einsum("nip,pq,niq->ni", J, _covariance(J, sigma), J) / np.diagonal(sigma, axis1=1, axis2=2)
    return np.asarray(np.maximum((1.0 - taken).reshape(-1, 2, 3).sum(axis=(0, 2)), 0.5))


def _covariance(J: Floats, sigma: Floats) -> Floats:
    """(sum J^T S^-1 J)^-1, shape (p, p)."""
    return np.asarray(np.linalg.inv((J.transpose(0, 2, 1) @ np.linalg.solve(sigma, J)).sum(axis=0)))


def _least_squares(pairs: PosePairs, start: _Value, sigma: Floats) -> _Value:
    W = np.linalg.inv(np.linalg.cholesky(sigma))

    def white(value: _Value) -> Floats:
        return np.asarray((W @ _residuals(pairs, value)[:, :, None]).ravel())

    def linearised(value: _Value) -> System[_Value]:
        J = (W @ _slopes(pairs, value)).reshape(6 * len(W), -1)
        return System(white(value), J, lambda near: float(np.sum(white(near) ** 2)))

    def arrived(_: object, step: Floats) -> bool:
        return bool(np.abs(step).max() < SMALL_STEP)

    return gauss_newton(start, linearised, _Value.moved, arrived, MOST_STEPS).estimate


def _refuse_rotations(pairs: PosePairs) -> NoReturn:
    """Refuse poses that cannot show every unknown, by what their rotations lack."""
    R = pairs.A[:, :3, :3]
    rotations = log_rotation(R if pairs.motions else nearest_rotation(R.mean(axis=0)).T @ R)
    sizes, axes = np.linalg.svd(rotations / np.sqrt(len(rotations)), full_matrices=False)[1:]
    allowed = "rotations of 10 degrees or more about two axes of the flange that are not parallel"
    if sizes[0] < LEAST_TURN:
        what = "the flange hardly rotates: the camera's place on it can shift in any direction"
        refuse(what, "hand-eye", allowed, "poses_too_alike")
    if sizes[1] < max(LEAST_TURN, 3 * LEAST_RATIO * sizes[0]):
        x, y, z = axes[0]
        what = (
            f"every rotation is about one axis of the flange ({x:+.2f}, {y:+.2f}, {z:+.2f}): the camera can shift "
            "along it"
        )
        refuse(what, "hand-eye", allowed, "poses_too_alike")
    refuse("the poses leave one combination of the unknowns open", "hand-eye", allowed, "poses_too_alike")


def _size_mm(pairs: PosePairs, value: _Value) -> float:
    """Residuals, mm + 100 mm x rad, rms."""
    squares = _squares(pairs, value) / len(pairs.names)
    return float(np.sqrt(squares[1]) + LENGTH_MM * np.sqrt(squares[0]))


def _refuse_slip(pairs: PosePairs, size_mm: float) -> None:
    """Refuse poses that do not fit as given; the reading in which they do is named."""
    if size_mm < SUSPECT_MM:
        return
    readings = {"one of A and B is inverse (base in flange, board in camera)": (inverse(pairs.A), pairs.B)}
    if np.abs(pairs.B[:, :3, 3]).max() < METRES:
        B = pose(pairs.B[:, :3, :3], 1000.0 * pairs.B[:, :3, 3])
        readings["the translations of B are in metres"] = (pairs.A, B)
    for slip, (A, B) in readings.items():
        other = PosePairs(A, B, pairs.names, pairs.motions)
        size = _size_mm(other, _fit(other, _start(other), None)[0])
        if size < BETTER * size_mm and size < SOUND_MM:
            what = f"it does not fit as given ({size_mm:.3g} mm), but it fits ({size:.2g} mm) if {slip}"
            refuse(what, "hand-eye", ALLOWED, "recording_slip")
    if size_mm > SOUND_MM:
        what = f"residuals of {size_mm:.3g} mm (mm + 100 mm x rad, rms): the poses do not belong together"
        refuse(what, "hand-eye", f"residuals up to {SOUND_MM:g} mm; {ALLOWED}", "residuals_too_large")
