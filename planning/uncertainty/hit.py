"""Chance to hit, and chance to touch to first order, from the covariance of the needle's pose.

**To hit**: a normal error of known covariance leaves the tip within a radius, or within a mesh. In a mesh by
directional simulation (Bjerager, J. Eng. Mech. 114, 1988): along each of many fixed directions u_i the
surface is crossed at distances rho_ij, and with m_i^2 = u_i' Sigma^-1 u_i

    P = sum_i m_i^-3 sum_j s_ij F3(rho_ij m_i) / sum_i m_i^-3,   F3 the distribution of the length of three normals

where s_ij is +1 for the last crossing and alternates inwards, which is right for a target outside or on the surface
too. A surface that lies off as a whole by z standard deviations s moves a crossing by z s / (n . u), n its face's
normal; F3 is odd, so that this is right where it moves past the target, and P is the mean over z. Where the residuals
gave the errors' size, that size is uncertain too: F3 becomes Fisher's F(3, nu), and within a radius every term of the
series a beta distribution.

**To touch** (`proximity`): the axis point f + s u is nearest to structure j at distance D, n the unit vector from it.

    dD = n . (d + s phi x u),   g = (n; s u x n),   sigma^2 = g' Sigma6 g,   P = Phi(-(D - t) / sigma)

(Hasofer, Lind, J. Eng. Mech. Div. 100, 1974). Exact for a flat surface; low between two ribs or over a concave lung,
high at convex ends: where it may decide, line sampling is used (docs/concepts/uncertainty.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import erf, fdtr, ndtr, ndtri, stdtr

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.containment import crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import even_directions, skew
from puncture_twin.planning.uncertainty.pose_error import PoseError


@dataclass(frozen=True, eq=False)
class HitModel:
    """Criterion of a hit: the tip within a radius of the target, or within its mesh."""

    radius_mm: float | None  # where a case gives one
    rays: TargetRays | None
    """The target's mesh, else; or the ball about a target that tips are off on average."""

    def chance(self, error: PoseError, cov_ct: Floats, surface_mm: float = 0.0) -> Floats:
        """The chance of needles with these Sigma6, shape (n, 6, 6), CT axes, in a mesh that may lie off: shape (n,)."""
        cov = cov_ct[:, :3, :3] if self.radius_mm is None else cov_ct[:, :3, :3] + error.target_covariance_ct
        if self.rays is None:
            assert self.radius_mm is not None
            return hit_in_ball(cov, self.radius_mm, error.freedom)
        return hit_in_mesh(self.rays, np.ascontiguousarray(cov), error.freedom, surface_mm)


def hit_model(
    radius_mm: float | None, mesh: TriangleMesh, target_ct: Floats, mean_ct: Floats | None = None
) -> HitModel:
    """Model of hitting the target: by its radius where one is stated, else by the mesh of its structure.

    ``mean_ct``, shape (3,), mm, is by how much tips are off the target on average; None where they are not.
    """
    if radius_mm is None:
        return HitModel(None, target_rays(mesh, target_ct if mean_ct is None else target_ct + mean_ct))
    return HitModel(radius_mm, None if mean_ct is None else rays_to_ball(mean_ct, radius_mm))


def hit_in_ball(cov: Floats, radius_mm: float, freedom: int | None = None) -> Floats:
    """The chance (n,) that the tip is within a radius of the intended point.

    By covariances (n, 3, 3), mm², of tip against that point, any frame; ``freedom``: the degrees of the errors' size,
    where the residuals gave it.
    """
    values = np.asarray(np.linalg.eigvalsh(cov) + LEAST_VARIANCE, dtype=np.float64)
    return chance_within(values, np.full((len(cov), 1), radius_mm), freedom)[:, 0]


def radius_for_chance(cov: Floats, chance: float, freedom: int | None = None) -> float:
    """Radius within which the tip ends with a chance below 1, mm: the inverse of `hit_in_ball`, ``cov`` (3, 3)."""
    from scipy.optimize import brentq  # here: it loads 260 modules, and few commands need it

    size = float(np.sqrt(np.trace(cov)))
    if size == 0.0:
        return 0.0
    high = size
    while hit_in_ball(cov[None], high, freedom)[0] < chance:
        high *= 2.0

    def missing(radius: float) -> float:
        return float(hit_in_ball(cov[None], radius, freedom)[0]) - chance

    return float(brentq(missing, 0.0, high, xtol=1e-4 * size))


def chance_within(eigenvalues: Floats, radii: Floats, freedom: int | None = None) -> Floats:
    """The chance that an error stays within radii (n, m), mm, by Ruben's series (Ann. Math. Stat. 33, 1962).

    Of eigenvalues (n, 3), mm², above 0. With beta the least and gamma_i = 1 - beta / lambda_i, P = sum_k c_k F_{3+2k}(x
    / beta), F the chi-squared distribution; one gamma is 0, and (k+1) c_{k+1} = e1 (k + 1/2) c_k - e2 k c_{k-1} with e1
    and e2 the sum and product of the other two. The mean over nu / chi-squared, the square of an error's uncertain
    size, goes term by term: F_{3+2k}(x) becomes the beta distribution I_y(3/2 + k, nu / 2), y = x / (x + nu).
    """
    chances = np.empty(radii.shape)
    _ruben(np.sort(eigenvalues, axis=1), np.ascontiguousarray(radii, dtype=np.float64) ** 2, freedom or 0, chances)
    return chances


@nb.njit(cache=True, error_model="numpy")
def student_within(t, freedom):  # type: ignore[no-untyped-def]
    """The chance that Student's t of whole degrees lies within ±t (Abramowitz, Stegun, 26.7.3 and 26.7.4)."""
    square = 1.0 / (1.0 + t * t / freedom)  # of the cosine of atan(t / sqrt(nu))
    odd = freedom % 2
    total, term = 0.0, t / math.sqrt(freedom) * (square if odd else math.sqrt(square))
    for k in range(2 + odd, freedom + 1, 2):
        total += term
        term *= square * (k - 1.0) / k
    return (math.atan(t / math.sqrt(freedom)) + total) * 2.0 / math.pi if odd else total


SERIES_END = 1e-8
"""The series stops where what is left of its weights, which add up to 1, is smaller."""
MOST_TERMS = 20_000
"""Enough for standard deviations of a ratio of 30; what is left then is not counted, so that P is never too large."""


@nb.njit(cache=True)
def _ruben(values, squares, freedom, chances):  # type: ignore[no-untyped-def]  # numba infers
    for row in range(len(values)):
        beta, mid, high = values[row]
        g1, g2 = 1.0 - beta / mid, 1.0 - beta / high
        start = math.sqrt(beta / mid * beta / high)
        for column in range(squares.shape[1]):
            chances[row, column] = _series(start, g1 + g2, g1 * g2, squares[row, column] / beta, freedom)


@nb.njit(cache=True)
def _series(weight, e1, e2, x, freedom):  # type: ignore[no-untyped-def]
    """Sum c_k F_{3+2k}(x), with F_{nu+2}(x) = F_nu(x) - (x/2)^(nu/2) exp(-x/2) / Gamma(nu/2 + 1).

    Or I_y(a + 1, b) = I_y(a, b) - y^a (1 - y)^b / (a B(a, b)) with b half of ``freedom``, which is 0 of known sizes.
    """
    half = 0.5 * x
    if half <= 0.0:
        return 0.0
    before, left, total, b = 0.0, 1.0, 0.0, 0.5 * freedom
    if freedom == 0:
        F = math.erf(math.sqrt(half)) - math.sqrt(4.0 * half / math.pi) * math.exp(-half)
        log_step, log_ratio = 1.5 * math.log(half) - half - math.lgamma(2.5), math.log(half)
    else:
        log_ratio, log_last = -math.log1p(b / half), math.lgamma(0.5 + b) - math.lgamma(b) - b * math.log1p(half / b)
        F = student_within(math.sqrt(x), freedom) - math.exp(0.5 * log_ratio + log_last - math.lgamma(1.5))
        log_step = 1.5 * log_ratio + log_last + math.log(0.5 + b) - math.lgamma(2.5)
    for k in range(MOST_TERMS):
        total += weight * F
        left -= weight
        if left < SERIES_END or F <= 0.0:
            break
        F = max(F - math.exp(log_step), 0.0)
        log_step += log_ratio - math.log(k + 2.5)
        if freedom > 0:
            log_step += math.log(k + 1.5 + b)
        weight, before = (e1 * (k + 0.5) * weight - e2 * k * before) / (k + 1.0), weight
    return min(max(total, 0.0), 1.0)


@dataclass(frozen=True, eq=False)
class TargetRays:
    """Crossings of rays from the target with its mesh, or with a ball."""

    directions: Floats  # shape (n, 3), unit vectors, CT frame
    ray: Ints  # shape (c,), row of each crossing's direction
    depth: Floats  # shape (c,), mm from the target
    sign: Floats  # shape (c,), +1 for a direction's last crossing, alternating inwards
    moved: Floats | None = None
    """Shape (c,), by which a crossing's depth grows where the surface lies farther out by 1; None for a ball."""


DIRECTIONS = 512
"""Directions for a mesh, spread evenly: against a million draws P errs by .001, for axis ratios of 10 by .004."""


def target_rays(mesh: TriangleMesh, target_ct: Floats) -> TargetRays:
    """Crossings of `DIRECTIONS` rays from the target with its closed mesh."""
    directions = even_directions(DIRECTIONS)
    crossing = crossings(mesh, target_ct, directions)
    from_last = (crossing.first + crossing.count - 1)[crossing.ray] - np.arange(len(crossing.ray))  # 0 for a ray's last
    sign = np.where(from_last % 2 == 0, 1.0, -1.0)
    area = _areas(mesh)[crossing.face]
    facing = np.abs(np.einsum("ca,ca->c", area, directions[crossing.ray])) / (
        np.linalg.norm(area, axis=1) + LEAST_VARIANCE
    )
    return TargetRays(directions, crossing.ray, crossing.depth, sign, sign / np.maximum(facing, GRAZING))


def rays_to_ball(offset: Floats, radius_mm: float) -> TargetRays:
    """Crossings with a ball about the target of rays from a tip with a known mean error.

    The offset (3,), mm, is the believed tip minus the target, in the covariance's axes.
    """
    directions = even_directions(DIRECTIONS)
    along = directions @ offset
    inside = along**2 - offset @ offset + radius_mm**2  # below 0 the ray misses the ball
    half = np.sqrt(np.maximum(inside, 0.0))
    depth, sign = np.concatenate([half - along, -half - along]), np.repeat([1.0, -1.0], DIRECTIONS)
    ahead = (np.tile(inside, 2) > 0) & (depth > 0)  # behind the tip there is no ray
    ray = np.tile(np.arange(DIRECTIONS), 2)
    return TargetRays(directions, ray[ahead], depth[ahead], sign[ahead])


def hit_in_mesh(rays: TargetRays, cov_ct: Floats, freedom: int | None = None, surface_mm: float = 0.0) -> Floats:
    """The chance (n,) that the tip is within a mesh, which may lie off by ``surface_mm`` as a whole.

    By covariances (n, 3, 3), mm², of tip against mesh, CT axes; ``freedom`` as of `hit_in_ball`.
    """
    if surface_mm > 0 and rays.moved is not None:
        z = ndtri((np.arange(SURFACES) + 0.5) / SURFACES)
        lying = [replace(rays, depth=rays.depth + off * rays.moved) for off in surface_mm * z]
        return np.asarray(np.mean([hit_in_mesh(one, cov_ct, freedom) for one in lying], axis=0))
    inverse = np.asarray(np.linalg.inv(cov_ct + LEAST_VARIANCE * np.eye(3)), dtype=np.float64)
    if freedom is None:
        found = np.empty(len(inverse))
        x, y, z = np.ascontiguousarray(rays.directions.T)
        _directional(x, y, z, rays.ray, rays.depth, rays.sign, _length_table(), inverse, found)
        return found
    chances = [np.empty(0)]
    for start in range(0, len(inverse), ROWS_AT_ONCE):
        part = inverse[start : start + ROWS_AT_ONCE]
        squares = np.einsum("ia,nab,ib->ni", rays.directions, part, rays.directions)  # m_i^2
        weights = squares**-1.5
        within = fdtr(3, freedom, rays.depth**2 * squares[:, rays.ray] / 3) * rays.sign * np.sign(rays.depth)
        chances.append(np.clip((within * weights[:, rays.ray]).sum(axis=1) / weights.sum(axis=1), 0.0, 1.0))
    return np.concatenate(chances)


SURFACES = 32
"""Positions of a surface that lies off, at the middles of equal chances: however sharply it decides, P errs by half of
one."""
GRAZING = 0.2
"""Least cosine between ray and normal: a crossing that a surface moves farther than this says is not moved by it."""
ROWS_AT_ONCE = 512
"""Covariances at once: a table of rows times crossings stays below some MB."""
LEAST_VARIANCE = 1e-12
"""mm^2, added to every axis, and to areas: what cannot happen must not divide by zero."""


def mean_over_faces(mesh: TriangleMesh, cov: Floats) -> float:
    """Standard deviation along the normals, as the root of the mean of n' S n over a surface, S (3, 3)."""
    area = _areas(mesh)
    size = np.linalg.norm(area, axis=1)
    return float(np.sqrt(np.einsum("ma,ab,mb->", area / (size[:, None] + LEAST_VARIANCE), cov, area) / size.sum()))


def _areas(mesh: TriangleMesh) -> Floats:
    """Normals of the faces as long as twice their areas, shape (m, 3)."""
    a, b, c = np.moveaxis(mesh.triangles.reshape(-1, 3, 3), 1, 0)
    return np.asarray(np.cross(b - a, c - a))


@nb.njit(cache=True, error_model="numpy")
def _directional(x, y, z, ray, depth, sign, table, inverse, chances):  # type: ignore[no-untyped-def]  # numba infers
    """The sum of the module's first equation, row by row."""
    weights, lengths, last = np.empty(len(x)), np.empty(len(x)), len(table) - 1.0
    for row in range(len(inverse)):
        S = inverse[row]
        xx, yy, zz, xy, xz, yz = S[0, 0], S[1, 1], S[2, 2], 2.0 * S[0, 1], 2.0 * S[0, 2], 2.0 * S[1, 2]
        for i in range(len(x)):
            square = x[i] * (xx * x[i] + xy * y[i] + xz * z[i]) + y[i] * (yy * y[i] + yz * z[i]) + zz * z[i] * z[i]
            lengths[i] = math.sqrt(square)
            weights[i] = 1.0 / (square * lengths[i])
        within = 0.0
        for c in range(len(ray)):
            t = min(abs(depth[c]) * lengths[ray[c]] * TABLE_STEPS, last - 1e-6)
            k, odd = int(t), math.copysign(sign[c], sign[c] * depth[c])
            within += odd * weights[ray[c]] * (table[k] + (t - k) * (table[k + 1] - table[k]))
        chances[row] = min(max(within / weights.sum(), 0.0), 1.0)


TABLE_STEPS = 256
"""Steps of the table of F3 per standard deviation: straight lines between err by 2e-6."""


@cache
def _length_table() -> Floats:
    """F3 at steps of 1 / `TABLE_STEPS`, up to where it is 1."""
    t = np.arange(9 * TABLE_STEPS + 1) / TABLE_STEPS
    return np.asarray(erf(t * math.sqrt(0.5)) - math.sqrt(2.0 / math.pi) * t * np.exp(-0.5 * t * t))


@dataclass(frozen=True, eq=False)
class Proximity:
    """Distances, gradients and deviations of n needles and k structures; CT frame."""

    distance: Floats  # shape (n, k), of the axis from the surface, mm
    gradient: Floats
    """Shape (n, k, 6), g: what the pose's error (mm, rad) does to it; NaN where they intersect."""
    deviation: Floats  # shape (n, k), sigma, mm


def proximity(
    distance: Floats, depth: Floats, normal: Floats, outward_ct: Floats, cov_ct: Floats, surface_mm: Floats | float
) -> Proximity:
    """The first-order model of n needles along unit vectors (n, 3) and k structures, by distances (n, k), mm.

    ``depth`` (n, k) is that of the nearest axis point, mm from the target, and ``normal`` (n, k, 3), unit, points from
    the structure to it; Sigma6 (n, 6, 6), CT axes, is about the target; along the normal each surface may lie off as a
    whole, by one number or (n, k).
    """
    gradient, deviation = np.empty((*distance.shape, 6)), np.empty(distance.shape)
    near = (np.ascontiguousarray(depth), np.ascontiguousarray(normal), np.array(outward_ct, order="C"))
    surfaces = np.ascontiguousarray(np.broadcast_to(surface_mm, distance.shape), dtype=np.float64)
    _first_order(*near, cov_ct, surfaces, gradient, deviation)
    return Proximity(distance, gradient, deviation)


@nb.njit(cache=True, error_model="numpy")
def _first_order(depth, normal, outward, cov, surface, gradient, deviation):  # type: ignore[no-untyped-def]  # numba infers
    """Fill the gradients g = (n; s u x n) and deviations sigma of every pair."""
    for i in range(len(outward)):
        ux, uy, uz = outward[i]
        for j in range(depth.shape[1]):
            g, s = gradient[i, j], depth[i, j]
            nx, ny, nz = normal[i, j]
            g[0], g[1], g[2] = nx, ny, nz
            g[3], g[4], g[5] = s * (uy * nz - uz * ny), s * (uz * nx - ux * nz), s * (ux * ny - uy * nx)
            variance = surface[i, j] * surface[i, j]
            for a in range(6):
                for b in range(6):
                    variance += g[a] * cov[i, a, b] * g[b]
            deviation[i, j] = math.sqrt(max(variance, 0.0)) if variance == variance else math.nan


def touch_chance(near: Proximity, threshold_mm: Floats | float, freedom: int | None = None) -> Floats:
    """P that each needle comes nearer to each structure than a threshold, shape (n, k); NaN where they intersect.

    The threshold is the needle's radius, or that and a margin: one number or (k,). By Student's t of ``freedom``
    degrees where the residuals gave the errors' size, else by the normal.
    """
    slack = near.distance - threshold_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        quantile = np.where(near.deviation > 0, -slack / near.deviation, np.where(slack > 0, -np.inf, np.inf))
    chance = ndtr(quantile) if freedom is None else stdtr(freedom, quantile)
    return np.asarray(np.where(np.isnan(near.gradient[..., 0]), np.nan, chance))


def touching_any(touch: Floats) -> Floats:
    """Upper bound of the chance to touch any of k structures, shape (n,), from the chances (n, k) to touch each."""
    return np.asarray(np.minimum(1.0, touch.sum(axis=1)))


def touch_bound(
    slack_mm: Floats,
    outward_ct: Floats,
    cov_ct: Floats,
    length_mm: float,
    surface_mm: Floats | float,
    freedom: int | None = None,
) -> Floats:
    """Bound of the first-order chance if the nearest point were the axis' least certain one, shape (n, k).

    A needle that leans may touch a structure far from where it is nearest, which first order does not see. No point of
    the axis is nearer than the nearest, and none is more doubtful than the worse end: the variance is convex in depth.
    ``slack_mm`` (n, k) is the distance beyond the threshold, ``surface_mm`` the most that a surface may lie off along
    any normal, one number or (k,), ``length_mm`` the axis' length; the others as of `proximity` and `touch_chance`.
    """
    lever = np.concatenate([np.broadcast_to(np.eye(3), (len(cov_ct), 3, 3)), -length_mm * skew(outward_ct)], axis=-1)
    ends = np.stack([cov_ct[:, :3, :3], lever @ cov_ct @ np.swapaxes(lever, -1, -2)])
    variance = np.maximum(np.linalg.eigvalsh(ends)[..., -1].max(axis=0), 0.0)[:, None] + np.square(surface_mm)
    quantile = -slack_mm / np.sqrt(variance + np.finfo(float).tiny)
    return np.asarray(ndtr(quantile) if freedom is None else stdtr(freedom, quantile))
