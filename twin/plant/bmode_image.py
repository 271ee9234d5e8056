"""B-mode images of a needle in a speckle phantom, from the ground truth of needle and image plane.

The frame ``image``: its origin is the middle of the upper left pixel, x (u) runs along the probe's face to the right,
y (v) into the depth, z out of the plane; mm. A needle off the plane fades as the slice's Gaussian profile (spec 3,
section 5). One image's speckle is independent of the next one's: two poses of a calibration show different cells.

A beam-formed image before its envelope is taken is the tissue's reflectivity, blurred by the point spread. Many
scatterers in one resolution cell add up to a complex Gaussian (Goodman, "Some fundamental properties of speckle",
J. Opt. Soc. Am. 66, 1976), so its envelope is Rayleigh: mean over standard deviation sqrt(pi / (4 - pi)) = 1.913
(Burckhardt, "Speckle in ultrasound B-mode scans", IEEE Trans. Sonics Ultrason. 25, 1978).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.errors import refuse
from puncture_twin.twin.guidance.ultrasound.needle_detector import Imager, NeedleEcho, PointSpread

Complexes = NDArray[np.complexfloating]
"""Single precision inside: the display has 256 greys."""

MARGIN_SIGMAS = 4.0
"""Scatterers are drawn so far beyond the image's edges: no edge thins the speckle, nothing wraps around."""


def blurred_speckle(
    rows: int, columns: int, pixel_mm: float, spread: PointSpread, reflectivity: Floats, rng: np.random.Generator
) -> Complexes:
    """Speckle of unit power where the reflectivity is 1.

    Args:
        rows: Of the image; row r lies at depth r * pixel_mm.
        columns: Of the image.
        pixel_mm: Edge of a pixel.
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
    transfer /= np.sqrt(np.mean(transfer**2, axis=1, keepdims=True))  # unit energy (Parseval)
    return np.asarray(np.fft.ifft(np.fft.fft(field, axis=1) * transfer.astype(np.float32), axis=1))


SAMPLE_MM = 0.2
"""Step along the shaft; not wider than the narrowest point spread's sigma (0.21 mm), so the line has no ripple."""

UNIT = 1e-6
"""How far a direction's length may be from 1."""


class NeedleInImage(NamedTuple):
    """The needle in the frame ``image``."""

    tip_image: Floats
    """Shape (3,), mm; z is how far the tip is off the plane."""
    direction_image: Floats
    """Unit, shape (3,): from the hub to the tip."""


class Lesion(NamedTuple):
    """A ball that scatters less than its surroundings."""

    centre_image: Floats
    """Shape (3,), mm."""
    radius_mm: float
    gain: float = 0.25
    """Its scatterers' amplitude against the rest."""


def render(
    imager: Imager,
    needle: NeedleInImage | None,
    rng: np.random.Generator,
    *,
    echo: NeedleEcho | None = None,
    lesion: Lesion | None = None,
) -> Pixels:
    """One B-mode image.

    Args:
        needle: The needle, or None for none.
        rng: Draws speckle, the shaft's roughness and electronic noise.
        echo: What the needle sends back; None for the usual one.
        lesion: A darker ball.

    Returns:
        Grey levels, shape (rows, columns).

    Raises:
        InputError: A needle that is not finite or whose direction is no unit vector.
    """
    echo = echo or NeedleEcho()
    reflectivity = _lesion_gain(imager, lesion)
    if needle is not None:
        _require_usable(needle)
        reflectivity = reflectivity * _shadow(imager, needle, echo)
    size = (imager.rows, imager.columns)
    signal = blurred_speckle(imager.rows, imager.columns, imager.pixel_mm, imager.spread, reflectivity, rng)
    if needle is not None:
        signal = signal + needle_signal(imager, needle, echo, rng)
    hiss = 10.0 ** (-imager.noise_db / 20.0) / np.sqrt(2.0)  # each of the two parts
    signal = signal + hiss * (rng.standard_normal(size) + 1j * rng.standard_normal(size))
    return imager.grey(np.abs(signal))


def needle_signal(imager: Imager, needle: NeedleInImage, echo: NeedleEcho, rng: np.random.Generator) -> Complexes:
    """The needle's echoes, complex, shape (rows, columns), before the envelope is taken."""
    points, s = _shaft(imager, needle)
    size = (imager.rows, imager.columns)
    if len(points) == 0:
        return np.zeros(size, dtype=np.complex128)
    rough = rng.standard_normal(len(s)) + 1j * rng.standard_normal(len(s))
    source = imager.slice_gain(points[:, 2]) * (1.0 + echo.roughness * rough / np.sqrt(2.0))
    source = source * np.where(s < echo.tip_length_mm, echo.tip_gain, 1.0)
    source = source * _brightness(imager, needle, echo) * np.exp(2j * np.pi * rng.uniform())
    signal = np.zeros(size, dtype=np.complex128)
    bounced = echo.reverberation_gain * float(1.0 - needle.direction_image[1] ** 2)  # squared cosine of the tilt
    for bounce in range(echo.reverberations + 1):
        below = points + [0.0, bounce * echo.reverberation_mm, 0.0]
        phase = np.exp(2j * np.pi * rng.uniform()) if bounce else 1.0
        signal += phase * bounced**bounce * _spread_out(imager, below, source)
    return signal


def _brightness(imager: Imager, needle: NeedleInImage, echo: NeedleEcho) -> float:
    """Amplitude of one sample, such that a level shaft at the middle depth has the stated contrast."""
    middle = imager.spread.axial_sigma(np.array(imager.size_mm[1] / 2.0))
    steep = float(needle.direction_image[1] ** 2)
    level_db = echo.contrast_db - echo.steep_loss_db * steep
    return float(10.0 ** (level_db / 20.0) * np.sqrt(2.0 * np.pi) * middle * SAMPLE_MM)


def _spread_out(imager: Imager, points: Floats, source: Complexes) -> Complexes:
    """Points' echoes as the point spread has them, each of unit integral, exact below the pixel."""
    depth = np.maximum(points[:, 1], 0.0)
    across, along = imager.spread.lateral_sigma(depth), imager.spread.axial_sigma(depth)
    lateral = _gaussians(imager.pixel_mm * np.arange(imager.columns, dtype=np.float64), points[:, 0], across)
    axial = _gaussians(imager.pixel_mm * np.arange(imager.rows, dtype=np.float64), points[:, 1], along)
    weight = (source / (2.0 * np.pi * across * along))[:, None]
    parts = [axial.T @ (lateral * part.astype(np.float32)) for part in (weight.real, weight.imag)]
    return np.asarray(parts[0] + 1j * parts[1], dtype=np.complex128)


def _gaussians(at: Floats, middles: Floats, sigmas: Floats) -> NDArray[np.float32]:
    """exp(-(at - middle)^2 / 2 sigma^2), shape (len(middles), len(at)), in single precision: 256 greys show no more."""
    away = ((at[None, :] - middles[:, None]) / sigmas[:, None]).astype(np.float32)
    return np.asarray(np.exp(np.float32(-0.5) * away * away))


def _shaft(imager: Imager, needle: NeedleInImage) -> tuple[Floats, Floats]:
    """Points along the shaft that may show, shape (n, 3), and their distances from the tip, shape (n,), mm."""
    longest = float(np.hypot(*imager.size_mm)) + 20.0
    s = SAMPLE_MM * (np.arange(int(longest / SAMPLE_MM)) + 0.5)
    points = needle.tip_image - s[:, None] * needle.direction_image
    near = 5.0
    high = np.array(imager.size_mm) + near
    seen = np.all((points[:, :2] > -near) & (points[:, :2] < high), axis=1) & (points[:, 1] > 0.0)
    seen &= imager.slice_gain(points[:, 2]) > 1e-4
    return points[seen], s[seen]


def _shadow(imager: Imager, needle: NeedleInImage, echo: NeedleEcho) -> Floats:
    """Fraction of the sound that the needle lets pass, shape (rows, columns)."""
    points, _ = _shaft(imager, needle)
    left = np.ones((imager.rows, imager.columns))
    if len(points) < 2:
        return left
    u = imager.pixel_mm * np.arange(imager.columns)
    order = np.argsort(points[:, 0])
    sorted_u = points[order, 0]
    under = (u >= sorted_u[0]) & (u <= sorted_u[-1])
    depth = np.interp(u, sorted_u, points[order, 1])
    kept = 1.0 - echo.shadow * imager.slice_gain(np.interp(u, sorted_u, points[order, 2]))
    v = imager.pixel_mm * np.arange(imager.rows)
    below = (v[:, None] > depth[None, :]) & under[None, :]
    return np.where(below, kept[None, :], left)


def _lesion_gain(imager: Imager, lesion: Lesion | None) -> Floats:
    gain = np.ones((imager.rows, imager.columns))
    if lesion is None:
        return gain
    u, v = imager.pixel_mm * np.arange(imager.columns), imager.pixel_mm * np.arange(imager.rows)
    x, y, z = lesion.centre_image
    inside = (u[None, :] - x) ** 2 + (v[:, None] - y) ** 2 + z**2 < lesion.radius_mm**2
    return np.where(inside, lesion.gain, gain)


def _require_usable(needle: NeedleInImage) -> None:
    tip, direction = np.asarray(needle.tip_image), np.asarray(needle.direction_image)
    usable = tip.shape == (3,) and direction.shape == (3,) and bool(np.isfinite([*tip, *direction]).all())
    if not usable or abs(float(np.linalg.norm(direction)) - 1.0) > UNIT:
        allowed = "a finite tip (3,) in mm and a unit direction (3,)"
        refuse(f"needle at {tip.tolist()} along {direction.tolist()}", "B-mode picture", allowed, "not_finite")
