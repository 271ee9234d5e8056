"""Speckle: what a pulse makes of many small scatterers, and how the pulse spreads with depth.

A beam-formed image before its envelope is taken is the tissue's reflectivity, blurred by the point spread. Many
scatterers in one resolution cell add up to a complex Gaussian (Goodman, "Some fundamental properties of speckle",
J. Opt. Soc. Am. 66, 1976), so its envelope is Rayleigh: mean over standard deviation sqrt(pi / (4 - pi)) = 1.913
(Burckhardt, "Speckle in ultrasound B-mode scans", IEEE Trans. Sonics Ultrason. 25, 1978).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats

Complexes = NDArray[np.complexfloating]
"""Single precision on the way: the display has 256 greys."""

FWHM_PER_SIGMA = float(2.0 * np.sqrt(2.0 * np.log(2.0)))
"""Full width at half maximum of a Gaussian, over its standard deviation."""

RAYLEIGH_SNR = float(np.sqrt(np.pi / (4.0 - np.pi)))
"""Mean over standard deviation of a Rayleigh envelope."""

MARGIN_SIGMAS = 4.0
"""Scatterers are drawn so far beyond the image's edges: no edge thins the speckle, nothing wraps around."""


class PointSpread(NamedTuple):
    """The pulse's two-way amplitude: Gaussian along the beam and across it, wider with depth. Widths are FWHM, mm."""

    axial_mm: float = 0.5
    """Along the beam, at the probe's face."""
    axial_growth: float = 0.004
    """mm per mm of depth: high frequencies fade first."""
    lateral_mm: float = 0.7
    """Across the beam, in the image plane, at the probe's face."""
    lateral_growth: float = 0.015
    """mm per mm of depth: the aperture does not grow for ever."""

    def axial_sigma(self, depth_mm: Floats) -> Floats:
        """Standard deviation along the beam, mm, any shape."""
        return np.asarray((self.axial_mm + self.axial_growth * depth_mm) / FWHM_PER_SIGMA)

    def lateral_sigma(self, depth_mm: Floats) -> Floats:
        """Standard deviation across the beam, mm, any shape."""
        return np.asarray((self.lateral_mm + self.lateral_growth * depth_mm) / FWHM_PER_SIGMA)


def blurred_speckle(
    rows: int, columns: int, pixel_mm: float, spread: PointSpread, reflectivity: Floats, rng: np.random.Generator
) -> Complexes:
    """Speckle of unit power where the reflectivity is 1.

    Args:
        rows: Of the image; row r lies at depth r * pixel_mm.
        columns: Of the image.
        pixel_mm: Edge of a pixel.
        spread: The point spread.
        reflectivity: Amplitude of the scatterers, shape (rows, columns); edges continue beyond the image.
        rng: Draws the scatterers: complex Gaussian, independent from pixel to pixel.

    Returns:
        Complex, shape (rows, columns): each row's blur has unit energy, as if the gain were set to make up for it.
    """
    deepest = np.array((rows - 1) * pixel_mm)
    above = int(np.ceil(MARGIN_SIGMAS * float(spread.axial_sigma(deepest)) / pixel_mm))
    aside = int(np.ceil(MARGIN_SIGMAS * float(spread.lateral_sigma(deepest)) / pixel_mm))
    size = (rows + 2 * above, columns + 2 * aside)
    strength = np.pad(reflectivity / np.sqrt(2.0), ((above, above), (aside, aside)), mode="edge").astype(np.float32)
    depth = pixel_mm * np.arange(rows, dtype=np.float64)
    kernel = _axial_kernel(rows, above, pixel_mm, spread.axial_sigma(depth)).astype(np.float32)
    real, imaginary = (kernel @ (strength * rng.standard_normal(size, dtype=np.float32)) for _ in "ri")
    blurred = _lateral_blur(real + 1j * imaginary, pixel_mm, spread.lateral_sigma(depth))
    return blurred[:, aside : aside + columns]


def _axial_kernel(rows: int, above: int, pixel_mm: float, sigma: Floats) -> Floats:
    """Row r of the result gathers the scatterers about row r + above; shape (rows, rows + 2 above), unit energy."""
    away = pixel_mm * (np.arange(rows + 2 * above)[None, :] - above - np.arange(rows)[:, None])
    kernel = np.exp(-0.5 * (away / sigma[:, None]) ** 2)
    return np.asarray(kernel / np.linalg.norm(kernel, axis=1, keepdims=True))


def _lateral_blur(field: Complexes, pixel_mm: float, sigma: Floats) -> Complexes:
    """Each row blurred with its own width, by its transform; unit energy."""
    frequency = np.fft.fftfreq(field.shape[1], pixel_mm)
    transfer = np.exp(-2.0 * (np.pi * frequency[None, :] * sigma[:, None]) ** 2)
    transfer /= np.sqrt(np.mean(transfer**2, axis=1, keepdims=True))
    return np.asarray(np.fft.ifft(np.fft.fft(field, axis=1) * transfer.astype(np.float32), axis=1))
