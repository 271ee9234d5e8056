"""The chance to touch, to first order: how an error of the needle's pose changes its distance from each structure.

The axis point f + s u is nearest to structure j at distance D; n is the unit vector from the structure to it. Then

    dD = n . (d + s phi x u),   g = (n; s u x n),   sigma^2 = g' Sigma6 g,   P = Phi(-(D - t) / sigma)

(Hasofer, Lind, J. Eng. Mech. Div. 100, 1974). Exact for a flat surface; low between two ribs or over a concave lung,
high at convex ends: where it may decide, `line_sampling` answers (docs/concepts/uncertainty.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtr

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.rotations import skew


@dataclass(frozen=True, eq=False)
class Proximity:
    """How n needles pass k structures; CT frame.

    Attributes:
        distance: Shape (n, k), of the axis from the surface, mm.
        gradient: Shape (n, k, 6), g: what the pose's error (mm, rad) does to it; NaN where they meet.
        deviation: Shape (n, k), sigma, mm.
    """

    distance: Floats
    gradient: Floats
    deviation: Floats


def proximity(
    distance: Floats, depth: Floats, normal: Floats, outward_ct: Floats, cov_ct: Floats, surface_mm: Floats | float
) -> Proximity:
    """The first-order model of every needle and structure.

    Args:
        distance: Shape (n, k), mm.
        depth: Shape (n, k), of the nearest axis point, from the target, mm.
        normal: Shape (n, k, 3), unit, from the structure to that point.
        outward_ct: Shape (n, 3), unit.
        cov_ct: Shape (n, 6, 6), Sigma6, CT axes, its point of reference the target.
        surface_mm: By which each structure's surface may lie off as a whole along that normal: one number or (n, k).
    """
    gradient, deviation = np.empty((*distance.shape, 6)), np.empty(distance.shape)
    near = (np.ascontiguousarray(depth), np.ascontiguousarray(normal), np.array(outward_ct, order="C"))
    surfaces = np.ascontiguousarray(np.broadcast_to(surface_mm, distance.shape), dtype=np.float64)
    _first_order(*near, cov_ct, surfaces, gradient, deviation)
    return Proximity(distance, gradient, deviation)


@nb.njit(cache=True, error_model="numpy")
def _first_order(depth, normal, outward, cov, surface, gradient, deviation):  # type: ignore[no-untyped-def]  # numba infers
    """Fill g = (n; s u x n) and sigma of every pair."""
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

    Args:
        near: Of needles and structures.
        threshold_mm: One number or shape (k,): needle radius, or that and a margin.
        freedom: Degrees of the errors' size where the residuals gave it: Student's t instead of the normal.
    """
    slack = near.distance - threshold_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        quantile = np.where(near.deviation > 0, -slack / near.deviation, np.where(slack > 0, -np.inf, np.inf))
    chance = ndtr(quantile) if freedom is None else stdtr(freedom, quantile)
    return np.asarray(np.where(np.isnan(near.gradient[..., 0]), np.nan, chance))


def touching_any(touch: Floats) -> Floats:
    """At most the chance to touch any of k structures, shape (n,), from the chances (n, k) to touch each."""
    return np.asarray(np.minimum(1.0, touch.sum(axis=1)))


def touch_bound(
    slack_mm: Floats,
    outward_ct: Floats,
    cov_ct: Floats,
    length_mm: float,
    surface_mm: Floats | float,
    freedom: int | None = None,
) -> Floats:
    """What the chance would be if the nearest point were the axis' most doubtful one, to first order, shape (n, k).

    A needle that leans may touch a structure far from where it is nearest, which first order does not see. No point of
    the axis is nearer than the nearest, and none is more doubtful than the worse end: the variance is convex in depth.

    Args:
        slack_mm: Shape (n, k), distance beyond the threshold.
        outward_ct: Shape (n, 3), unit.
        cov_ct: Shape (n, 6, 6), Sigma6, CT axes, its point of reference the target.
        length_mm: Of the axis.
        surface_mm: The most that each structure's surface may lie off by along any normal: one number or (k,).
        freedom: As in `touch_chance`.
    """
    lever = np.concatenate([np.broadcast_to(np.eye(3), (len(cov_ct), 3, 3)), -length_mm * skew(outward_ct)], axis=-1)
    ends = np.stack([cov_ct[:, :3, :3], lever @ cov_ct @ np.swapaxes(lever, -1, -2)])
    variance = np.maximum(np.linalg.eigvalsh(ends)[..., -1].max(axis=0), 0.0)[:, None] + np.square(surface_mm)
    quantile = -slack_mm / np.sqrt(variance + np.finfo(float).tiny)
    return np.asarray(ndtr(quantile) if freedom is None else stdtr(freedom, quantile))
