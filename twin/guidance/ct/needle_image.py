"""The image that a thin rod along a curve makes in a CT: blurred in the plane, averaged over slices, clipped.

A rod of radius r along a curve c(s), s <= 0 behind its tip, in axes whose first is nearly the rod's:

    c(s) = tip + (s, g s + b u^2 + d u^3),    u = s / `LEVER_MM`

At a point s along the curve and y (2,) across it, with the blur's covariance in blocks C_ss, C_ys and C_yy:

    image = gain pi r^2 N(y; C_yy) Phi((k.y - s) / l),    k = C_yy^-1 C_ys,    l^2 = C_ss - k.C_ys

the integral of the Gaussian along the axis, from infinity to the tip. A slice is the mean of thin layers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.metal import full_part, spacing_mm
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.formats.volumes.volume_files import Volume

BLUR_SIGMA_MM = 0.5
"""Assumed of reconstruction and pixel together, in the plane, before it is fitted."""
LAYER_MM = 0.6
"""A slice is taken apart into layers no thicker: their Gaussians add up to its even profile, a needle's width given."""
LEVER_MM = 50.0
"""At which a bend is counted."""
NUMBERS = 11
"""Of a curve: shift of the tip (3), mm; slopes (2); logarithms of blur and gain (2); bends (2 + 2), mm at the lever."""
FAR = 20.0
"""Exponents beyond leave nothing of a Gaussian."""


class CurveImage(NamedTuple):
    """The image of a curve's `NUMBERS`, at points in its axes.

    Attributes:
        axes: Shape (3, 3), rows: nearly the needle's direction, and the two across it.
        plane: Shape (3, 3), mm², in these axes: the assumed blur in the image's plane, which is fitted, and
        fixed: the same, of one layer of a slice and of the needle's own width.
        layers: Shape (m, 3), mm, in these axes: where a slice's layers lie.
        full: Part of metal from which a voxel is clipped.
    """

    axes: Floats
    plane: Floats
    fixed: Floats
    layers: Floats
    diameter_mm: float
    full: float

    @classmethod
    def of(cls, volume: Volume, axes: Floats, diameter_mm: float) -> CurveImage:
        """Of a volume's slices and pixels."""
        spacing = spacing_mm(volume)
        directions = axes @ (volume.T_ct_index[:3, :3] / spacing)
        in_plane, normal = directions[:, :2], directions[:, 2:]
        count = math.ceil(spacing[2] / LAYER_MM)
        steps = ((np.arange(count) + 0.5) / count - 0.5) * spacing[2]
        width = diameter_mm**2 / 16 * np.diag([0.0, 1.0, 1.0])  # a disc's variance along each axis
        fixed = (spacing[2] / count) ** 2 / 12 * (normal @ normal.T) + width
        plane, layers = BLUR_SIGMA_MM**2 * (in_plane @ in_plane.T), steps[:, None] * normal.T
        return cls(axes, plane, fixed, layers, diameter_mm, full_part(volume))

    def off(self, x: Floats, s: Floats) -> Floats:
        """Distance of the curve from its axis behind the tip, across it, shape (n, 2)."""
        u = np.minimum(s, 0.0) / LEVER_MM
        return np.stack([s * x[3 + k] + u * u * (x[7 + k] + u * x[9 + k]) for k in (0, 1)], axis=1)

    def parts(self, x: Floats, local: Floats) -> Floats:
        """Part of metal at points (n, 3), mm, in its axes."""
        image = np.empty(len(local))
        _render(local, self.layers, x, self._shape(x), self.full, image, np.empty((0, NUMBERS)))
        return image

    def slopes(self, x: Floats, local: Floats) -> Floats:
        """Derivatives of the parts by the numbers, shape (n, 11)."""
        image, slopes = np.empty(len(local)), np.empty((len(local), NUMBERS))
        _render(local, self.layers, x, self._shape(x), self.full, image, slopes)
        return slopes

    def _shape(self, x: Floats) -> Floats:
        """What a blur makes of a rod: Q = C_yy^-1 (3), k (2), l and the factor; derivatives by the blur's logarithm."""
        plane = np.exp(2 * x[5]) * self.plane
        C, D = plane + self.fixed, 2 * plane
        Q = np.linalg.inv(C[1:, 1:])
        k = Q @ C[1:, 0]
        long = np.sqrt(C[0, 0] - k @ C[1:, 0])
        factor = np.exp(x[6]) * self.diameter_mm**2 / 8 * np.sqrt(np.linalg.det(Q)) / len(self.layers)
        by_k = Q @ (D[1:, 0] - D[1:, 1:] @ k)
        by_long = (D[0, 0] - 2 * k @ D[1:, 0] + k @ D[1:, 1:] @ k) / (2 * long)
        by_factor = -0.5 * np.trace(Q @ D[1:, 1:])
        row = [Q[0, 0], Q[0, 1], Q[1, 1], *k, long, factor, D[1, 1], D[1, 2], D[2, 2], *by_k, by_long, by_factor]
        return np.array(row)


@nb.njit(cache=True, error_model="numpy")
def _render(points, layers, x, shape, full, image, slopes):  # type: ignore[no-untyped-def]  # numba infers
    """Fill the image (n,), and its slopes (n, 11) where there is room for them."""
    Q00, Q01, Q11, k0, k1, long, factor, D00, D01, D11, by_k0, by_k1, by_long, by_factor = shape
    sloped = len(slopes) > 0
    for row in range(len(points)):
        total = 0.0
        if sloped:
            by = slopes[row]
            by[:] = 0.0
        for layer in range(len(layers)):
            s = points[row, 0] + layers[layer, 0] - x[0]
            u = min(s, 0.0) / LEVER_MM
            y0 = points[row, 1] + layers[layer, 1] - x[1] - s * x[3] - u * u * (x[7] + u * x[9])
            y1 = points[row, 2] + layers[layer, 2] - x[2] - s * x[4] - u * u * (x[8] + u * x[10])
            q0, q1 = Q00 * y0 + Q01 * y1, Q01 * y0 + Q11 * y1
            exponent = 0.5 * (q0 * y0 + q1 * y1)
            if exponent > FAR:
                continue
            density = factor * math.exp(-exponent)
            m = (k0 * y0 + k1 * y1 - s) / long
            part = density * 0.5 * math.erfc(-m / math.sqrt(2.0))
            total += part
            if sloped:
                end = density * math.exp(-0.5 * m * m) / (math.sqrt(2.0 * math.pi) * long)
                a0, a1 = end * k0 - part * q0, end * k1 - part * q1  # by y
                lean0 = x[3] + (2.0 * u * x[7] + 3.0 * u * u * x[9]) / LEVER_MM
                lean1 = x[4] + (2.0 * u * x[8] + 3.0 * u * u * x[10]) / LEVER_MM
                by[0] += end + a0 * lean0 + a1 * lean1
                by[1] -= a0
                by[2] -= a1
                by[3] -= a0 * s
                by[4] -= a1 * s
                curved = 0.5 * (D00 * q0 * q0 + 2.0 * D01 * q0 * q1 + D11 * q1 * q1)
                by[5] += part * (by_factor + curved) + end * (by_k0 * y0 + by_k1 * y1 - m * by_long)
                by[6] += part
                by[7] -= a0 * u * u
                by[8] -= a1 * u * u
                by[9] -= a0 * u * u * u
                by[10] -= a1 * u * u * u
        if total >= full:
            total = full
            if sloped:
                by[:] = 0.0
        image[row] = total
