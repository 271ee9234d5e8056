"""The result of a self-calibration, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, f

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.base.text import Shown, brief
from puncture_twin.planning.geometry.rigid import log_rotation, pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms, arm_errors, corrected
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import (
    DIRECTION,
    PARAMETERS,
    T_Q,
    Estimate,
    tangent_basis,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import (
    SeenDirection,
    direction_findings,
    linearised_tip,
    needle_in_image,
    tip_points,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.noise import SmallSample, small_sample
from puncture_twin.twin.guidance.ultrasound.axp_ybq.observability import Observability
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, Spread, linear_model
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import ImageErrors, RobustFit, image_errors, weighed

LARGEST_RATIO = 1.1
"""Chi-squared over its freedom from which on a declaration is doubted: arms declared half as large as they are give
1.1 to 1.2. Too large does no harm: the region is wider than it need be."""

NO_NOISE = Noise(0.0, 0.0, 0.0, 0.0)
"""What is queried is where the tip is, not where it would be seen."""


@dataclass(frozen=True, eq=False)
class Calibration(Shown):
    """X, Y and the needle in its flange frame, from A X P = Y B Q.

    Attributes:
        X: T_end1_image, shape (4, 4), mm.
        Y: T_base1_base2, shape (4, 4), mm.
        tip_end2: t_Q, the needle's tip, shape (3,), mm, frame end2.
        needle_direction_end2: V, unit, toward the tip, shape (3,), frame end2.
        scale: mm per unit of P along u and v, shape (2,); ones where it was not wanted.
        residuals: Y B Q - A X P, shape (n, 3), mm, base1, of every pose.
        rms_mm: Root mean square length of the residuals of the poses that were used.
        weights: One per pose, shape (n,): 1 used, 0 set aside.
        outliers: Names of the poses set aside.
        image: What errors of the image the residuals show, significant or not; None where the poses cannot show them.
        findings: What the recording says against itself.
        iterations: Steps of the refinement, all rounds together.
        condition: Least over largest singular value of the Jacobian, lengths in 100 mm.
        covariance: Shape (p, p), of the parameters named below.
        parameters: Names with their units; rotations are small turns on the right, R exp([w]x).
        freedom: Residuals minus unknowns.
        noise: What the weights were made from: given, or found from the residuals (``Spread``).
        shaft_unit: Root mean square of the directions' spreads by their shafts' lengths; 1 where those were not read.
        lean_rad: How far the needle leans out of the image, as the residuals show it.
        noise_ratio: Size of the residuals over what ``noise`` and ``arms`` let expect; far above 1: they are larger.
        tip_bias_mm: How far the detected tip lies beyond the true one along the shaft; None without a needle length.
        orientations: M, rotation from end2 to image, shape (n, 3, 3): how the needle stood in the image.
        cannot_show: What the data cannot tell, in words.
        arms: Both arms' declared errors, which ``covariance`` then counts; None where they were not declared.
        arm_errors: Posterior mean of their parameters, in declared standard deviations; shape (46,), or (52,) and
            (58,) with the play of one arm and of both; (0,) without.
        joint_covariance: Of parameters and arms' errors together, shape (p + m, p + m); ``covariance`` without.
        small_sample: Region with the uncertainty of an estimated noise, where arms are declared.
    """

    X: Floats
    Y: Floats
    tip_end2: Floats
    needle_direction_end2: Floats
    scale: Floats
    residuals: Floats
    rms_mm: float
    weights: Floats
    outliers: tuple[str, ...]
    image: ImageErrors | None
    findings: tuple[Finding, ...]
    iterations: int
    condition: float
    covariance: Floats
    parameters: tuple[str, ...]
    freedom: int
    noise: Noise | Spread
    shaft_unit: float
    lean_rad: float
    noise_ratio: float
    tip_bias_mm: float | None
    orientations: Floats
    cannot_show: tuple[str, ...]
    arms: DeclaredArms | None
    arm_errors: Floats
    joint_covariance: Floats
    small_sample: SmallSample | None

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
        return (
            *warnings,
            f"chi-squared of the residuals is {ratio:.2f} times their degrees of freedom ({self.freedom}): the "
            "declared noise or arm errors are probably too small, and so are the stated errors; a correct "
            f"declaration gives this in {chance:.2g} % of cases",
        )

    @property
    def covariance_counts(self) -> Floats:
        """Covariance of the regions, with the uncertainty of an estimated noise in it."""
        return self.covariance if self.small_sample is None else self.small_sample.covariance

    def corrected(self, poses: Recording) -> tuple[Floats, Floats]:
        """Poses A and B of both flanges, corrected by the estimated errors of the arms, each (n, 4, 4), mm.

        Args:
            poses: Nominal flanges, with joints where arms are declared.
        """
        if self.arms is None:
            return poses.A, poses.B
        errors = arm_errors(self.arms, poses)
        probe, needle = np.split(self.arm_errors, [errors.probe.slopes.shape[2]])
        motions = errors.probe.play + errors.probe.slopes @ probe, errors.needle.play + errors.needle.slopes @ needle
        return corrected(poses.A, motions[0]), corrected(poses.B, motions[1])

    def tip_covariances(self, poses: Recording) -> Floats:
        """Covariance of where the tip is against where the image has it, shape (n, 3, 3), mm^2, base1.

        With declared arms it counts parameters and arms together, and how differently the joints stop.

        Args:
            poses: Flanges and the tip in the image; with joints where arms are declared.
        """
        errors = None if self.arms is None else arm_errors(self.arms, poses)
        tip_names = [name for name in self.parameters if not name.startswith("V")]
        active = np.array([PARAMETERS.index(name) for name in tip_names])
        problem = Problem(poses, NO_NOISE, active, arms=errors)
        model = linear_model(problem, self.estimate)
        J, rows = model.jacobian, np.arange(len(active))
        if model.shared is not None:
            J = np.concatenate([J, model.shared], axis=2)
            rows = np.append(rows, np.arange(len(self.parameters), len(self.joint_covariance)))
        C = self.joint_covariance[np.ix_(rows, rows)]
        return np.asarray(J @ C @ J.transpose(0, 2, 1) + model.sigma)

    def predicted_tre_mm(self, points_image: Floats, A: Floats) -> Floats:
        """Expected (rms) distance of the tip from a target seen in the image, from the covariance alone.

        The needle is taken to stand in the image as it did in the recording, one orientation as likely as the other.

        Args:
            points_image: Shape (m, 2), in the recording's unit, or (m, 3), mm.
            A: T_base1_end1, shape (4, 4) or (m, 4, 4), mm.

        Returns:
            Shape (m,), mm.
        """
        points = np.atleast_2d(np.asarray(points_image, dtype=np.float64))[:, :3]
        A = np.broadcast_to(A, (len(points), 4, 4))
        mean = self.orientations.mean(axis=0)
        J = linearised_tip(self.estimate, self._aimed(points, A)).jacobian
        J[:, :, T_Q] = A[:, :3, :3] @ self.X[:3, :3] @ mean
        names = np.array(self.parameters)
        J = J[:, :, [PARAMETERS.index(name) for name in names]]
        squared = np.einsum("nip,pq,niq->n", J, self.covariance, J)
        tip = np.flatnonzero(np.char.startswith(names, "t_Q"))
        if len(tip):  # what the mean orientation leaves out of E[R_B C R_B^T]
            squared = squared + np.trace(self.covariance[np.ix_(tip, tip)] @ (np.eye(3) - mean.T @ mean))
        return np.asarray(np.sqrt(squared))

    def _aimed(self, points: Floats, A: Floats) -> Recording:
        """Poses of the needle's arm that bring the tip to image points."""
        estimate = self.estimate
        B = np.tile(np.eye(4), (len(points), 1, 1))
        in_end1, _ = tip_points(estimate, Recording(A, B, points))
        target = np.einsum("nij,nj->ni", A[:, :3, :3], in_end1) + A[:, :3, 3]
        B[:, :3, 3] = (target - estimate.t_Y) @ estimate.R_Y - estimate.t_Q
        return Recording(A, B, points)

    @property
    def estimate(self) -> Estimate:
        """The values as an `Estimate` for the solvers."""
        X, Y = self.X, self.Y
        tip, V = self.tip_end2, self.needle_direction_end2
        return Estimate(X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3], tip, self.scale, V)

    def parameter_error(self, other: Estimate) -> Floats:
        """Another estimate minus this one in the order of ``parameters``, shape (p,): the step that leads there."""
        own = self.estimate
        parts = [
            log_rotation(own.R_X.T @ other.R_X),
            other.t_X - own.t_X,
            log_rotation(own.R_Y.T @ other.R_Y),
            other.t_Y - own.t_Y,
            other.t_Q - own.t_Q,
            other.scale - own.scale,
            tangent_basis(own.V).T @ other.V,
        ]
        return np.concatenate(parts)[[PARAMETERS.index(name) for name in self.parameters]]

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


def calibration_of(
    problem: Problem,
    fit: RobustFit,
    observability: Observability,
    seen: SeenDirection,
    cannot_show: tuple[str, ...],
    arms: DeclaredArms | None,
) -> Calibration:
    """The calibration at a fit, under the estimated or declared noise; its arrays are read-only.

    Args:
        seen: The needle's direction before it took part.
        cannot_show: What the poses cannot show, one sentence each.
        arms: As declared.
    """
    at_fit, estimate, kept, p = weighed(problem, fit), fit.estimate, fit.tip_kept, len(problem.active)
    freedom = 3 * int(kept.sum()) + 2 * int(fit.direction_kept.sum()) * problem.with_direction - p
    residuals, names = at_fit.residuals[:, :3], problem.recording.names
    image, directions = image_errors(problem, fit), direction_findings(names, kept & ~fit.direction_kept, seen)
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
        findings=directions if image is None or not image.significant else (*directions, image.finding()),
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


def with_length(found: Calibration, length_mm: float) -> Calibration:
    """The calibration after t_Q <- t_Q - (V.t_Q - length) V."""
    V, t_Q, p = found.needle_direction_end2, found.tip_end2, len(found.parameters)
    bias = float(V @ t_Q) - length_mm
    full = np.eye(len(PARAMETERS))
    full[T_Q, T_Q] -= np.outer(V, V)
    full[T_Q, DIRECTION] = -(bias * np.eye(3) + np.outer(V, t_Q)) @ tangent_basis(V)
    active = [PARAMETERS.index(name) for name in found.parameters]
    whole = np.eye(len(found.joint_covariance))
    whole[:p, :p] = change = full[np.ix_(active, active)]
    joint, region = np.asarray(whole @ found.joint_covariance @ whole.T), found.small_sample
    return replace(
        found,
        tip_end2=read_only(t_Q - bias * V),
        covariance=read_only(joint[:p, :p]),
        tip_bias_mm=bias,
        joint_covariance=read_only(joint),
        small_sample=None if region is None else region._replace(covariance=change @ region.covariance @ change.T),
    )
