"""How Hounsfield units become grey: the windows that radiologists use, and one scale of bytes that holds them all."""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats


class Tone(NamedTuple):
    """A window of Hounsfield units: its middle is grey, its ends are black and white."""

    level: float
    width: float

    def grey(self, hu: Floats) -> NDArray[np.uint8]:
        """Grey values of Hounsfield units; where the image ends (NaN) black."""
        fraction = (np.nan_to_num(hu, nan=-1e6) - self.level) / self.width + 0.5
        return np.round(255 * np.clip(fraction, 0.0, 1.0)).astype(np.uint8)


TONES = MappingProxyType(
    {"abdomen": Tone(40, 400), "lung": Tone(-600, 1500), "bone": Tone(400, 1800), "brain": Tone(40, 80)}
)
"""As on the consoles of scanners."""

KNOTS_HU = (-1350.0, -160.0, 0.0, 80.0, 240.0, 1300.0)
KNOTS_BYTE = (0.0, 48.0, 96.0, 152.0, 208.0, 255.0)
"""Bytes of a picture that holds every window: most of them lie where soft tissue differs, below one HU and a half a
byte there."""


def stored(hu: Floats) -> NDArray[np.uint8]:
    """Bytes of Hounsfield units, from which a page makes any window."""
    return np.round(np.interp(np.nan_to_num(hu, nan=KNOTS_HU[0]), KNOTS_HU, KNOTS_BYTE)).astype(np.uint8)


def table(tone: Tone) -> list[float]:
    """What a page shows, 0..1, for each of the bytes 0..255 of `stored`."""
    hu = np.interp(np.arange(256.0), KNOTS_BYTE, KNOTS_HU)
    return [round(float(value) / 255, 3) for value in tone.grey(hu)]
