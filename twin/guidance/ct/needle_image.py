"""The image that a thin rod along a curve makes in a CT: blurred in the plane, averaged over slices, clipped.

A rod of radius r along a curve c(s), s <= 0 behind its tip, in axes whose first is nearly the rod's:

    c(s) = tip + (s, g s + b u^2 + d u^3),    u = s / `LEVER_MM`

At a point s along the curve and y (2,) beside it, with the blur's covariance there in blocks C_ss, C_ys and C_yy:

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
LAYER_MM, SOFT = 0.6, 1.5
"""A slice is taken apart into layers no thicker, nor than so many deviations of what a needle's own image smooths
across it: their Gaussians add up to its even profile, whose edges tell where a needle lies that runs within it."""
LEVER_MM = 50.0
"""At which a bend is counted."""
LIKE_NONE = 50.0
"""Logarithm of a blur or a gain that no needle has, nor a number overflows by: a step of the fit may go anywhere."""
NUMBERS = 11
"""Of a curve: shift of the tip (3), mm; slopes (2); logarithms of blur and gain (2); bends (2 + 2), mm at the lever."""
FAR = 20.0
"""Exponents beyond leave nothing of a Gaussian."""


class CurveImage(NamedTuple):
    """The image of a curve's `NUMBERS`, at points in its axes."""

    axes: Floats  # shape (3, 3), rows: nearly the needle's direction, and the two across it
    plane: Floats  # shape (3, 3), mm², in these axes: the assumed blur in the image's plane, which is fitted, and
    fixed: Floats  # the same, of one layer of a slice and of the needle's own width
    layers: Floats  # shape (m, 3), mm, in these axes: where a slice's layers lie, once for each half of the needle
    diameter_mm: float
    full: float  # part of metal from which a voxel is clipped

    @classmethod
    def of(cls, volume: Volume, axes: Floats, diameter_mm: float) -> CurveImage:
        """Of a volume's slices and pixels."""
        spacing = spacing_mm(volume)
        directions = axes @ (volume.T_ct_index[:3, :3] / spacing)
        in_plane, normal = directions[:, :2], directions[:, 2:]
        half, along = _half(diameter_mm, normal[:, 0]), normal[0, 0] ** 2
        width = diameter_mm**2 / 16 * np.diag([0.0, 1.0, 1.0]) - np.outer(half, half)  # of a disc, along each axis
        soft = np.sqrt(normal[:, 0] @ width @ normal[:, 0] + BLUR_SIGMA_MM**2 * along / max(1.0 - along, 1e-9))
        count = math.ceil(spacing[2] / min(LAYER_MM, SOFT * soft))
        steps = ((np.arange(count) + 0.5) / count - 0.5) * spacing[2]
        fixed = (spacing[2] / count) ** 2 / 12 * (normal @ normal.T) + width
        plane, layers = BLUR_SIGMA_MM**2 * (in_plane @ in_plane.T), steps[:, None] * normal.T
        both = np.concatenate([layers - half, layers + half])
        return cls(axes, plane, fixed, both, diameter_mm, full_part(volume))

    def off(self, x: Floats, s: Floats) -> Floats:
        """Distance of the curve from its axis behind the tip, across it, shape (n, 2)."""
        u = np.minimum(s, 0.0) / LEVER_MM
        return np.stack([s * x[3 + k] + u * u * (x[7 + k] + u * x[9 + k]) for k in (0, 1)], axis=1)

    def parts(self, x: Floats, local: Floats) -> Floats:
        """Part of metal at points (n, 3), mm, in its axes."""
        return self._rendered(x, local, np.empty((0, NUMBERS)))

    def slopes(self, x: Floats, local: Floats) -> Floats:
        """Derivatives of the parts by the numbers, shape (n, 11); a blur's own change by a bend is left out."""
        slopes = np.empty((len(local), NUMBERS))
        self._rendered(x, local, slopes)
        return slopes

    def _rendered(self, x: Floats, local: Floats, slopes: Floats) -> Floats:
        blur, gain = np.exp(np.clip(x[5:7], -LIKE_NONE, LIKE_NONE))
        plane, image = blur**2 * self.plane, np.empty(len(local))
        factor = gain * self.diameter_mm**2 / 8 / len(self.layers)
        _render(local, self.layers, x, plane + self.fixed, 2 * plane, factor, self.full, image, slopes)
        return image


def _half(diameter_mm: float, normal: Floats) -> Floats:
    """Middle of the half of a needle on one side of a slice's plane, shape (3,): two halves enter a slice as it does.

    A single Gaussian enters a slice too early and too softly: a needle that runs through slices would seem to bend.
    """
    aside = np.array([0.0, *normal[1:]])
    return 2.0 * diameter_mm / (3.0 * np.pi) * aside / max(float(np.linalg.norm(aside)), 1e-9)


@nb.njit(cache=True, error_model="numpy")
def _render(points, layers, x, blur, by_blur, factor, full, image, slopes):  # type: ignore[no-untyped-def]
    """Fill the image (n,), and its slopes (n, 11) where there is room for them."""
    sloped = len(slopes) > 0
    C, D = np.empty(6), np.empty(6)
    for row in range(len(points)):
        total = 0.0
        if sloped:
            by = slopes[row]
            by[:] = 0.0
        for layer in range(len(layers)):
            s, u, y0, y1, lean0, lean1 = _beside(points[row], layers[layer], x)
            _leant(blur, lean0, lean1, C)
            det = C[3] * C[5] - C[4] * C[4]
            Q00, Q01, Q11 = C[5] / det, -C[4] / det, C[3] / det
            q0, q1 = Q00 * y0 + Q01 * y1, Q01 * y0 + Q11 * y1
            exponent = 0.5 * (q0 * y0 + q1 * y1)
            if exponent > FAR:
                continue
            k0, k1 = Q00 * C[1] + Q01 * C[2], Q01 * C[1] + Q11 * C[2]
            long = math.sqrt(C[0] - k0 * C[1] - k1 * C[2])
            density = factor * math.sqrt((1.0 + lean0 * lean0 + lean1 * lean1) / det) * math.exp(-exponent)
            m = (k0 * y0 + k1 * y1 - s) / long
            part = density * 0.5 * math.erfc(-m / math.sqrt(2.0))
            total += part
            if sloped:
                end = density * math.exp(-0.5 * m * m) / (math.sqrt(2.0 * math.pi) * long)
                a0, a1 = end * k0 - part * q0, end * k1 - part * q1  # by y
                by[0] += end + a0 * lean0 + a1 * lean1
                by[1] -= a0
                by[2] -= a1
                by[3] -= a0 * s
                by[4] -= a1 * s
                by[6] += part
                by[7] -= a0 * u * u
                by[8] -= a1 * u * u
                by[9] -= a0 * u * u * u
                by[10] -= a1 * u * u * u
                _leant(by_blur, lean0, lean1, D)
                wider = 0.5 * (D[3] * q0 * q0 + 2.0 * D[4] * q0 * q1 + D[5] * q1 * q1)
                wider -= 0.5 * (Q00 * D[3] + 2.0 * Q01 * D[4] + Q11 * D[5])
                v0, v1 = D[1] - D[3] * k0 - D[4] * k1, D[2] - D[4] * k0 - D[5] * k1
                longer = (D[0] - k0 * (D[1] + v0) - k1 * (D[2] + v1)) / (2.0 * long)
                by[5] += part * wider + end * (q0 * v0 + q1 * v1 - m * longer)
        if total >= full:
            total = full
            if sloped:
                by[:] = 0.0
        image[row] = total


@nb.njit(cache=True, error_model="numpy")
def _beside(point, layer, x):  # type: ignore[no-untyped-def]
    """A layer's point: along the needle (mm, and in levers), across it from its bend, and the lean of the bend."""
    s = point[0] + layer[0] - x[0]
    u = min(s, 0.0) / LEVER_MM
    y0 = point[1] + layer[1] - x[1] - s * x[3] - u * u * (x[7] + u * x[9])
    y1 = point[2] + layer[2] - x[2] - s * x[4] - u * u * (x[8] + u * x[10])
    lean0 = x[3] + (2.0 * u * x[7] + 3.0 * u * u * x[9]) / LEVER_MM
    lean1 = x[4] + (2.0 * u * x[8] + 3.0 * u * u * x[10]) / LEVER_MM
    return s, u, y0, y1, lean0, lean1


@nb.njit(cache=True, error_model="numpy")
def _leant(C, a, b, leant):  # type: ignore[no-untyped-def]
    """A covariance of (s, y) with y counted from a line of slopes a and b: ss, sy, sy, yy, yy, yy."""
    leant[0] = C[0, 0]
    leant[1] = C[0, 1] - a * C[0, 0]
    leant[2] = C[0, 2] - b * C[0, 0]
    leant[3] = C[1, 1] - 2.0 * a * C[0, 1] + a * a * C[0, 0]
    leant[4] = C[1, 2] - a * C[0, 2] - b * C[0, 1] + a * b * C[0, 0]
    leant[5] = C[2, 2] - 2.0 * b * C[0, 2] + b * b * C[0, 0]
