"""Covariance of the needle's pose against the anatomy at the end of an insertion, its sources, and its bound.

With J_i the arm's error Jacobian at marker i's touch and J_f at the insertion, L the registration's map, X its
transport to the target, Omega what errs anew at each marker:

    Sigma6 = G Sigma_eta G' + X L Omega L' X' + (rep^2 + jitter^2 + drift^2) Jq_f Jq_f',   G = J_f - X L J

The minus sign is the cancellation: what the arm does wrong at the markers it does again at the target.
`AnyPose` bounds the error in all configurations that put the tip on the target.

How to touch the markers so that the arm's errors cancel best: touched with the insertion's own orientation and branch,
errors of a nominal UR3 fall to a third; touched from elsewhere they add up. Motion and contact are not tested here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, fdtri

from puncture_twin.planning.arm.inverse_kinematics import branch_of, inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import PARAMETERS, error_jacobian, flange_pose, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.geometry.rigid import apply, exp_rotation
from puncture_twin.planning.registration.fits import FitUncertainty
from puncture_twin.planning.registration.marker_noise import LEAST_SINGULARITY
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.uncertainty.sources import reading_parts


def not_cancelled(fit: FitUncertainty, J: Floats, target_base: Floats) -> Floats:
    """G = J_f - X L J: the arm's error Jacobian (n, 6, 28) without the part that the registration cancels.

    Tip (mm) then rotation (rad), base axes; X carries the registration to the target (3,), mm. Where it is not stated
    how the arm touched the markers, sqrt(2) J_f replaces it: errors of equal size at the markers and at the target,
    independent.
    """
    if not fit.noise.touches_known:
        return np.asarray(np.sqrt(2.0) * J)  # as if the markers' errors were new ones of the same size
    return np.asarray(J - fit.map_at(target_base) @ fit.noise.arm_jacobian)


class Bend(NamedTuple):
    """Deflection of the tip by the bevel, to any side alike, and distance of the shaft's clamp behind it; mm."""

    tip_mm: float
    clamped_mm: float

    def sides(self, model: UrModel, q: Floats) -> Floats:
        """S with S S' the covariance of a tip off by d to a uniform side, the shaft rotated about its clamp.

        For the sides x and y of the needle, whose z points to the tip: the tip by d x with the shaft about y by d / h,
        and by d y with the shaft about -x; each with half the variance.

        Shape (..., 6, 2), base axes, for q of shape (..., 6), rad.
        """
        R = flange_pose(model, q)[..., :3, :3]  # the needle lies along the flange's z
        x, y, per_mm = R[..., 0], R[..., 1], 1 / self.clamped_mm
        columns = [np.concatenate([x, per_mm * y], axis=-1), np.concatenate([y, -per_mm * x], axis=-1)]
        return np.asarray(self.tip_mm / np.sqrt(2.0) * np.stack(columns, axis=-1))


@dataclass(frozen=True, eq=False)
class PoseError:
    """The needle's pose error in any configuration that puts its tip on the target."""

    model: UrModel
    tip_mm: float  # flange to tip
    target_base: Floats  # shape (3,), mm
    errors: ErrorModel
    fit: FitUncertainty
    """What the registration makes of them; its test's scale multiplies every covariance but that of the bend."""
    bend: Bend | None = None
    """Of one direction's needle; None where it is straight, or where it is not of one direction."""

    @property
    def freedom(self) -> int | None:
        """Degrees of freedom of the errors' size where the residuals gave it; None where it is declared."""
        return self.fit.test.freedom if self.fit.test.scaled else None

    def covariance(self, q: Floats) -> Floats:
        """Sigma6 of configurations (n, 6), rad: shape (n, 6, 6), tip (mm) then rotation (rad), base axes."""
        readings = self.fit.cov_at(self.target_base)
        J, arm = error_jacobian(self.model, q, self.tip_mm), self.errors.arm
        lasting = not_cancelled(self.fit, J, self.target_base) * np.sqrt(self.fit.noise.eta_variances)
        anew = J[..., PARAMETERS["joint"]] * np.hypot(arm.drift, arm.arriving)
        root = self.fit.test.scale * np.concatenate([lasting, anew], axis=-1)  # root @ root' is the arm's part
        straight = readings + root @ np.swapaxes(root, -1, -2)
        return straight if self.bend is None else straight + _bend_covariance(self.model, q, self.bend)

    def tip_covariance(self, q: Floats) -> Floats:
        """Covariance of the tip about the intended point, its reading included: (n, 3, 3), mm^2, base axes."""
        return self.covariance(q)[:, :3, :3] + self.target_covariance

    def covariance_ct(self, q: Floats) -> Floats:
        """Sigma6 in CT axes, shape (n, 6, 6)."""
        rotation = np.kron(np.eye(2), self.fit.R_base_ct)  # rotates shift and rotation alike
        return np.asarray(rotation.T @ self.covariance(q) @ rotation)

    def tip_covariance_ct(self, q: Floats) -> Floats:
        """`tip_covariance` in CT axes, shape (n, 3, 3)."""
        R = self.fit.R_base_ct
        return np.asarray(R.T @ self.tip_covariance(q) @ R)

    def surface_cov_ct(self, voxel_ct: Floats | None) -> Floats:
        """`ErrorModel.surface_cov_ct`, scaled like everything that is declared."""
        return np.asarray(self.fit.test.scale**2 * self.errors.surface_cov_ct(voxel_ct))

    @property
    def target_covariance_ct(self) -> Floats:
        """Covariance of the target's reading, shape (3, 3), mm^2, CT axes, scaled."""
        return np.asarray(self.fit.test.scale**2 * self.errors.target_cov_ct)

    @property
    def target_covariance(self) -> Floats:
        """`target_covariance_ct` in base axes."""
        R = self.fit.R_base_ct
        return np.asarray(R @ self.target_covariance_ct @ R.T)

    def parts(self, q: Floats) -> dict[str, Floats]:
        """Sigma6 by source, each of shape (n, 6, 6); they add up to `covariance`."""
        # of the markers: CT reading, touch, and the arm's repeatability there, the same for all rows
        J = error_jacobian(self.model, q, self.tip_mm)
        at, noise = self.fit.map_at(self.target_base), self.fit.noise
        marks = at.reshape(6, -1, 3)
        R, touch = self.fit.R_base_ct, self.errors.touch_mm**2 * np.eye(3)
        blocks = {
            **{source: R @ cov @ R.T for source, cov in reading_parts(noise.cov_ct).items()},
            "touch": touch,
            "repeatability": noise.cov_base - touch,
        }
        unscaled = dict[str, Floats]()
        for source, block in blocks.items():
            of_each = np.broadcast_to(block, noise.cov_base.shape)
            cov = np.einsum("anb,nbc,dnc->ad", marks, of_each, marks)
            unscaled[source] = np.broadcast_to(cov, (len(q), 6, 6))
        # of the arm's parameters, of its drift since the touches, and of one arrival at the target
        G, eta = not_cancelled(self.fit, J, self.target_base), self.fit.noise.eta_variances
        unscaled |= {source: _outer(G[..., part], eta[part]) for source, part in PARAMETERS.items()}
        Jq, arm = J[..., PARAMETERS["joint"]], self.errors.arm
        unscaled["drift"] = _outer(Jq, np.full(6, arm.drift**2))
        unscaled["arrival"] = _outer(Jq, np.full(6, arm.repeatability**2))
        if arm.jitter != 0.0:
            unscaled["jitter"] = _outer(Jq, np.full(6, arm.jitter**2))
        parts = {source: self.fit.test.scale**2 * cov for source, cov in unscaled.items()}
        return parts if self.bend is None else {**parts, "bend": _bend_covariance(self.model, q, self.bend)}

    def mean_squares(self, q: Floats) -> dict[str, float]:
        """Mean square of the tip by source at one configuration (6,), rad; mm^2."""
        parts = {source: float(np.trace(cov[0, :3, :3])) for source, cov in self.parts(q[None]).items()}
        parts["repeatability"] += parts.pop("arrival")  # one key states both
        parts["target"] = float(np.trace(self.target_covariance))
        return parts


def _bend_covariance(model: UrModel, q: Floats, bend: Bend) -> Floats:
    sides = bend.sides(model, q)
    return np.asarray(sides @ np.swapaxes(sides, -1, -2))


def _outer(J: Floats, variances: Floats) -> Floats:
    return np.asarray((J * variances) @ np.swapaxes(J, -1, -2))


def pose_error(case: Case, registration: Registration | None) -> PoseError | None:
    """The pose error of a case; None where it declares no errors, or no markers tie its frames."""
    if case.errors is None or registration is None or registration.uncertainty is None:
        return None
    target = apply(registration.T_base_ct, case.target_ct)
    return PoseError(case.robot.model, case.needle.length_mm, target, case.errors, registration.uncertainty)


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """The tip's expected error and the fraction of each source."""

    rms_mm: float
    """Tip to the point that was meant; ``lateral_mm`` across, ``depth_mm`` along the needle."""
    lateral_mm: float
    depth_mm: float
    half_axes_mm: Floats  # shape (3,), of the 95 % ellipsoid, longest first
    fraction: Mapping[str, float]  # source to its part of rms_mm squared; they add up to 1


def expected_error_mm(error: PoseError, q: Floats) -> float:
    """The tip's expected (rms) error about the intended point at one configuration (6,), rad; mm."""
    return float(np.sqrt(np.trace(error.tip_covariance(q[None])[0])))


def error_budget(error: PoseError, q: Floats, outward_base: Floats) -> ErrorBudget:
    """The budget of one configuration (6,), rad, with the tip on the target, along a needle (3,), unit, outward."""
    parts, whole = error.mean_squares(q), error.tip_covariance(q[None])[0]
    variance, along = float(np.trace(whole)), float(outward_base @ whole @ outward_base)
    return ErrorBudget(
        rms_mm=float(np.sqrt(variance)),
        lateral_mm=float(np.sqrt(max(variance - along, 0.0))),  # rounding may leave less than 0
        depth_mm=float(np.sqrt(along)),
        half_axes_mm=error.fit.test.region_factor * np.sqrt(np.linalg.eigvalsh(whole)[::-1]),
        fraction={source: part / variance if variance > 0 else 0.0 for source, part in parts.items()},
    )


class AnyPose(NamedTuple):
    """Bounds of the needle's pose error over all configurations that put its tip on the target.

    Every column of the arm's error Jacobian is bounded by its lever, and a lever's length by the chain between tip and
    joint. For matrices |A + B| <= |A| + |B| and |[A B]|^2 <= |A|^2 + |B|^2 (largest singular values), so that for all q

        sqrt(lmax Sigma_dd) <= deviation_mm,   sqrt(lmax Sigma_phiphi) <= deviation_rad.

    A distance whose gradient is g = (n; s u x n), |n| = |u| = 1, deviates by deviation_mm + s deviation_rad at most.
    A point of the axis at depth s is displaced by no more than |d| + s |phi|, phi across the axis, a surface by e. With
    (d, phi, e) whitened to w of 6 dimensions, Cauchy and Schwarz give for all s at once

        |d| + s |phi| + |e| <= |w| hypot(deviation_mm + s deviation_rad, surface_mm),

    and |w|^2 is chi-squared (6 times Fisher's F where the residuals gave the noise's size). So a distance larger than
    the needle's radius by z times this, z^2 the quantile of 1 - P, is used up with a chance of P at most, whatever the
    surface's shape.
    """

    deviation_mm: float
    deviation_rad: float

    def of_distance(self, depth_mm: Floats, surface_mm: Floats) -> Floats:
        """Bound of the deviation of distances with nearest axis points no deeper than this, (k,), mm."""
        return np.hypot(self.deviation_mm + depth_mm * self.deviation_rad, surface_mm)

    def margin(
        self,
        chance: float,
        freedom: int | None,
        farthest_mm: Floats,
        lengths_mm: Floats,
        radius_mm: float,
        surface_mm: Floats,
    ) -> Floats:
        """Clearance at which no needle touches a structure more often than ``chance``, whatever its shape, (k,), mm.

        Beyond ``farthest`` (k,), the structures' greatest distances from the target, the axis (of lengths (k,)) leaves
        a structure by as much as it goes on, which is more than it is displaced by as soon as it has left it by
        ``beyond``: deeper points never decide. Surfaces lie off by (k,) as a whole at most; ``freedom`` is that of the
        residuals that gave the noise's size, None where it is declared.
        """
        count = 5 + int((surface_mm > 0).any())  # normals: shift, lean across the axis, the surface's
        square = chdtri(count, chance) if freedom is None else count * fdtri(count, freedom, 1.0 - chance)
        z = np.sqrt(square)
        kept, deepest = 1.0 - z * self.deviation_rad, np.asarray(lengths_mm, dtype=np.float64)
        if kept > 0.0:
            straight = self.deviation_mm + surface_mm + farthest_mm * self.deviation_rad
            beyond = (radius_mm + z * straight) / kept
            deepest = np.minimum(farthest_mm + beyond, deepest)
        return np.asarray(z * self.of_distance(deepest, surface_mm))


def any_pose(error: PoseError) -> AnyPose:
    """The bounds of a pose error."""
    noise, arm, scale = error.fit.noise, error.errors.arm, error.fit.test.scale
    model, target, variance = error.model, error.target_base, noise.eta_variances
    # bounds of distances of frame origins 0 to 6 from a tip on the target, shape (7,): the chain from either end
    links = np.hypot(model.a, model.d)  # straight from one frame's origin to the next
    from_tip = error.tip_mm + np.append(np.cumsum(links[::-1])[::-1], 0.0)
    to_base, to_shoulder = np.linalg.norm(target), np.linalg.norm(target - model.shoulder_base)
    from_base = np.concatenate([[to_base], to_shoulder + np.concatenate([[0.0], np.cumsum(links[1:])])])
    levers = np.minimum(from_tip, from_base)  # each is a bound: the triangle inequality
    link, twist, joint, tip, direction = (variance[PARAMETERS[kind]] for kind in PARAMETERS)
    own_mm = np.sqrt(link.sum() + twist @ levers[1:] ** 2 + joint @ levers[:6] ** 2 + tip.max())
    own_rad = np.sqrt(twist.sum() + joint.sum() + direction.max())
    anew = np.hypot(arm.drift, arm.arriving)
    readings = error.fit.cov_at(error.target_base)
    bounds = []
    for rows, own, arrival in (
        (slice(0, 3), own_mm, anew * np.linalg.norm(levers[:6])),
        (slice(3, 6), own_rad, anew * np.sqrt(6.0)),
    ):
        if noise.touches_known:
            at_touches = error.fit.map_at(error.target_base)[rows] @ noise.arm_jacobian
            lasting = own + np.linalg.norm(at_touches * np.sqrt(variance), 2)
        else:
            lasting = np.sqrt(2.0) * own
        largest = np.linalg.eigvalsh(readings[rows, rows])[-1]  # ascending: the last is the largest
        bounds.append(float(np.sqrt(largest + scale**2 * (lasting**2 + arrival**2))))
    return AnyPose(bounds[0], bounds[1])


TILTS_DEG = (0.0, 10.0, 20.0, 30.0, 45.0)
"""By how much a touch may lean from the insertion's orientation."""
AZIMUTHS = 12
"""Sides to which it may lean."""
SWEEPS = 4
"""Over all markers; the choice is settled after two or three."""


class Candidates(NamedTuple):
    """Joints (n, 6), rad, that keep the tip on a point; the nearest to the insertion's first."""

    alike: Floats  # on the insertion's own branch
    others: Floats  # on the other branches: between them the arm passes a singularity


def choose_touches(error: PoseError, points_base: Floats, q_insertion: Floats) -> Floats:
    """Joints that touch each marker (N, 3), mm, shape (N, 6), rad, and leave the least error at the target.

    The markers are in the order of the registration's, the insertion (6,), rad, has the tip on the target. Of the
    case's error the registration's map is kept, and its touches are replaced.

    Raises NoAnswerError: A marker that the arm cannot touch near the insertion's orientation.
    """
    reachable = [touch_candidates(error.model, error.tip_mm, point, q_insertion) for point in points_base]
    candidates = [one.alike if len(one.alike) else one.others for one in reachable]
    for point, q in zip(points_base, candidates, strict=True):
        if not len(q):
            place = ", ".join(f"{value:.1f}" for value in point)
            what = f"a {error.model.name} cannot touch ({place}) mm near the insertion's orientation"
            raise NoAnswerError(what, code="marker_out_of_reach")
    return least_error(error, candidates, q_insertion)


def least_error(error: PoseError, candidates: Sequence[Floats], q_insertion: Floats, *, worst: bool = False) -> Floats:
    """One candidate of each marker, shape (N, 6), rad, that together leave the least error at the target.

    Marker by marker the candidate of the least trace(Sigma_dd) is taken, given the others, until nothing changes; the
    most error (``worst``) is for comparison. Error and insertion as of `choose_touches`; candidates (n, 6), rad, of
    each marker.
    """
    maps = error.fit.map_at(error.target_base)[:3].reshape(3, -1, 3)
    eta, repeatability = error.fit.noise.eta_variances, error.errors.arm.repeatability
    J = [error_jacobian(error.model, q, error.tip_mm)[:, :3] for q in candidates]
    moved = [np.einsum("ab,nbc->nac", maps[:, row], part) for row, part in enumerate(J)]
    anew = [repeatability**2 * np.sum(part[..., PARAMETERS["joint"]] ** 2, axis=(1, 2)) for part in moved]
    chosen = np.zeros(len(candidates), int)  # the first candidates turn least from the insertion
    at_target = error_jacobian(error.model, q_insertion, error.tip_mm)[:3]
    sign = -1.0 if worst else 1.0
    for _ in range(SWEEPS):
        before = chosen.copy()
        for row in range(len(candidates)):
            others = sum(moved[k][chosen[k]] for k in range(len(candidates)) if k != row)
            left = at_target - others - moved[row]
            chosen[row] = np.argmin(sign * (np.sum(left**2 * eta, axis=(1, 2)) + anew[row]))
        if np.array_equal(before, chosen):
            break
    return np.array([q[row] for q, row in zip(candidates, chosen, strict=True)])


def touch_candidates(model: UrModel, tip_mm: float, point_base: Floats, q_insertion: Floats) -> Candidates:
    """Configurations within the joint limits and away from singularities that touch a point, near the insertion's.

    ``tip_mm`` is from flange to tip, the point (3,) in mm, the insertion (6,) in rad: by its orientation, or leaning
    from it by up to `TILTS_DEG`.
    """
    R = flange_pose(model, q_insertion)[:3, :3]
    sides = np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False)
    leans = [tilt * np.array([np.cos(side), np.sin(side), 0.0]) for tilt in np.radians(TILTS_DEG[1:]) for side in sides]
    poses = np.zeros((1 + len(leans), 4, 4))
    poses[:, :3, :3] = R @ exp_rotation(np.array([np.zeros(3), *leans]))
    poses[:, :3, 3], poses[:, 3, 3] = point_base - tip_mm * poses[:, :3, 2], 1.0
    q = nearest_within_limits(model, inverse(model, poses).reshape(-1, 6), q_insertion)
    q = q[~np.isnan(q).any(axis=1)]
    q = q[singularity(model, q).least() >= LEAST_SINGULARITY]
    q = q[np.argsort(np.abs(q - q_insertion).max(axis=1), kind="stable")]
    alike = branch_of(model, q) == branch_of(model, q_insertion[None])[0]
    return Candidates(q[alike], q[~alike])
