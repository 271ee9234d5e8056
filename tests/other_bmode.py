"""B-mode pictures by another construction than the twin's: pulses along beams, Hilbert's envelope, another display.

Nothing here is shared with `twin.plant.bmode_image`: scatterers are points anywhere (not one a pixel), a pulse is a
carrier under a Hann window and a beam a squared sinc (not Gaussians), the envelope is that of the analytic signal, the
needle has two walls, lumps and no bright tip, and the display is a power law or a logarithm of another range.
"""

import numpy as np
from scipy.signal import fftconvolve, hilbert

BEAM_MM, STEP_MM = 0.25, 0.03
"""Between beams, and between the samples of one."""


def power_law(amplitude):
    """Greys of amplitudes (mean speckle: 1) as their power, 0 to 255."""
    return 28.0 * amplitude**0.65


def logarithm(amplitude):
    """Greys of amplitudes over 50 dB."""
    return 255.0 * (1.0 + (20.0 * np.log10(np.maximum(amplitude, 1e-9)) - 28.0) / 50.0)


def picture(
    rng, tip_mm, direction, *, off_mm=0.0, size=(300, 250), pixel_mm=0.2, display=logarithm, needle=True, beaded=False
):
    """One picture, 8-bit grey.

    Args:
        off_mm: How far the needle lies off the plane; the slice is 1.1 mm thick at half its amplitude.
        beaded: Its echo is a row of beads on facets of unequal brightness, not one tube.
    """
    deep, wide = size[0] * pixel_mm, size[1] * pixel_mm
    shape = (round((deep + 4.0) / STEP_MM), round((wide + 4.0) / BEAM_MM))
    field = np.zeros(shape)
    count = rng.poisson(12.0 * (deep + 4.0) * (wide + 4.0))
    points = rng.uniform(0.0, 1.0, (count, 2)) * [deep + 4.0, wide + 4.0]
    _add(field, points, rng.normal(0.0, 1.0, count))
    speckle = np.abs(hilbert(fftconvolve(field, np.outer(_pulse(), _beam()), mode="same"), axis=0))
    echo = speckle / np.mean(speckle)
    if needle:
        echo = np.hypot(echo, _needle(rng, shape, np.asarray(tip_mm), np.asarray(direction), off_mm, beaded))
    rows, columns = np.arange(size[0]) * pixel_mm + 2.0, np.arange(size[1]) * pixel_mm + 2.0
    sampled = _interpolated(_interpolated(echo, rows / STEP_MM).T, columns / BEAM_MM).T
    return np.clip(np.round(display(sampled)), 0, 255).astype(np.uint8)


def _pulse():
    """Four periods of .3 mm under a Hann window."""
    at = np.arange(-0.6, 0.6 + STEP_MM / 2, STEP_MM)
    return np.cos(2 * np.pi * at / 0.3) * np.cos(np.pi * at / 1.25) ** 2


def _beam():
    """A squared sinc, two-way, first zeros at .9 mm."""
    return np.sinc(np.arange(-8, 9) * BEAM_MM / 0.9) ** 2


def _needle(rng, shape, tip_mm, direction, off_mm, beaded):
    """Amplitude of a tube: two walls .5 mm apart, each a Hann window wide, in lumps of 2 mm, cut off square."""
    depth, across = np.meshgrid(np.arange(shape[0]) * STEP_MM - 2.0, np.arange(shape[1]) * BEAM_MM - 2.0, indexing="ij")
    back = (tip_mm[0] - across) * direction[0] + (tip_mm[1] - depth) * direction[1]
    aside = (across - tip_mm[0]) * direction[1] - (depth - tip_mm[1]) * direction[0]
    if beaded:
        lumps = _beads(rng, back)
    else:
        lumps = 1.0 + 0.2 * np.interp(back, np.arange(-10.0, 90.0, 2.0), rng.normal(size=50))
    walls = sum(
        np.where(np.abs(aside + side) < 0.5, np.cos(np.pi * (aside + side)) ** 2, 0.0) for side in (-0.25, 0.25)
    )
    tube = walls * lumps * np.clip(back / 0.25 + 0.5, 0.0, 1.0)  # the beam's resolution at its end
    return 16.0 * np.exp(-0.5 * (off_mm / 0.47) ** 2) * tube


def _beads(rng, back):
    """Amplitude at distances behind the tip: beads 1 to 2.5 mm apart on a faint shaft, on facets of 4 mm."""
    edges = np.concatenate([[0.4], 0.4 + np.cumsum(rng.uniform(1.0, 2.5, 60))])
    nearest = np.clip(np.searchsorted(0.5 * (edges[1:] + edges[:-1]), back), 0, len(edges) - 1)
    bead = np.exp(-0.5 * ((back - edges[nearest]) / 0.3) ** 2) * np.exp(rng.normal(0.0, 0.4, len(edges)))[nearest]
    facets = np.exp(rng.normal(0.0, 0.4, 40))[np.clip((back / 4.0).astype(int), 0, 39)]
    return (0.2 + 1.1 * bead) * facets


def _add(field, points, strength):
    """Points (depth, across; mm) onto the grid, shared between the four nearest nodes."""
    x = points / [STEP_MM, BEAM_MM]
    low = np.floor(x).astype(int)
    part = x - low
    for i in (0, 1):
        for j in (0, 1):
            at = low + [i, j]
            inside = ((at >= 0) & (at < field.shape)).all(axis=1)
            weight = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1]) * strength
            np.add.at(field, tuple(at[inside].T), weight[inside])


def _interpolated(values, at):
    low = np.clip(np.floor(at).astype(int), 0, len(values) - 2)
    part = (at - low)[:, None]
    return (1 - part) * values[low] + part * values[low + 1]
