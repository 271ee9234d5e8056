"""From a recording to a calibration of A X P = Y B Q: checks, closed form, robust fit, noise; and further shots.

It is refused where the poses cannot determine every unknown. Letters and frames: docs/concepts/selfcalibration.md.

Further pictures update it one by one. The unknowns x are the step from the calibration (parameters, and the arms'
errors where they are declared), linearised there once. A shot has the residuals r + H x, their covariance S (3 of the
tip, 2 of the direction). With the information L and its vector l (the information filter: Maybeck, Stochastic Models,
1979, section 5.7)

    L <- L + H^T S^-1 H,    l <- l - H^T S^-1 r,    x = L^-1 l,

so shots commute, and n of them are the batch solution, to linearisation. Before a shot counts, e = r + H x is tested:
e^T (S + H L^-1 H^T)^-1 e is chi-squared where the shot belongs to the others; one that does not fit changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv
from scipy.stats import chi2, f

from puncture_twin.planning.base.arrays import Bools, Floats, Ints, read_only
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.text import Shown, brief, plural
from puncture_twin.planning.geometry.rigid import log_rotation, pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms, arm_errors, corrected, without_play
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import (
    DIRECTION,
    LEAST_POSES,
    N_PARAMETERS,
    PARAMETERS,
    REVERSED,
    T_Q,
    UNWEIGHTED,
    Estimate,
    Problem,
    SeenDirection,
    Spread,
    active_columns,
    closed_form,
    counted,
    linearised_tip,
    needle_in_image,
    tangent_basis,
    tip_points,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fit import (
    ImageErrors,
    SmallSample,
    Solution,
    small_sample,
    solve,
    weighed,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording

LARGEST_RATIO = 1.1
"""Chi-squared over its freedom from which on a declaration is doubted: arms declared half as large as they are give
1.1 to 1.2. Too large does no harm: the region is wider than it need be."""
NO_NOISE = Noise(0.0, 0.0, 0.0, 0.0)
"""What is queried is where the tip is, not where it would be seen."""


@dataclass(frozen=True, eq=False)
class Calibration(Shown):
    """X, Y and the needle in its flange frame, from A X P = Y B Q."""

    X: Floats  # T_end1_image, shape (4, 4), mm; Y: T_base1_base2
    Y: Floats
    tip_end2: Floats  # t_Q, the needle's tip, shape (3,), mm, frame end2
    needle_direction_end2: Floats  # V, unit, toward the tip, shape (3,), frame end2
    scale: Floats  # mm per unit of P along u and v, shape (2,); ones where it was not wanted
    residuals: Floats  # Y B Q - A X P, shape (n, 3), mm, base1, of every pose
    rms_mm: float  # root mean square length of the residuals of the poses that were used
    weights: Floats  # one per pose, shape (n,): 1 used, 0 set aside; the latter's names are the ``outliers``
    outliers: tuple[str, ...]
    image: ImageErrors | None
    """What errors of the image the residuals show, significant or not; None where the poses cannot show them."""
    findings: tuple[Finding, ...]  # what the recording says against itself
    iterations: int  # steps of the refinement, all rounds together
    condition: float  # least over largest singular value of the Jacobian, lengths in 100 mm
    covariance: Floats  # shape (p, p), of the ``parameters``, whose names hold their units; rotations are R exp([w]x)
    parameters: tuple[str, ...]
    freedom: int  # residuals minus unknowns
    noise: Noise | Spread  # what the weights were made from: given, or found from the residuals (``Spread``)
    shaft_unit: float
    """Root mean square of the directions' spreads by their shafts' lengths; 1 where those were not read."""
    lean_rad: float  # how far the needle leans out of the image, as the residuals show it
    noise_ratio: float
    """Size of the residuals over what ``noise`` and ``arms`` let expect; far above 1: they are larger."""
    tip_bias_mm: float | None
    """How far the detected tip lies beyond the true one along the shaft; None without a needle length."""
    orientations: Floats  # M, rotation from end2 to image, shape (n, 3, 3): how the needle stood in the image
    cannot_show: tuple[str, ...]  # what the data cannot tell, in words
    arms: DeclaredArms | None
    """Both arms' declared errors, which ``covariance`` then counts; None where they were not declared."""
    arm_errors: Floats
    """Posterior mean of their parameters, in declared standard deviations; shape (46,), or (52,) and (58,) with the
    play of one arm and of both; (0,) without."""
    joint_covariance: Floats  # of parameters and arms' errors together, shape (p + m, p + m); ``covariance`` without
    small_sample: SmallSample | None  # region with the uncertainty of an estimated noise, where arms are declared

    @brief
    def __repr__(self) -> str:
        return f"{len(self.weights)} poses, {len(self.outliers)} set aside, residuals {self.rms_mm:.3f} mm (rms)"

    @property
    def chi_squared_ratio(self) -> float:
        """Chi-squared of the residuals over their freedom: 1 where noise and arms are as declared."""
        return self.noise_ratio**2

    def chi_squared_chance(self) -> float:
        """Chance of residuals as large as these under a right declaration."""
        return float(chi2.sf(self.chi_squared_ratio * self.freedom, self.freedom))

    def warnings(self) -> tuple[str, ...]:
        """Warnings, and one where the residuals exceed what the stated noise and arms lead to expect."""
        warnings = tuple(one.sentence for one in self.findings if one.severity is Severity.WARNING)
        ratio = self.chi_squared_ratio
        if not isinstance(self.noise, Noise) or ratio <= LARGEST_RATIO:
            return warnings
        chance = 100.0 * self.chi_squared_chance()
        text = f"chi-squared of the residuals is {ratio:.2f} times their degrees of freedom ({self.freedom})"
        small = "the declared noise or arm errors are probably too small, and so are the stated errors"
        return (*warnings, f"{text}: {small}; a correct declaration gives this in {chance:.2g} % of cases")

    @property
    def covariance_counts(self) -> Floats:
        """Covariance of the regions, with the uncertainty of an estimated noise in it."""
        return self.covariance if self.small_sample is None else self.small_sample.covariance

    def corrected(self, poses: Recording) -> tuple[Floats, Floats]:
        """Poses A and B of both flanges, corrected by the estimated errors of the arms, each (n, 4, 4), mm."""
        if self.arms is None:
            return poses.A, poses.B
        errors = arm_errors(self.arms, poses)
        probe, needle = np.split(self.arm_errors, [errors.probe.slopes.shape[2]])
        motions = errors.probe.play + errors.probe.slopes @ probe, errors.needle.play + errors.needle.slopes @ needle
        return corrected(poses.A, motions[0]), corrected(poses.B, motions[1])

    def tip_covariances(self, poses: Recording) -> Floats:
        """Covariance of where the tip is against where the image has it, shape (n, 3, 3), mm^2, base1.

        With declared arms, whose joints the poses then hold, it counts how differently they stop too.
        """
        errors = None if self.arms is None else arm_errors(self.arms, poses)
        active = self.active[self.active < DIRECTION.start]
        model = Problem(poses, NO_NOISE, active, arms=errors).linear_model(self.estimate)
        J, rows = model.jacobian, np.arange(len(active))
        if model.shared is not None:
            J = np.concatenate([J, model.shared], axis=2)
            rows = np.append(rows, np.arange(len(self.parameters), len(self.joint_covariance)))
        C = self.joint_covariance[np.ix_(rows, rows)]
        return np.asarray(J @ C @ J.transpose(0, 2, 1) + model.sigma)

    def predicted_tre_mm(self, points_image: Floats, A: Floats) -> Floats:
        """Expected (rms) distance of the tip from targets in the image, from the covariance alone, shape (m,), mm.

        The needle is taken to stand in the image as it did in the recording, one orientation as likely as the other.
        Targets (m, 2) are in the recording's unit, or (m, 3), mm; T_base1_end1 is (4, 4) or (m, 4, 4), mm.
        """
        points = np.atleast_2d(np.asarray(points_image, dtype=np.float64))[:, :3]
        A, estimate = np.broadcast_to(A, (len(points), 4, 4)), self.estimate
        B = np.tile(np.eye(4), (len(points), 1, 1))  # brings the tip to the points
        in_end1, _ = tip_points(estimate, Recording(A, B, points))
        target = np.einsum("nij,nj->ni", A[:, :3, :3], in_end1) + A[:, :3, 3]
        B[:, :3, 3] = (target - estimate.t_Y) @ estimate.R_Y - estimate.t_Q
        J, mean = linearised_tip(estimate, Recording(A, B, points)).jacobian, self.orientations.mean(axis=0)
        J[:, :, T_Q] = A[:, :3, :3] @ self.X[:3, :3] @ mean
        J = J[:, :, self.active]
        squared = np.einsum("nip,pq,niq->n", J, self.covariance, J)
        left = np.trace(self.covariance[T_Q, T_Q] @ (np.eye(3) - mean.T @ mean))  # by it, of E[R_B C R_B^T]
        return np.asarray(np.sqrt(squared + left))

    @property
    def active(self) -> Ints:
        """The parameters' columns among all that may be estimated, shape (p,)."""
        return np.array([PARAMETERS.index(name) for name in self.parameters])

    @property
    def estimate(self) -> Estimate:
        """The values as an `Estimate` for the solvers."""
        X, Y = self.X, self.Y
        tip, V = self.tip_end2, self.needle_direction_end2
        return Estimate(X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3], tip, self.scale, V)

    def parameter_error(self, other: Estimate) -> Floats:
        """Another estimate minus this one in the order of ``parameters``, shape (p,): the step that leads there."""
        own = self.estimate
        parts = [log_rotation(own.R_X.T @ other.R_X), other.t_X - own.t_X]
        parts += [log_rotation(own.R_Y.T @ other.R_Y), other.t_Y - own.t_Y]
        parts += [other.t_Q - own.t_Q, other.scale - own.scale, tangent_basis(own.V).T @ other.V]
        return np.concatenate(parts)[self.active]

    def region_limit(self, level: float = 0.95) -> float:
        """Largest e^T C^-1 e inside the confidence region, e as in ``parameter_error``.

        C is ``covariance_counts``. Chi-squared for a given noise; with declared arms ``small_sample`` says it. For a
        spread found from the residuals Fisher's F; the least-known part of that spread has one residual per pose, so
        that only this fraction of the freedom counts.
        """
        p = len(self.parameters)
        if self.small_sample is not None:
            return self.small_sample.limit(level)
        if isinstance(self.noise, Noise):
            return float(chi2.ppf(level, p))
        per_pose = 5 if "V_1_rad" in self.parameters else 3
        return float(p * f.ppf(level, p, max(self.freedom / per_pose, 1.0)))


def calibration_of(solution: Solution, cannot_show: tuple[str, ...], arms: DeclaredArms | None) -> Calibration:
    """The calibration of a solution, with what the poses cannot show."""
    problem, fit, observability, seen, image = solution
    at_fit, estimate, kept, p = weighed(problem, fit), fit.estimate, fit.tip_used, len(problem.active)
    freedom = 3 * int(kept.sum()) + 2 * int(fit.direction_used.sum()) * problem.with_direction - p
    residuals, names = at_fit.residuals[:, :3], problem.recording.names
    findings = [*direction_findings(names, kept & ~fit.direction_used, seen)]
    if image is not None and image.significant:
        findings.append(image.finding())
    return Calibration(
        X=read_only(pose(estimate.R_X, estimate.t_X)),
        Y=read_only(pose(estimate.R_Y, estimate.t_Y)),
        tip_end2=read_only(estimate.t_Q),
        needle_direction_end2=read_only(estimate.V),
        scale=read_only(estimate.scale),
        residuals=read_only(residuals),
        rms_mm=float(np.sqrt(np.mean(np.sum(residuals[kept] ** 2, axis=1)))),
        weights=read_only(1.0 * kept),
        outliers=tuple(name for name, used in zip(names, kept, strict=True) if not used),
        image=image,
        findings=tuple(findings),
        iterations=fit.iterations,
        condition=observability.ratio,
        covariance=read_only(at_fit.covariance[:p, :p]),
        parameters=tuple(PARAMETERS[column] for column in problem.active),
        freedom=freedom,
        noise=problem.noise,
        shaft_unit=problem.recording.shaft_unit,
        lean_rad=problem.lean_rad,
        noise_ratio=float(np.sqrt(at_fit.chi_squared / max(freedom, 1))),
        tip_bias_mm=None,
        orientations=read_only(needle_in_image(estimate, problem.recording)),
        cannot_show=cannot_show,
        arms=arms,
        arm_errors=read_only(at_fit.shared),
        joint_covariance=read_only(at_fit.covariance),
        small_sample=small_sample(problem, fit) if problem.arms is not None else None,
    )


FEW = 0.1
"""Fraction of the directions that may be set aside without a warning: single ones are, in one true recording of 20."""


def direction_findings(names: tuple[str, ...], aside: Bools, seen: SeenDirection) -> Iterator[Finding]:
    """Directions set aside (n,) though their tip was used, those that are reversed, and whether their sign is known."""
    for code, rows, problem, most in (
        ("directions_reversed", seen.reversed, REVERSED, 0.0),
        ("directions_aside", aside & ~seen.reversed, "v contradicts the other poses", FEW),
    ):
        if rows.any():
            severity = Severity.WARNING if rows.mean() > most else Severity.NOTE
            text = f"{counted(names, rows, problem)}; these directions were set aside"
            yield Finding(code, severity, text, {"count": float(rows.sum())})
    if not seen.sign_known:
        said = "the tip is not on the measured axis of the needle"
        text = f"{said}: its sense, taken from most directions, could not be checked"
        yield Finding("direction_sign", Severity.WARNING, text)


def with_length(calibration: Calibration, length_mm: float) -> Calibration:
    """The calibration after t_Q <- t_Q - (V.t_Q - length) V."""
    V, t_Q, p = calibration.needle_direction_end2, calibration.tip_end2, len(calibration.parameters)
    bias = float(V @ t_Q) - length_mm
    full = np.eye(len(PARAMETERS))
    full[T_Q, T_Q] -= np.outer(V, V)
    full[T_Q, DIRECTION] = -(bias * np.eye(3) + np.outer(V, t_Q)) @ tangent_basis(V)
    whole = np.eye(len(calibration.joint_covariance))
    whole[:p, :p] = change = full[np.ix_(calibration.active, calibration.active)]
    joint, region = np.asarray(whole @ calibration.joint_covariance @ whole.T), calibration.small_sample
    return replace(
        calibration,
        tip_end2=read_only(t_Q - bias * V),
        covariance=read_only(joint[:p, :p]),
        tip_bias_mm=bias,
        joint_covariance=read_only(joint),
        small_sample=None if region is None else region._replace(covariance=change @ region.covariance @ change.T),
    )


SHAFT_BIAS = (
    "a constant error of the detected tip along the shaft shifts the tip in the needle's flange frame but changes no "
    "residual; a known needle length would fix it"
)
ARMS_TAKEN = (
    "errors of the arms that repeat from pose to pose (lengths, joint zeros): none were declared together with the "
    "joints, so the stated errors count only noise and are too small"
)
PLAY_SIGN = (
    "on which side of their backlash the joints were: the recording does not state how they rotated, so backlash "
    "counts as noise, and the region is too narrow where the noise was estimated"
)
DIRECTION_SIGN = (
    "no directions were measured: the needle's axis comes from the image plane alone, pointing from flange to tip"
)
ADVISED_POSES = 20
"""From 20 poses on the closed form is well conditioned (median 5e2; 6e3 at 16)."""


def calibrate(
    recording: Recording,
    *,
    noise: Noise | None = None,
    needle_length_mm: float | None = None,
    scale: bool = False,
    direction: bool = True,
    arms: DeclaredArms | None = None,
) -> Calibration:
    """Solve A X P = Y B Q: closed form, then weighted least squares over the poses that agree.

    A: T_base1_end1, B: T_base2_end2, of every pose; P: the tip in the image; X: T_end1_image; Y: T_base1_base2; Q: the
    tip in end2. At least 16 poses (20 are better); one more where P has three coordinates.

    Args:
        noise: Of both arms and the image; None estimates the residuals' spread, inside and across the image.
        needle_length_mm: Distance along the shaft from the flange's origin to the tip: determines a constant error of
            the detected tip along the shaft, which nothing else does.
        scale: Whether mm per unit of P, along both axes of the image, is estimated.
        direction: Whether measured needle directions take part.
        arms: Declared errors that repeat from pose to pose; the recording then needs joints. None takes all errors of
            the flanges for noise.

    Raises:
        InputError: Too few poses, or more than half of them disagree; joints that are missing or of another arm.
        Degenerate: The poses cannot show every unknown. It names the motion and proposes further poses.
    """
    if needle_length_mm is not None and not 0 < needle_length_mm < np.inf:
        refuse(f"needle length {needle_length_mm}", "needle_length_mm", "a positive number, mm", "not_positive")
    _check(recording, scale)
    # 1. Where to begin.
    errors = None if arms is None else arm_errors(arms, recording)
    poses = recording if errors is None else without_play(recording, errors)
    problem = Problem(poses, noise or UNWEIGHTED, active_columns(scale=scale, direction=False), arms=errors)
    start = closed_form(poses, scale=scale)
    # 2. The fit: outliers, observability, directions, noise.
    solution = solve(problem, start, direction=direction and recording.v is not None)
    # 3. What the recording cannot show, and the result with its covariance.
    cannot = [SHAFT_BIAS] * (needle_length_mm is None)
    cannot += [DIRECTION_SIGN] * (recording.v is None) + [ARMS_TAKEN] * (arms is None)
    if arms is not None and recording.turn_probe is None and any(arm.errors.backlash > 0.0 for arm in arms):
        cannot.append(PLAY_SIGN)
    calibration = calibration_of(solution, tuple(cannot), arms)
    return calibration if needle_length_mm is None else with_length(calibration, needle_length_mm)


def _check(recording: Recording, scale: bool) -> None:
    if recording.pixels and not scale:
        refuse("the tip is in pixels", "recording", "mm, or scale to estimate mm per pixel", "wrong_unit")
    if scale and recording.P.shape[1] == 3:
        refuse("three coordinates and scale", "recording", "three coordinates in mm", "wrong_unit")
    least = LEAST_POSES + (recording.P.shape[1] == 3)
    if len(recording) < least:
        missed = f" (and {plural(len(recording.missed), 'picture')} without a needle)" if recording.missed else ""
        allowed = f"{least} or more, preferably {ADVISED_POSES}"
        refuse(plural(len(recording), "pose") + missed, "recording", allowed, "too_few_poses")


FALSE_ALARM = 1e-3
"""Chance that a shot which belongs to the others is refused."""


class Shot(NamedTuple):
    """Test of one shot: its residuals' chi-squared, and the limit beyond which it does not fit and is left out."""

    name: str
    used: bool
    chi_squared: float
    limit: float


@dataclass(frozen=True, eq=False)
class ShotByShot(Shown):
    """A calibration, where everything is linearised, with the shots since, used or not."""

    start: Calibration
    information: Floats  # shape (p + m, p + m), of parameters and arms' errors
    vector: Floats  # shape (p + m,), the information times the step from the start
    shots: tuple[Shot, ...] = ()

    @brief
    def __repr__(self) -> str:
        return f"{len(self.shots)} shots, {sum(not one.used for one in self.shots)} of them did not fit"

    @classmethod
    def of(cls, calibration: Calibration) -> ShotByShot:
        """From a calibration of a recording, with no shot yet.

        Raises:
            InputError: It holds a needle length, so that its tip is not the one that pictures show.
        """
        if calibration.tip_bias_mm is not None:
            what = "a calibration that holds the needle's length"
            refuse(what, "shots", "one without; the length is stated to `calibration`", "conflicting_options")
        C = calibration.joint_covariance
        return cls(calibration, read_only(np.linalg.inv(C)), read_only(np.zeros(len(C))))

    def with_shot(self, pose: Recording) -> ShotByShot:
        """The calibration after one more shot of one pose, used where it fits; ``shots[-1]`` states it.

        Raises:
            InputError: More than one pose, or no joints where the start declares arms.
        """
        if len(pose) != 1:
            refuse(f"{len(pose)} poses", "shot", "one pose", "wrong_shape")
        start, name = self.start, pose.names[0]
        errors = None if start.arms is None else arm_errors(start.arms, pose)
        if errors is not None:
            pose = without_play(pose, errors)
        active = start.active if pose.v is not None else start.active[start.active < DIRECTION.start]
        model = Problem(pose, start.noise, active, start.lean_rad, errors).linear_model(start.estimate)
        r, S, H = model.residuals[0], model.sigma[0], np.zeros((len(model.residuals[0]), len(self.vector)))
        if pose.v is not None and len(r) == 5:  # against the start's directions, not against itself
            longer = (pose.shaft_unit / start.shaft_unit) ** 2
            S[3, 3] += (longer - 1.0) * start.noise.direction_rad**2
        H[:, : len(active)] = model.jacobian[0]
        if model.shared is not None:
            H[:, len(start.parameters) :] = model.shared[0]
            r = r + model.shared[0] @ start.arm_errors
        factor = np.linalg.cholesky(self.information)
        back = np.linalg.solve(factor, H.T)  # H L^-1 H^T = back^T back
        e = r + back.T @ np.linalg.solve(factor, self.vector)
        chi_squared = float(e @ np.linalg.solve(S + back.T @ back, e))
        limit = float(2 * gammaincinv(len(r) / 2, 1 - FALSE_ALARM))
        shot = Shot(name, chi_squared <= limit, chi_squared, limit)
        if not shot.used:
            return replace(self, shots=(*self.shots, shot))
        pulled = np.linalg.solve(S, H)
        information, vector = self.information + H.T @ pulled, self.vector - pulled.T @ r
        return ShotByShot(self.start, read_only(information), read_only(vector), (*self.shots, shot))

    def calibration(self, *, needle_length_mm: float | None = None) -> Calibration:
        """The calibration after all shots that fit, the flange to tip along the shaft held where its length is given.

        Its residuals, weights and findings are those of the recording at the start.
        """
        C, start = np.linalg.inv(self.information), self.start
        step, p, full = C @ self.vector, len(start.parameters), np.zeros(N_PARAMETERS)
        full[start.active] = step[:p]
        after = start.estimate.moved(full)
        calibration = replace(
            start,
            X=read_only(pose(after.R_X, after.t_X)),
            Y=read_only(pose(after.R_Y, after.t_Y)),
            tip_end2=read_only(after.t_Q),
            needle_direction_end2=read_only(after.V),
            scale=read_only(after.scale),
            covariance=read_only(C[:p, :p]),
            joint_covariance=read_only(C),
            arm_errors=read_only(start.arm_errors + step[p:]),
            small_sample=None,
        )
        return calibration if needle_length_mm is None else with_length(calibration, needle_length_mm)
