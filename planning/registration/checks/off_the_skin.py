"""Markers far from the skin, or behind an obstacle."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.registration.checks.marker_list import MarkerList
from puncture_twin.planning.registration.checks.skin_fit import MARKER_ON_SKIN_MM
from puncture_twin.planning.registration.registration import Registration


def off_the_skin(registration: Registration, given: MarkerList) -> tuple[str, ...]:
    """Warnings, one sentence each."""
    names = registration.markers.names
    gaps = zip(names, np.abs(given.fit.gaps_mm), strict=True)
    far = [f"{name} ({gap:.0f} mm)" for name, gap in gaps if gap > MARKER_ON_SKIN_MM]
    behind = tuple(
        f"marker {names[row]} lies behind {before}: no needle can touch it there" for row, before in given.behind
    )
    if not far:
        return behind
    said = f"markers far from the skin: {', '.join(far)}; is their file in the case's space (LPS/RAS) and unit?"
    return (said, *behind)
