"""One reading of the CT markers, compared with skin, couch and the robot's place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.checks.skin_fit import SkinFit, kept_skin_fit
from puncture_twin.planning.registration.checks.touching import place_excluded, untouchable
from puncture_twin.planning.registration.fits.least_squares import fit_rigid
from puncture_twin.planning.registration.registration import Registration

Signs = tuple[float, float, float]


class Surroundings(NamedTuple):
    """What markers are held against, CT frame."""

    skin: Skin
    couch: TriangleMesh | None
    """What lies beyond what the patient lies on, where the CT shows it."""


@dataclass(frozen=True, eq=False)
class MarkerList:
    """One reading of the CT markers.

    Attributes:
        fit: How it lies on the skin.
        behind: Rows of markers that no needle can have touched, and what is before each, in words.
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


def marker_list(
    case: Case,
    around: Surroundings,
    registration: Registration,
    signs: Signs = (1.0, 1.0, 1.0),
    cache: Cache = NO_CACHE,
) -> MarkerList:
    """The CT markers with some axes negated, compared with skin, couch and the robot's place."""
    points = registration.markers.points_ct * np.array(signs)
    fit = kept_skin_fit(points, around.skin, cache)
    T_base_ct = fit_rigid(points, registration.markers.points_base)
    moved = apply(T_base_ct, case.target_ct) - apply(registration.T_base_ct, case.target_ct)
    behind = untouchable(case, points, fit.normals_ct, around.couch)
    return MarkerList(fit, behind, place_excluded(case, around.skin.mesh, T_base_ct), float(np.linalg.norm(moved)))
