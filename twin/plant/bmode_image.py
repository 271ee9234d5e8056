"""B-mode images of a needle in a speckle phantom, from the ground truth of needle and image plane.

The frame ``image``: its origin is the middle of the upper left pixel, x (u) runs along the probe's face to the right,
y (v) into the depth, z out of the plane; mm. A needle off the plane fades as the slice's Gaussian profile (spec 3,
section 5). Many scatterers in one resolution cell add up to a complex Gaussian (Goodman, "Some fundamental properties
of speckle", J. Opt. Soc. Am. 66, 1976); its envelope is Rayleigh, mean over standard deviation 1.913 (Burckhardt,
"Speckle in ultrasound B-mode scans", IEEE Trans. Sonics Ultrason. 25, 1978).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.twin.guidance.ultrasound.needle_detector import Imager, NeedleEcho, PointSpread

Complexes = NDArray[np.complexfloating]
"""Single precision inside: the display has 256 greys."""
MARGIN_SIGMAS = 4.0
"""Scatterers are drawn so far beyond the image's edges: no edge thins the speckle, nothing wraps around."""


def blurred_speckle(
    rows: int, columns: int, pixel_mm: float, spread: PointSpread, reflectivity: Floats, rng: np.random.Generator
) -> Complexes:
    """Speckle of unit power where the reflectivity (rows, columns) is 1; complex, each row's blur of unit energy."""
    deepest = np.array((rows - 1) * pixel_mm)
    above = int(np.ceil(MARGIN_SIGMAS * float(spread.axial_sigma(deepest)) / pixel_mm))
    aside = int(np.ceil(MARGIN_SIGMAS * float(spread.lateral_sigma(deepest)) / pixel_mm))
    size = (rows + 2 * above, columns + 2 * aside)
    strength = np.pad(reflectivity / np.sqrt(2.0), ((above, above), (aside, aside)), mode="edge").astype(np.float32)
    depth = pixel_mm * np.arange(rows, dtype=np.float64)
    # along the beam: row r gathers the scatterers about row r + above
    away = pixel_mm * (np.arange(rows + 2 * above)[None, :] - above - np.arange(rows)[:, None])
    kernel = np.exp(-0.5 * (away / spread.axial_sigma(depth)[:, None]) ** 2)
    kernel = np.asarray(kernel / np.linalg.norm(kernel, axis=1, keepdims=True)).astype(np.float32)
    real, imaginary = (kernel @ (strength * rng.standard_normal(size, dtype=np.float32)) for _ in "ri")
    # across it: each row with its own width, by its transform
    frequency = np.fft.fftfreq(size[1], pixel_mm)
    transfer = np.exp(-2.0 * (np.pi * frequency[None, :] * spread.lateral_sigma(depth)[:, None]) ** 2)
    transfer /= np.sqrt(np.mean(transfer**2, axis=1, keepdims=True))  # unit energy (Parseval)
    blurred = np.fft.ifft(np.fft.fft(real + 1j * imaginary, axis=1) * transfer.astype(np.float32), axis=1)
    return np.asarray(blurred[:, aside : aside + columns])


SAMPLE_MM = 0.2
"""Step along the shaft; not wider than the narrowest point spread's sigma (0.21 mm), so the line has no ripple."""


class NeedleInImage(NamedTuple):
    """The needle in the frame ``image``: its tip (3,), mm, and its direction (3,), unit, from the hub to the tip."""

    tip_image: Floats  # shape (3,), mm; z is how far the tip is off the plane
    direction_image: Floats  # unit, shape (3,): from the hub to the tip


class Lesion(NamedTuple):
    """A ball about (3,), mm, whose scatterers have so much of the others' amplitude."""

    centre_image: Floats  # shape (3,), mm
    radius_mm: float
    gain: float = 0.25


def render(
    imager: Imager, needle: NeedleInImage | None, rng: np.random.Generator, *,
    echo: NeedleEcho | None = None, lesion: Lesion | None = None,
) -> Pixels:  # fmt: skip
    """One B-mode image: grey levels, shape (rows, columns)."""
    echo, size = echo or NeedleEcho(), (imager.rows, imager.columns)
    reflectivity = np.ones(size)
    if lesion is not None:
        u, v = imager.pixel_mm * np.arange(imager.columns), imager.pixel_mm * np.arange(imager.rows)
        x, y, z = lesion.centre_image
        inside = (u[None, :] - x) ** 2 + (v[:, None] - y) ** 2 + z**2 < lesion.radius_mm**2
        reflectivity[inside] = lesion.gain
    if needle is not None:
        reflectivity = reflectivity * _shadow(imager, needle, echo)
    signal = blurred_speckle(imager.rows, imager.columns, imager.pixel_mm, imager.spread, reflectivity, rng)
    if needle is not None:
        signal = signal + needle_signal(imager, needle, echo, rng)
    hiss = 10.0 ** (-imager.noise_db / 20.0) / np.sqrt(2.0)  # each of the two parts
    signal = signal + hiss * (rng.standard_normal(size) + 1j * rng.standard_normal(size))
    return imager.grey(np.abs(signal))


def needle_signal(imager: Imager, needle: NeedleInImage, echo: NeedleEcho, rng: np.random.Generator) -> Complexes:
    """The needle's echoes, complex, shape (rows, columns), before the envelope is taken."""
    points, s = _shaft(imager, needle)
    signal = np.zeros((imager.rows, imager.columns), dtype=np.complex128)
    if len(points) == 0:
        return signal
    rough = rng.standard_normal(len(s)) + 1j * rng.standard_normal(len(s))
    source = imager.slice_gain(points[:, 2]) * (1.0 + echo.roughness * rough / np.sqrt(2.0))
    source = source * np.where(s < echo.tip_length_mm, echo.tip_gain, 1.0)
    middle = float(imager.spread.axial_sigma(np.array(imager.size_mm[1] / 2.0)))
    level_db = echo.contrast_db - echo.steep_loss_db * float(needle.direction_image[1] ** 2)
    # of one sample, such that a level shaft at the middle depth has the stated contrast
    brightness = float(10.0 ** (level_db / 20.0) * np.sqrt(2.0 * np.pi) * middle * SAMPLE_MM)
    source = source * brightness * np.exp(2j * np.pi * rng.uniform())
    bounced = echo.reverberation_gain * float(1.0 - needle.direction_image[1] ** 2)  # squared cosine of the tilt
    for bounce in range(echo.reverberations + 1):
        below = points + [0.0, bounce * echo.reverberation_mm, 0.0]
        phase = np.exp(2j * np.pi * rng.uniform()) if bounce else 1.0
        signal += phase * bounced**bounce * _spread_out(imager, below, source)
    return signal


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
    points, _ = _shaft(imager, needle)
    left = np.ones((imager.rows, imager.columns))
    if len(points) < 2:
        return left
    u = imager.pixel_mm * np.arange(imager.columns)
    order = np.argsort(points[:, 0])
    sorted_u = points[order, 0]
    under = (u >= sorted_u[0]) & (u <= sorted_u[-1])
    depth = np.interp(u, sorted_u, points[order, 1])
    transmitted = 1.0 - echo.shadow * imager.slice_gain(np.interp(u, sorted_u, points[order, 2]))
    v = imager.pixel_mm * np.arange(imager.rows)
    below = (v[:, None] > depth[None, :]) & under[None, :]
    return np.where(below, transmitted[None, :], left)
