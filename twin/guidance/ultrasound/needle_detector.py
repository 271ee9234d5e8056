"""Probe and machine as a case states them, and needle detection in their B-mode images.

The frame ``image``: its origin is the middle of the upper left pixel, x (u) runs along the probe's face to the right,
y (v) into the depth, z out of the plane; mm.

Every line of a grid of angles and offsets is sampled (a Radon transform that may begin and end anywhere); along it the
segment with the largest sum is found in one pass (Kadane's maximum subarray, Bentley, Commun. ACM 27, 1984). What a
sample must exceed to lengthen the segment is subtracted before, so that noise has a falling sum and the largest one
stays small where there is no needle.

1. Amplitude over background: the display's log compression is undone, the median around divides it.
2. The brightest straight segment; too small a sum is no needle.
3. The line, by weighted least squares on the ridge, through a window that narrows to it.
4. The shaft along the line: it may be a row of beads, and has gaps of up to some mm.
5. The tip: the last place where the amplitude falls half way to the background's.

The needle goes down into the body, so the deeper end is the tip. What shows is where the needle leaves the *slice*: of
a needle that is tilted against the image plane the end that shows need not be the tip, and no image alone can tell.
"""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.numba_kernels import nb

FWHM_PER_SIGMA = float(2.0 * np.sqrt(2.0 * np.log(2.0)))
"""Full width at half maximum of a Gaussian, over its standard deviation."""
WHITE = 255
"""The brightest grey level."""


class PointSpread(NamedTuple):
    """The pulse's two-way amplitude: Gaussian along the beam and across it; widths are FWHM at the probe's face, mm.

    Both grow with depth, mm per mm: high frequencies fade first, and the aperture does not grow for ever.
    """

    axial_mm: float = 0.5
    axial_growth: float = 0.004
    lateral_mm: float = 0.7
    lateral_growth: float = 0.015

    def axial_sigma(self, depth_mm: Floats) -> Floats:
        """Standard deviation along the beam, mm, any shape."""
        return np.asarray((self.axial_mm + self.axial_growth * depth_mm) / FWHM_PER_SIGMA)

    def lateral_sigma(self, depth_mm: Floats) -> Floats:
        """Standard deviation across the beam, mm, any shape."""
        return np.asarray((self.lateral_mm + self.lateral_growth * depth_mm) / FWHM_PER_SIGMA)


@dataclass(frozen=True)
class Imager:
    """Probe and machine: pixels along the face and in depth, their edge, and the point spread; lengths in mm."""

    columns: int = 250
    rows: int = 300
    pixel_mm: float = 0.2
    slice_fwhm_mm: float = 1.2  # full width of the slice's amplitude profile across the plane
    range_db: float = 60.0  # from black to white
    speckle_db: float = 34.0  # grey of mean speckle power, below white
    noise_db: float = 25.0  # electronic noise, below mean speckle
    spread: PointSpread = field(default_factory=PointSpread)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and depth: (u, v) of the last pixel's middle."""
        return ((self.columns - 1) * self.pixel_mm, (self.rows - 1) * self.pixel_mm)

    def slice_gain(self, off_plane_mm: Floats) -> Floats:
        """Amplitude of an echo off the plane over that in it; any shape."""
        return np.asarray(np.exp(-0.5 * (off_plane_mm / (self.slice_fwhm_mm / FWHM_PER_SIGMA)) ** 2))

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
    """Echo of the needle's steel. Amplitudes against mean speckle."""

    contrast_db: float = 28.0  # of the shaft in the plane and parallel to the face, at the middle depth
    steep_loss_db: float = 8.0  # straight down: less comes back to the face
    roughness: float = 0.35  # random part of the shaft's amplitude
    tip_gain: float = 1.8  # the tip is brighter
    tip_length_mm: float = 0.6  # over which it is
    reverberations: int = 2  # echoes between the walls, below the shaft, each fainter than the one before
    reverberation_mm: float = 1.6
    reverberation_gain: float = 0.3  # parallel to the face, else times the squared cosine of the tilt
    shadow: float = 0.5  # how much of the sound the needle keeps from what lies below it, 0..1


class Segment(NamedTuple):
    """A straight segment, in pixels of the image that was searched."""

    start: Floats  # (column, row) of its shallower end
    end: Floats  # of its deeper end
    score: float  # sum of the samples along it, one per pixel of length


def brightest_segment(field: Floats, inclinations: Floats) -> Segment:
    """The segment of the largest sum of what samples add (rows, columns); below zero on average where there is nothing.

    Inclinations (n,), rad, are of lines to try, atan2(dv, du), in (0, pi): from shallow to deep.
    """
    best = _search(np.ascontiguousarray(field), np.ascontiguousarray(inclinations))
    return Segment(np.array(best[1:3]), np.array(best[3:5]), float(best[0]))


@nb.njit(cache=True)
def _search(field, inclinations):  # type: ignore[no-untyped-def]
    rows, columns = field.shape
    middle_x, middle_y = 0.5 * (columns - 1), 0.5 * (rows - 1)
    half = math.ceil(0.5 * math.hypot(rows, columns))
    best = (0.0, 0.0, 0.0, 0.0, 0.0)
    for angle in inclinations:
        dx, dy = math.cos(angle), math.sin(angle)
        for offset in range(-half, half + 1):
            x0, y0 = middle_x - offset * dy, middle_y + offset * dx
            total, begin = 0.0, -half
            for step in range(-half, half + 1):
                x, y = x0 + step * dx, y0 + step * dy
                if x < 0.0 or y < 0.0 or x >= columns - 1 or y >= rows - 1:
                    continue
                i, j = int(x), int(y)
                a, b = x - i, y - j
                top = (1.0 - a) * field[j, i] + a * field[j, i + 1]
                low = (1.0 - a) * field[j + 1, i] + a * field[j + 1, i + 1]
                if total <= 0.0:
                    total, begin = 0.0, step
                total += (1.0 - b) * top + b * low
                if total > best[0]:
                    best = (total, x0 + begin * dx, y0 + begin * dy, x, y)
    return best


MEAN_OVER_MEDIAN = float(np.sqrt(np.pi / 2.0) / np.sqrt(2.0 * np.log(2.0)))
"""Mean over median of a Rayleigh amplitude."""
COARSE = 2
"""The background is taken, and the segment searched, in an image this many times smaller."""
ANGLE_STEP = float(np.radians(1.5))
"""Between the directions that are tried: 0.3 mm at the end of 20 mm, well inside the ridge."""
BACKGROUND_MM = 12.0
"""Edge of the window whose median is the background: wide enough that a needle fills a small part of it, and narrow
enough to follow its shadow."""
BRIGHTEST = 3.0
"""Amplitude over background above which a pixel counts no more: one bright cell makes no needle."""
EXPECTED = 0.4
"""What a sample must exceed the background by to lengthen a segment."""
STEP_MM = 0.1
"""Step of the samples along and across the line."""
ACROSS_MM = 2.0
"""How far across the line the ridge is looked for."""
WINDOWS_MM = (0.8, 0.5, 0.4, 0.4)
"""Standard deviations of the window about the line, one per iteration; the first holds the search's own error."""
SHAFT_MM = 8.0
"""Length of shaft before the tip whose median is its level."""
NEAR_TIP_MM = 1.0
"""Length of shaft that is left out of its level: the tip is brighter."""
TIP_MM = 1.5
"""Length before the shaft's end whose brightest sample is the level of its last piece."""
SURE_SHAFT = 2.5
"""Amplitude over background that counts as shaft, however bright the rest is; the root of the shaft's where that is
less: half way to it in greys."""
MOST_LOST, MOST_GAINED = 0.5, 1.2
"""Logarithms of amplitude that one sample at most takes away and adds."""
TIP_ROUNDS = 3
"""Rounds of the shaft's level and end in turn."""
ENDS_AGREE_MM = 3.0
"""A faint shaft has gaps: where the search ends farther from the tip than this, nobody knows which is the end."""
RIDGE_MM = 0.8
"""Width of the ridge that a profile along the line averages."""
SHAFT_PERCENTILE = 70.0
"""Percentile of the profile along a segment: the shaft's level, though a part of the segment may be no shaft."""


class Missed(StrEnum):
    """Reason why there is no detection."""

    NO_NEEDLE = "no line stands out from the speckle"
    TOO_SHORT = "too little of the needle is visible"
    TIP_AT_EDGE = "the needle leaves the image before its tip"
    NO_END = "no clear end of the needle in the image"


LEAST_SCORE_MM = 9.0
"""Sum along the segment, amplitude over background times mm, that makes a needle."""
LEAST_LENGTH_MM = 6.0
"""Of the segment."""
EDGE_MM = 1.5
"""The tip is no nearer to the image's sides."""
LEAST_STEP, SURE_STEP = 0.8, 2.0
"""Falls of the amplitude at the tip, over background: what makes an end, and below what the search's own must agree."""
TIP_BIAS = 0.4
"""How far the detected tip lies beyond the real one along the shaft, on average, over the standard deviation of the
point spread in that direction. It comes from the tip's brightness: a property of a needle in a machine, measured in the
twin (benchmarks/detectors.py), to be measured anew elsewhere."""
INCLINATIONS = (float(np.radians(8.0)), float(np.radians(82.0)))
"""Directions that are tried: angle to the probe's face, on either side."""


class Detection(NamedTuple):
    """A detected needle."""

    tip_image: Floats  # (u, v), mm, corrected for the bias
    direction_image: Floats  # shape (2,), unit, toward the tip
    contrast_db: float  # amplitude of the last piece of shaft over the background
    shaft_mm: float  # how much of it shows


def detect(image: Pixels, imager: Imager, *, tip_bias: float = TIP_BIAS) -> Detection | Missed:
    """Detect the needle in grey levels (rows, columns), or return why not; the bias is taken off, in point spreads.

    Raises:
        InputError: An image of another size than the imager's.
    """
    if image.shape != (imager.rows, imager.columns):
        size = f"({imager.rows}, {imager.columns})"
        refuse(f"picture of shape {image.shape}", "needle detector", f"{size}, the imager's", "wrong_shape")
    relative = over_background(image, imager)
    segment = _segment(relative, imager)
    if segment.score < LEAST_SCORE_MM:
        return Missed.NO_NEEDLE
    if np.linalg.norm(segment.end - segment.start) < LEAST_LENGTH_MM:
        return Missed.TOO_SHORT
    line = _shaft_only(relative, imager, _ridge(relative, imager, segment))
    end, step = _tip(relative, imager, line)
    disagree = abs(float((segment.end - line.point) @ line.direction) - end)
    if step < LEAST_STEP or (step < SURE_STEP and disagree > ENDS_AGREE_MM):
        return Missed.NO_END
    depth = np.array(max(float(line.point[1]), 0.0))
    lateral, axial = imager.spread.lateral_sigma(depth), imager.spread.axial_sigma(depth)
    blur = float(np.hypot(lateral * line.direction[0], axial * line.direction[1]))  # along the line at its end
    tip = line.point + (end - tip_bias * blur) * line.direction
    if np.any(tip < EDGE_MM) or np.any(tip > np.array(imager.size_mm) - EDGE_MM):
        return Missed.TIP_AT_EDGE
    contrast = 20.0 * float(np.log10(max(1.0 + step, 1e-6)))
    return Detection(tip, line.direction, contrast, -line.start)


def over_background(image: Pixels, imager: Imager) -> Floats:
    """Amplitude over the mean amplitude of the background around, shape (rows, columns)."""
    size = int(BACKGROUND_MM / imager.pixel_mm) // COARSE | 1
    coarse = np.ascontiguousarray(image[::COARSE, ::COARSE])
    median = cv2.medianBlur(coarse, size).astype(np.float64)
    grey = cv2.resize(cv2.GaussianBlur(median, (0, 0), size / 8.0), image.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(imager.amplitude(image) / (MEAN_OVER_MEDIAN * imager.amplitude(grey)))


def _segment(relative: Floats, imager: Imager) -> Segment:
    clipped = np.minimum(relative, BRIGHTEST) - 1.0 - EXPECTED
    small = np.asarray(cv2.GaussianBlur(clipped, (0, 0), COARSE / 1.5)[::COARSE, ::COARSE], dtype=np.float64)
    right = np.arange(*INCLINATIONS, ANGLE_STEP, dtype=np.float64)
    segment = brightest_segment(small, np.concatenate([right, np.pi - right]))
    pixel = imager.pixel_mm * COARSE
    return Segment(segment.start * pixel, segment.end * pixel, segment.score * pixel)


class _Line(NamedTuple):
    """A line in the image, mm: s = 0 at its point, the deep end, growing toward the tip; s at the other end."""

    point: Floats
    direction: Floats
    start: float


def _samples(relative: Floats, imager: Imager, line: _Line, s: Floats, t: Floats) -> Floats:
    """Amplitude at s along and t across the line, shape (len(s), len(t)); 1 outside the image."""
    across = np.array([-line.direction[1], line.direction[0]])
    at = line.point + s[:, None, None] * line.direction + t[None, :, None] * across
    maps = (at / imager.pixel_mm).astype(np.float32)
    image = relative.astype(np.float32)
    sampled = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=1.0)
    return np.asarray(sampled, dtype=np.float64)


def _ridge(relative: Floats, imager: Imager, segment: Segment) -> _Line:
    """The line along the middle of the bright ridge: t = a + b s by weighted least squares."""
    length = float(np.linalg.norm(segment.end - segment.start))
    line = _Line(segment.end, (segment.end - segment.start) / length, -length)
    t, s = np.arange(-ACROSS_MM, ACROSS_MM + STEP_MM / 2.0, STEP_MM), np.arange(line.start, 0.0, STEP_MM)
    for window in WINDOWS_MM:
        bright = np.maximum(_samples(relative, imager, line, s, t) - 1.0 - EXPECTED, 0.0)
        bright = np.minimum(bright, 2.0 * np.median(bright.max(axis=1)) + 1e-9)
        weight = bright**2 * np.exp(-0.5 * (t / window) ** 2)  # squared: half the error of the angle (measured)
        total, across = weight.sum(axis=1), weight @ t
        moments = np.array([[total.sum(), total @ s], [total @ s, total @ s**2]])
        a, b = np.linalg.solve(moments + 1e-9 * np.eye(2), np.array([across.sum(), across @ s]))
        normal = np.array([-line.direction[1], line.direction[0]])
        direction = line.direction + b * normal
        line = _Line(line.point + a * normal, direction / np.linalg.norm(direction), line.start)
    return line


def _profile(relative: Floats, imager: Imager, line: _Line, s: Floats) -> Floats:
    t = np.arange(-RIDGE_MM / 2.0, RIDGE_MM / 2.0 + STEP_MM / 2.0, STEP_MM)
    return np.asarray(_samples(relative, imager, line, s, t).mean(axis=1))


def _shaft_only(relative: Floats, imager: Imager, line: _Line) -> _Line:
    """The line cut to the shaft: where the sum of what its greys exceed the least of a shaft by is largest.

    What one sample adds or takes is bounded, in logarithms: a bright bead is no more shaft than a faint one, and
    between two beads, or facets that mirror the beam away, there may be a gap of some mm.
    """
    s = np.arange(line.start, float(np.hypot(*imager.size_mm)), STEP_MM)
    profile = np.maximum(_profile(relative, imager, line, s), 1e-3)
    least = min(float(np.sqrt(max(np.percentile(profile[s < 0.0], SHAFT_PERCENTILE), 1.0))), SURE_SHAFT)
    gain = np.cumsum(np.clip(np.log(profile / least), -MOST_LOST, MOST_GAINED))
    before = np.concatenate([[0.0], gain[:-1]])
    end = int(np.argmax(gain - np.minimum.accumulate(before)))
    begin = int(np.argmin(before[: end + 1]))
    return _Line(line.point + s[end] * line.direction, line.direction, min(s[begin] - s[end], -STEP_MM))


def _tip(relative: Floats, imager: Imager, line: _Line) -> tuple[float, float]:
    """S of the shaft's end, and the amplitude's fall there: the last place half way to the background's.

    A blurred step passes its half at the step. Half way from the level of the shaft, or of its last piece where that is
    fainter.
    """
    s = np.arange(line.start, STEP_MM, STEP_MM)
    profile = _profile(relative, imager, line, s)
    end, shaft = 0.0, 0.0
    for _ in range(TIP_ROUNDS):
        last = (s > max(end - SHAFT_MM, line.start)) & (s < end - NEAR_TIP_MM)
        if not last.any():
            return end, 0.0
        shaft = float(np.median(profile[last]))
        half = 0.5 * (1.0 + min(shaft, float(profile[s > end - TIP_MM].max())))
        bright = np.flatnonzero(profile[:-1] > half)
        if not len(bright):
            return end, 0.0
        at = int(bright[-1])
        fall = max(profile[at] - profile[at + 1], 1e-9)
        end = float(s[at] + STEP_MM * np.clip((profile[at] - half) / fall, 0.0, 1.0))
    return end, shaft - 1.0
