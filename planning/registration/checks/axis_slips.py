"""Have the axes of the CT markers slipped by a half turn? The skin and the couch show it, the residuals cannot.

Coordinates of RAS read as LPS are turned by 180 degrees about z: a proper rotation, which the registration swallows
without a residual. But markers lie on the skin, and a needle's tip touched them. A list that does so only after a half
turn is refused; one that does so before and after it is named in a warning.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from scipy.special import fdtri

from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.registration.checks.marker_list import MarkerList, Signs, Surroundings, marker_list
from puncture_twin.planning.registration.checks.skin_fit import SkinFit
from puncture_twin.planning.registration.registration import Registration

HALF_TURNS: Mapping[str, Signs] = MappingProxyType(
    {
        "x and y negated, as LPS and RAS differ,": (-1.0, -1.0, 1.0),
        "y and z negated": (1.0, -1.0, -1.0),
        "x and z negated": (-1.0, 1.0, -1.0),
    }
)
"""The slips of axes that are proper rotations; a list with one or three axes negated is refused as mirrored."""

REFUSING_DOUBT = 0.01
"""A list is refused at 99 %. Honest lists less often: the more symmetric a body, the more alike are both lists."""

SCATTER_MM = 0.25
"""No skin is known better: a third of a millimetre's voxel, and the marker's own reading."""

USUAL_SCATTER_MM = 3.0
"""Markers of one kind on the skin of their own CT scatter less."""

EXCLUDING_DOUBT = 0.001
"""A half turn is no more mentioned at 99.9 %."""


def check_axes(
    case: Case, around: Surroundings, registration: Registration, given: MarkerList, cache: Cache = NO_CACHE
) -> tuple[str, ...]:
    """Compare the given list with its half turns; returns warnings, one sentence each.

    Raises:
        InputError: The list lies on the skin, or where it can be touched, only after a half turn.
    """
    slips = {name: marker_list(case, around, registration, signs, cache) for name, signs in HALF_TURNS.items()}
    likely = {name: slip for name, slip in slips.items() if _explains(slip, given)}
    if likely:
        best = min(likely.values(), key=lambda slip: slip.fit.scatter_mm)
        alike = {name: one for name, one in likely.items() if not _excluded(one, best)}
        fits = ", or ".join(
            f"with {name} they lie on the skin to {one.fit.scatter_mm:.1f} mm (rms)" for name, one in alike.items()
        )
        raise InputError(
            f"markers_ct look like coordinates of other axes: {fits}, as given {_as_given(registration, given, best)}",
            where=f"{case.path}: registration",
            allowed="markers_ct in the axes (LPS, RAS) that the case or their file states",
        )
    return tuple(
        f"markers_ct with {name} would lie on the skin to {slip.fit.scatter_mm:.1f} mm rms, as given to "
        f"{given.fit.scatter_mm:.1f} mm: too alike to tell, and the target would be {slip.target_mm:.0f} mm away; "
        "check the axes of their file"
        for name, slip in slips.items()
        if not _excluded(slip, given)
    )


def _explains(slip: MarkerList, given: MarkerList) -> bool:
    """Whether the given list is likely the other one, slipped: off the skin, or on it where no needle touches it."""
    if not slip.plausible:
        return False
    hidden = bool(given.behind) and not _worse(slip.fit, given.fit, doubt=REFUSING_DOUBT)
    return hidden or _worse(given.fit, slip.fit, doubt=REFUSING_DOUBT)


def _excluded(slip: MarkerList, given: MarkerList) -> bool:
    """Whether a list is implausible, or so much farther off the skin than the given one that it is not meant."""
    unusual = slip.fit.scatter_mm > USUAL_SCATTER_MM >= given.fit.scatter_mm
    return unusual or not slip.plausible or _worse(slip.fit, given.fit, doubt=EXCLUDING_DOUBT)


def _worse(fit: SkinFit, other: SkinFit, *, doubt: float) -> bool:
    """Whether the same markers scatter more in one list than in another beyond chance, by an F-test.

    Args:
        fit: Of one list.
        other: Of the same markers, read in other axes.
        doubt: How often two lists of one scatter would seem so different.
    """
    freedom = len(fit.gaps_mm) - 1
    limit = float(np.sqrt(fdtri(freedom, freedom, 1 - doubt)))
    return fit.scatter_mm > limit * max(other.scatter_mm, SCATTER_MM)


def _as_given(registration: Registration, given: MarkerList, slip: MarkerList) -> str:
    if _worse(given.fit, slip.fit, doubt=REFUSING_DOUBT):
        return f"to {given.fit.scatter_mm:.1f} mm"
    row, before = given.behind[0]
    return f"{registration.markers.names[row]} lies behind {before}, where no needle touches it"
