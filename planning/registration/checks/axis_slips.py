"""Have the axes of the CT markers slipped by a half turn? The skin and the couch show it, the residuals cannot.

Coordinates of RAS read as LPS are turned by 180 degrees about z: a proper rotation, which the registration swallows
without a residual. But markers lie on the skin, and a needle's tip touched them. A list that does so only after a half
turn is refused; one that does so before and after it is named in a warning.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.checks.skin_fit import SkinFit, kept_skin_fit
from puncture_twin.planning.registration.checks.touching import place_excluded, untouchable
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.registration import Registration

Signs = tuple[float, float, float]

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

EXCLUDING_DOUBT = 0.001
"""A half turn is no more mentioned at 99.9 %."""


@dataclass(frozen=True, eq=False)
class MarkerList:
    """One reading of the CT markers.

    Attributes:
        fit: How it lies on the skin.
        behind: Rows of markers that no needle can have touched, and the obstacle that is before each.
        excluded: Why the robot cannot stand where this list puts it, or empty.
        target_mm: How far this list puts the target from where the given one puts it.
    """

    fit: SkinFit
    behind: tuple[tuple[int, str], ...]
    excluded: str
    target_mm: float

    @property
    def plausible(self) -> bool:
        """Whether every marker is near the skin, was within a needle's reach, and the robot can stand there."""
        return self.fit.on_skin and not self.behind and not self.excluded

    def explains(self, given: MarkerList) -> bool:
        """Whether the given list is likely this one, slipped."""
        return self.plausible and (given.fit.worse_than(self.fit, doubt=REFUSING_DOUBT) or bool(given.behind))

    def excluded_by(self, given: MarkerList) -> bool:
        """Whether this list is implausible, or so much farther off the skin than the given one that it is not meant."""
        worse = self.fit.worse_than(given.fit, doubt=EXCLUDING_DOUBT) or self.fit.unusual_beside(given.fit)
        return worse or not self.plausible


def marker_list(
    case: Case,
    skin: Skin,
    registration: Registration,
    signs: Signs = (1.0, 1.0, 1.0),
    cache: Cache = NO_CACHE,
) -> MarkerList:
    """The CT markers with some axes negated, compared with skin, couch and the robot's place."""
    points = registration.markers.points_ct * np.array(signs)
    fit = kept_skin_fit(points, skin, cache)
    T_base_ct = fit_rigid(points, registration.markers.points_base)
    moved = apply(T_base_ct, case.target_ct) - apply(registration.T_base_ct, case.target_ct)
    behind = untouchable(case, points, fit.normals_ct)
    return MarkerList(fit, behind, place_excluded(case, skin.mesh, T_base_ct), float(np.linalg.norm(moved)))


def check_axes(
    case: Case, skin: Skin, registration: Registration, given: MarkerList, cache: Cache = NO_CACHE
) -> tuple[str, ...]:
    """Hold the given list against its half turns; returns warnings, one sentence each.

    Raises:
        InputError: The list lies on the skin, or where it can be touched, only after a half turn.
    """
    slips = {name: marker_list(case, skin, registration, signs, cache) for name, signs in HALF_TURNS.items()}
    likely = {name: slip for name, slip in slips.items() if slip.explains(given)}
    if likely:
        name = min(likely, key=lambda name: likely[name].fit.scatter_mm)
        raise InputError(
            f"markers_ct look like coordinates of other axes: with {name} they lie on the skin to "
            f"{likely[name].fit.scatter_mm:.1f} mm (rms), as given {_as_given(registration, given, likely[name])}",
            where=f"{case.path}: registration",
            allowed="markers_ct in the axes (LPS, RAS) that the case or their file states",
        )
    return tuple(
        f"markers_ct with {name} would lie on the skin to {slip.fit.scatter_mm:.1f} mm rms, as given to "
        f"{given.fit.scatter_mm:.1f} mm: too alike to tell, and the target would be {slip.target_mm:.0f} mm away; "
        "check the axes of their file"
        for name, slip in slips.items()
        if not slip.excluded_by(given)
    )


def _as_given(registration: Registration, given: MarkerList, slip: MarkerList) -> str:
    if given.fit.worse_than(slip.fit, doubt=REFUSING_DOUBT):
        return f"to {given.fit.scatter_mm:.1f} mm"
    row, obstacle = given.behind[0]
    return f"{registration.markers.names[row]} lies behind obstacle '{obstacle}', where no needle touches it"
