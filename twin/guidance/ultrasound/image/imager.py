"""Probe and machine as a case states them: the image's frame, its grey levels, the point spread, the needle's echo.

The frame ``image``: its origin is the middle of the upper left pixel, x (u) runs along the probe's face to the right,
y (v) into the depth, z out of the plane; mm.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Pixels

FWHM_PER_SIGMA = float(2.0 * np.sqrt(2.0 * np.log(2.0)))
"""Full width at half maximum of a Gaussian, over its standard deviation."""

WHITE = 255
"""The brightest grey level."""


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


@dataclass(frozen=True)
class Imager:
    """Probe and machine. Lengths in mm.

    Attributes:
        columns: Pixels along the face.
        rows: Pixels in depth.
        pixel_mm: Edge of a pixel.
        slice_fwhm_mm: Full width of the slice's amplitude profile across the plane.
        range_db: Dynamic range of the display: this many dB from black to white.
        speckle_db: Grey of mean speckle power, dB below white.
        noise_db: Electronic noise, dB below mean speckle.
    """

    columns: int = 250
    rows: int = 300
    pixel_mm: float = 0.2
    slice_fwhm_mm: float = 1.2
    range_db: float = 60.0
    speckle_db: float = 34.0
    noise_db: float = 25.0
    spread: PointSpread = field(default_factory=PointSpread)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and depth: (u, v) of the last pixel's middle."""
        return ((self.columns - 1) * self.pixel_mm, (self.rows - 1) * self.pixel_mm)

    @property
    def slice_sigma(self) -> float:
        """Standard deviation of the slice's profile, mm."""
        return self.slice_fwhm_mm / FWHM_PER_SIGMA

    def slice_gain(self, off_plane_mm: Floats) -> Floats:
        """Amplitude of an echo off the plane over that in it; any shape."""
        return np.asarray(np.exp(-0.5 * (off_plane_mm / self.slice_sigma) ** 2))

    def grey(self, amplitude: Floats) -> Pixels:
        """Log compression: amplitude 1 is mean speckle."""
        level = 20.0 * np.log10(np.maximum(amplitude, 1e-12)) - self.speckle_db
        return np.clip(np.round(WHITE * (1.0 + level / self.range_db)), 0, WHITE).astype(np.uint8)

    def amplitude(self, grey: NDArray[np.generic]) -> Floats:
        """Amplitude from greys, the inverse of :meth:`grey` where a pixel is neither black nor white."""
        level = self.range_db * (np.asarray(grey, dtype=np.float64) / WHITE - 1.0)
        return np.asarray(10.0 ** ((level + self.speckle_db) / 20.0))


@dataclass(frozen=True)
class NeedleEcho:
    """Echo of the needle's steel. Amplitudes against mean speckle.

    Attributes:
        contrast_db: Of the shaft in the plane and parallel to the face, at the middle depth.
        steep_loss_db: How much fainter it is when it points straight down: less comes back to the face.
        roughness: Random part of the shaft's amplitude.
        tip_gain: Amplitude of the tip over the shaft's.
        tip_length_mm: Over which the tip is brighter.
        reverberations: Echoes between the walls, below the shaft.
        reverberation_mm: Spacing of them.
        reverberation_gain: Of each against the one before, for a needle parallel to the face. It falls with the squared
            cosine of the inclination: what bounces between tilted walls is mirrored away from the face.
        shadow: How much of the sound the needle keeps from what lies below it, 0..1.
    """

    contrast_db: float = 28.0
    steep_loss_db: float = 8.0
    roughness: float = 0.35
    tip_gain: float = 1.8
    tip_length_mm: float = 0.6
    reverberations: int = 2
    reverberation_mm: float = 1.6
    reverberation_gain: float = 0.3
    shadow: float = 0.5
