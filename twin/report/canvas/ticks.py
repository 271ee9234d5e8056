"""Round numbers along an axis."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats

ROUND = (1.0, 2.0, 5.0, 10.0)


def ticks(low: float, high: float, most: int) -> Floats:
    """The multiples of 1, 2 or 5 times a power of ten in low..high: as many as fit, ``most`` steps at most."""
    rough = (high - low) / most
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * factor for factor in ROUND if power * factor >= rough * (1 - 1e-9))
    first, last = round(np.ceil(low / step - 1e-9)), round(np.floor(high / step + 1e-9))
    return np.asarray(step * np.arange(first, last + 1))
