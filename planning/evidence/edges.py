"""Do surfaces lie where an image changes? Organs end there, so labels that belong to a CT lie on its edges.

For points x_i of all surfaces with normals n_i, and g the gradient of the CT, the edge strength of a placement T is

    A(T) = mean_i | g(T x_i) . n_i(T) |,      n(T) = inv(R)^T n / |inv(R)^T n|,   R the linear part of T.

The true placement is a peak of A where there are enough structures; with few another may look better by chance. So no
ratio decides, but the paired differences d_i = |g . n|(T) - |g . n|(1), summed over patches (a cube of 20 mm of one
structure, whose points see the same edge):

    z(T) = sum_p D_p / sqrt(sum_p D_p^2),     D_p = sum of d_i over patch p.

z is bounded by the square root of the number of patches, so that a small structure alone convicts nothing.
`python -m benchmarks.placements` has how z is distributed for true and for wrong placements.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.mesh import TriangleMesh, spread_on
from puncture_twin.planning.geometry.rigid import apply, exp_rotation

HU_RANGE = (-200.0, 400.0)
"""What lies beyond counts as its end: air against skin or the core of a bone must not outweigh an organ's edge."""
COPY_MM = 2.0
"""The CT is averaged to voxels of at most so much: fine enough for edges, and filtered in no time."""
POINTS, LEAST_POINTS, REFINING_POINTS = 15_000, 200, 4_000
"""On all surfaces together, by area; on each of them, unless they are very many; and where a place is refined."""
PATCH_MM = 20.0

LEAST_SHIFT_MM, LEAST_SHIFT_VOXELS, MOST_SHIFT_MM = 6.0, 1.5, 50.0
"""Shifts that are tried: from the larger of the first two, doubled up to the last."""
SCALES, TURNS = (0.9, 0.95, 1.05, 1.1), np.radians([-24.0, -12.0, -6.0, 6.0, 12.0, 24.0])
"""The second about each axis: what was resampled in another pose lies turned on the CT's own grid."""
LEAST_SEEN = 0.5
"""A placement that leaves less than this in the image, of the points that are in it as they are, says nothing."""
OFFSETS = (-1.0, -0.5, 0.5, 1.0)
"""Voxels by which a segmentation may be drawn thicker or thinner than what it shows."""
LEAST_SUM = 1e-12
"""Below every sum of edge strengths, so that nothing is divided by 0."""


class Placement(NamedTuple):
    """Another place of the surfaces: shift, turn, scale, axes, grid or unit, and the map (4, 4) there, LPS mm."""

    kind: str
    T: Floats  # shape (4, 4), maps the surfaces as they are to where they would lie, LPS mm


class Fit(NamedTuple):
    """How a placement compares with the surfaces as they are.

    z is above 0 where it lies better on the edges; the ratio is A(T) / A(1) on the points that both have in the image.
    """

    placement: Placement
    z: float
    ratio: float


@dataclass(frozen=True, eq=False)
class EdgeImage:
    """A CT (nx, ny, nz) on voxels of at most `COPY_MM`, clipped and smoothed by one voxel."""

    values: NDArray[np.float32]  # shape (nx, ny, nz)
    T_ct_index: Floats  # shape (4, 4), voxel index to LPS mm

    def strength(self, points_ct: Floats, normals_ct: Floats) -> Floats:
        """|g . n| at points (n, 3) with unit normals (n, 3), HU/mm, shape (n,); NaN outside of the image.

        By the central difference over one voxel to each side along the normal.
        """
        strength = np.empty(len(points_ct))
        points, normals = (np.ascontiguousarray(one, np.float64) for one in (points_ct, normals_ct))
        _strength(self.values, np.linalg.inv(self.T_ct_index), points, normals, strength)
        return strength

    def hu_at(self, points_ct: Floats) -> Floats:
        """Its values at points (n, 3), HU, shape (n,); NaN outside of the image."""
        index = apply(np.linalg.inv(self.T_ct_index), points_ct).T
        return np.asarray(scipy.ndimage.map_coordinates(self.values, index, order=1, cval=np.nan))


@nb.njit(cache=True, error_model="numpy")
def _strength(values, T, points, normals, strength):  # type: ignore[no-untyped-def]  # numba infers
    ni, nj, nk = values.shape
    for n in range(len(points)):
        p, d = points[n], normals[n]
        x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        u = T[0, 0] * d[0] + T[0, 1] * d[1] + T[0, 2] * d[2]
        v = T[1, 0] * d[0] + T[1, 1] * d[1] + T[1, 2] * d[2]
        w = T[2, 0] * d[0] + T[2, 1] * d[1] + T[2, 2] * d[2]
        per_mm = np.sqrt(u * u + v * v + w * w)
        u, v, w = u / per_mm, v / per_mm, w / per_mm
        strength[n] = np.nan
        if 1.0 <= x <= ni - 2.0 and 1.0 <= y <= nj - 2.0 and 1.0 <= z <= nk - 2.0:
            change = _between(values, x + u, y + v, z + w) - _between(values, x - u, y - v, z - w)
            strength[n] = abs(change) * per_mm / 2.0


@nb.njit(cache=True, error_model="numpy")
def _between(values, x, y, z):  # type: ignore[no-untyped-def]
    i, j, k = min(int(x), values.shape[0] - 2), min(int(y), values.shape[1] - 2), min(int(z), values.shape[2] - 2)
    x, y, z = x - i, y - j, z - k
    total = 0.0
    for a in range(2):
        for b in range(2):
            line = values[i + a, j + b, k] * (1.0 - z) + values[i + a, j + b, k + 1] * z
            total += line * (x if a else 1.0 - x) * (y if b else 1.0 - y)
    return total


def edge_image(hu: NDArray[np.generic], T_ct_index: Floats) -> EdgeImage:
    """The CT (nx, ny, nz), HU of any type that holds `HU_RANGE`, as the edge test sees it; T (4, 4) to LPS mm."""
    spacing = np.linalg.norm(T_ct_index[:3, :3], axis=0)
    factor = np.maximum(1, np.floor(COPY_MM / spacing + 1e-6)).astype(int)
    count = np.array(hu.shape) // factor
    values = np.zeros(count, np.float32)
    for first in itertools.product(*(range(n) for n in factor)):
        part = tuple(slice(f, f + n * s, s) for f, n, s in zip(first, count, factor, strict=True))
        values += np.clip(hu[part], *np.array(HU_RANGE, hu.dtype))
    values /= np.float32(factor.prod())
    T_index_copy = np.diag([*factor.astype(float), 1.0])
    T_index_copy[:3, 3] = (factor - 1) / 2
    return EdgeImage(scipy.ndimage.gaussian_filter(values, 1.0, mode="nearest"), T_ct_index @ T_index_copy)


@dataclass(frozen=True, eq=False)
class Sample:
    """Points (n, 3) on several surfaces, unit normals of any sign, and by point the surface and the patch of it."""

    points_ct: Floats  # shape (n, 3), LPS mm
    normals_ct: Floats  # shape (n, 3), unit; their sign does not matter
    structure: NDArray[np.intp]  # shape (n,), which surface each lies on
    patch: NDArray[np.intp]

    @property
    def middle_ct(self) -> Floats:
        """Shape (3,), LPS mm."""
        return np.asarray(self.points_ct.mean(axis=0))

    def thinned(self, count: int) -> Sample:
        """About so many of its points."""
        return self.rows(slice(None, None, max(1, len(self.points_ct) // count)))

    def rows(self, rows: NDArray[np.intp] | slice) -> Sample:
        """Some of its points."""
        return Sample(self.points_ct[rows], self.normals_ct[rows], self.structure[rows], self.patch[rows])

    def moved(self, T: Floats) -> Sample:
        """The sample moved by a map (4, 4)."""
        return Sample(*self.placed(T), self.structure, self.patch)

    def placed(self, T: Floats) -> tuple[Floats, Floats]:
        """Its points and normals by a placement (4, 4)."""
        normals = self.normals_ct @ np.linalg.inv(T[:3, :3])
        return apply(T, self.points_ct), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def sample_surfaces(meshes: Sequence[TriangleMesh], count: int = POINTS) -> Sample:
    """Points spread evenly over surfaces, at least `LEAST_POINTS` on each, the same in every run."""
    areas = np.array([mesh.areas.sum() for mesh in meshes])
    least = min(LEAST_POINTS, count // len(meshes))
    counts = np.maximum(np.round(count * areas / areas.sum()), least).astype(int)
    spread = [spread_on(mesh, number) for mesh, number in zip(meshes, counts, strict=True)]
    where, normals = (np.concatenate(some) for some in zip(*spread, strict=True))
    structure = np.repeat(np.arange(len(meshes)), counts)
    cube = np.floor((where - where.min(axis=0)) / PATCH_MM).astype(np.intp)
    patch = np.unique(np.column_stack([structure, cube]), axis=0, return_inverse=True)[1].ravel()
    return Sample(where, normals, structure, patch)


def shifts(axes: Floats, voxel_mm: Floats, most_mm: Floats | float = MOST_SHIFT_MM) -> Iterator[Placement]:
    """Shifts along each axis (unit columns (3, 3)), doubling from the least shift that counts.

    Voxels (3,) are the coarser ones of image and labels along these axes, the largest shift is one of all axes or of
    each (3,); the least is tried whatever it is.
    """
    largest = np.broadcast_to(np.minimum(most_mm, MOST_SHIFT_MM), 3)
    for axis, least, most in zip(axes.T, least_shift_mm(voxel_mm), largest, strict=True):
        step = least
        while step <= max(least, most):
            for along in (step, -step):
                T = np.eye(4)
                T[:3, 3] = along * axis
                yield Placement("shift", T)
            step *= 2.0


def least_shift_mm(voxel_mm: Floats) -> Floats:
    """The least shift that counts, of voxels of some size; any shape."""
    return np.maximum(LEAST_SHIFT_MM, LEAST_SHIFT_VOXELS * voxel_mm)


def scalings(about: Sequence[Floats], factors: Sequence[float] = SCALES, kind: str = "scale") -> Iterator[Placement]:
    """Scalings, larger and smaller, about points (3,)."""
    for point, factor in itertools.product(about, factors):
        yield Placement(kind, _about(point, np.eye(3) * factor))


def turns(about: Floats, axes: Floats) -> Iterator[Placement]:
    """Rotations about each axis (unit columns (3, 3)) through a point (3,)."""
    for axis, angle in itertools.product(axes.T, TURNS):
        yield Placement("turn", _about(about, exp_rotation(axis * angle)))


def axis_slips(about: Sequence[Floats], axes: Floats) -> Iterator[Placement]:
    """Every other order and sense of three axes (unit columns (3, 3)) about points (3,).

    Of the patient or a grid: mirror images, half and quarter turns, arrays reversed.
    """
    orders, signs_of = itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)
    for point, order, signs in itertools.product(about, orders, signs_of):
        slip = np.eye(3)[:, list(order)] * np.array(signs)
        if not np.array_equal(slip, np.eye(3)):
            yield Placement("axes", _about(point, axes @ slip @ axes.T))


def axes_text(order: Sequence[int], signs: Sequence[float]) -> str:
    """Exchanged and negated axes in words; empty where neither is."""
    negated = [name for name, sign in zip("xyz", signs, strict=True) if sign < 0]
    if tuple(order) != (0, 1, 2):
        return "with its axes swapped"
    if len(negated) == 2:
        return f"rotated by 180 degrees ({' and '.join(negated)} negated)"
    return f"mirrored in {', '.join(negated)}" if negated else ""


def _about(point: Floats, linear: Floats) -> Floats:
    """The affine map (4, 4) with a linear part (3, 3) that leaves a point (3,) in place."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = linear, point - linear @ point
    return T


class Compared(NamedTuple):
    """All placements that were tried, with z and A(T) / A(1) of each structure by itself: (placements, structures).

    z is -inf where a structure is not seen.
    """

    fits: tuple[Fit, ...]
    own_z: Floats
    own_ratio: Floats

    @property
    def best(self) -> Fit:
        """The placement that lies better with the most certainty."""
        return max(self.fits, key=lambda fit: fit.z)


def compare(image: EdgeImage, sample: Sample, placements: Sequence[Placement]) -> Compared:
    """Compare placements with the surfaces as they are."""
    as_is = image.strength(sample.points_ct, sample.normals_ct)
    owner = np.zeros(int(sample.patch.max()) + 1, np.intp)
    owner[sample.patch] = sample.structure
    fits, own_z, own_ratio = [], [], []
    for placement in placements:
        elsewhere = image.strength(*sample.placed(placement.T))
        fits.append(fit_of(placement, sample, as_is, elsewhere))
        before, after = _seen(as_is, elsewhere)
        gain = _sums(after - before, sample.patch)
        own_z.append(_z(_sums(gain, owner), _sums(gain**2, owner)))
        own_ratio.append(_sums(after, sample.structure) / np.maximum(_sums(before, sample.structure), LEAST_SUM))
    return Compared(tuple(fits), np.array(own_z), np.array(own_ratio))


def fit_of(placement: Placement, sample: Sample, as_is: Floats, elsewhere: Floats) -> Fit:
    """Z and ratio of edge strengths (n,) at a placement, and as it is; NaN outside of the image."""
    before, after = _seen(as_is, elsewhere)
    gain = _sums(after - before, sample.patch)
    seen = np.count_nonzero(np.isfinite(as_is) & np.isfinite(elsewhere))
    enough = seen >= LEAST_SEEN * max(1, int(np.count_nonzero(np.isfinite(as_is))))
    z = float(_z(gain.sum(), gain @ gain)) if enough else -np.inf
    return Fit(placement, z, float(after.sum() / max(before.sum(), LEAST_SUM)))


def _seen(as_is: Floats, elsewhere: Floats) -> tuple[Floats, Floats]:
    both = np.isfinite(as_is) & np.isfinite(elsewhere)
    return np.where(both, as_is, 0.0), np.where(both, elsewhere, 0.0)


def settled(image: EdgeImage, sample: Sample) -> Floats:
    """The strength (n,) where each structure is drawn thicker or thinner by up to a voxel, whichever lies best.

    Segmentations lie to one side of the edge, by partial volume, smoothing or habit; that is no other place.
    """
    best = image.strength(sample.points_ct, sample.normals_ct)
    count = int(sample.structure.max()) + 1
    per_mm = np.linalg.norm(sample.normals_ct @ np.linalg.inv(image.T_ct_index)[:3, :3].T, axis=1, keepdims=True)
    for voxels in OFFSETS:
        offset = image.strength(sample.points_ct + sample.normals_ct * voxels / per_mm, sample.normals_ct)
        before, after = _seen(best, offset)
        better = np.bincount(sample.structure, after - before, count) > 0.0
        best = np.where(better[sample.structure], offset, best)
    return best


def _sums(values: Floats, group: NDArray[np.intp]) -> Floats:
    """The sum of the values of each group, in the order of their numbers."""
    return np.asarray(np.bincount(group, values), dtype=np.float64)


def _z(total: Any, square: Any) -> Floats:
    return np.where(square > 0.0, total / np.sqrt(np.maximum(square, LEAST_SUM)), -np.inf)


def refined(image: EdgeImage, sample: Sample, start: Placement, most_mm: float = np.inf) -> Placement:
    """The placement near another one at which the surfaces lie best: shifted, turned and scaled further.

    Nelder-Mead over shift (mm), turn and scale, about the middle of the surfaces, of which no point moves farther than
    ``most_mm``, to first order.
    """
    some = sample.thinned(REFINING_POINTS)
    middle = apply(start.T, sample.middle_ct[None])[0]
    inside = np.count_nonzero(np.isfinite(image.strength(*some.placed(start.T))))
    radius_mm = float(np.linalg.norm(some.points_ct - sample.middle_ct, axis=1).max())
    step_mm = min(3.0, most_mm / 2.0)

    def moved(x: Floats) -> Floats:
        T = _about(middle, exp_rotation(x[3:6] / radius_mm) * np.exp(x[6] / radius_mm))
        T[:3, 3] += x[:3]
        return np.asarray(T @ start.T)

    def loss(x: Floats) -> float:
        if np.linalg.norm(x[:3]) + np.linalg.norm(x[3:6]) + abs(x[6]) > most_mm:
            return 0.0
        strength = image.strength(*some.placed(moved(x)))
        seen = np.isfinite(strength)
        return -float(strength[seen].mean()) if np.count_nonzero(seen) > 0.8 * inside else 0.0

    simplex = np.vstack([np.zeros(7), np.eye(7) * step_mm])
    options = {"initial_simplex": simplex, "maxfev": 400, "xatol": 0.1, "fatol": 1e-4}
    minimum = scipy.optimize.minimize(loss, np.zeros(7), method="Nelder-Mead", options=options)
    return start._replace(T=moved(np.asarray(minimum.x)))
