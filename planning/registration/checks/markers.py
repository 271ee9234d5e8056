"""Can the markers be trusted? What their residuals cannot show: permuted names, slipped axes, markers off the skin.

*Names* come from the user and are normally right; the danger is a slip. Permuted names that fit as well within the
noise leave no trace in the residuals, and skin and couch are blind to them: markers stay markers. Only the place where
the robot would stand can exclude a permutation; where it does not, the case is refused, or its user has checked the
names. *Axes*: coordinates of RAS read as LPS are turned by 180 degrees about z: a proper rotation, which the
registration swallows without a residual. But markers lie on the skin, and a needle's tip touched them. A list that does
so only after a half turn is refused; one that does so before and after it is named in a warning.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.registration.checks.places import box_keys, boxes_ct, place_excluded, untouchable
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.method import Renaming, renamings
from puncture_twin.planning.registration.registration import Registration

MARKER_ON_SKIN_MM = 30.0
"""Height of a skin marker: one whose centre is farther from the skin is on a frame, or is misread."""


@dataclass(frozen=True, eq=False)
class SkinFit:
    """Markers against the skin."""

    gaps_mm: Floats
    """Shape (n,), distance from the skin, negative inside the body (of an open skin that is not known)."""
    normals_ct: Floats  # shape (n, 3), unit vectors out of the skin at its nearest triangle

    @property
    def on_skin(self) -> bool:
        """Whether every marker is within its own height of the skin."""
        return bool(np.all(np.abs(self.gaps_mm) <= MARKER_ON_SKIN_MM))

    @property
    def scatter_mm(self) -> float:
        """Root mean square of what is left of the gaps by the best common height of the markers, n - 1 degrees."""
        height = np.clip(self.gaps_mm.mean(), 0.0, MARKER_ON_SKIN_MM)
        return float(np.sqrt(np.sum((self.gaps_mm - height) ** 2) / (len(self.gaps_mm) - 1)))


def skin_fit(points_ct: Floats, skin: Skin) -> SkinFit:
    """Measure markers from the skin; where the body was cut there is none; ``points_ct`` (n, 3), mm."""
    triangles = skin.mesh.triangles[~skin.cut_faces]
    centres = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - centres[:, None], axis=2).max()
    a, b, c = np.moveaxis(skin.mesh.triangles - skin.mesh.bounds.mean(axis=0), 1, 0)
    outward = 1.0 if np.einsum("ij,ij->", a, np.cross(b, c)) >= 0 else -1.0
    gaps, normals = np.empty(len(points_ct)), np.empty((len(points_ct), 3))
    for row, point in enumerate(points_ct):
        from_centres = np.linalg.norm(centres - point, axis=1)
        near = triangles[from_centres <= from_centres.min() + reach]  # holds the nearest one
        squares = squared_distance(point, near)
        inside = side_of(skin.mesh, point) is Side.INSIDE
        gaps[row] = np.sqrt(squares.min()) * (-1.0 if inside else 1.0)
        normals[row] = outward * _normal(near[int(np.argmin(squares))])
    return SkinFit(gaps, normals)


def _normal(triangle: Floats) -> Floats:
    normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
    length = np.linalg.norm(normal)
    return np.asarray(normal / length) if length > 0 else np.array([0.0, 0.0, 1.0])


Signs = tuple[float, float, float]


class Surroundings(NamedTuple):
    """Surfaces that markers are compared with, CT frame."""

    skin: Skin
    couch: TriangleMesh | None  # what lies beyond what the patient lies on, where the CT shows it


@dataclass(frozen=True, eq=False)
class MarkerList:
    """One reading of the CT markers."""

    fit: SkinFit
    behind: tuple[tuple[int, str], ...]
    """Rows of markers that no needle can have touched, and what is before each, in words."""
    excluded: str  # why the robot cannot stand where this list puts it, or empty
    target_mm: float  # how far this list puts the target from where the given one puts it

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
    """The CT markers with some axes negated, against skin (a fit that ``cache`` keeps), couch and robot's place."""
    points = registration.markers.points_ct * np.array(signs)
    skin, cut = around.skin, hashlib.sha256(around.skin.cut_faces.tobytes()).hexdigest()
    made_from = {"what": "skin fit", "skin": skin.mesh.digest, "cut": cut, "points": points.tolist()}
    fit = SkinFit(**cache.arrays(made_from, lambda: vars(skin_fit(points, skin)), by=__name__))
    T_base_ct = fit_rigid(points, registration.markers.points_base)
    moved = apply(T_base_ct, case.target_ct) - apply(registration.T_base_ct, case.target_ct)
    couch = None if around.couch is None else around.couch.digest
    key = (__name__, points.tobytes(), fit.normals_ct.tobytes(), couch, box_keys(boxes_ct(case)), case.needle.length_mm)
    find = partial(untouchable, case, points, fit.normals_ct, around.couch)
    behind = cache.memory.get(key, find, lambda found: 100 * len(found))
    return MarkerList(fit, behind, place_excluded(case, skin.mesh, T_base_ct), float(np.linalg.norm(moved)))


def check_names(case: Case, skin: Skin, registration: Registration) -> Iterator[Finding]:
    """Compare the names with their permutations; yields warnings.

    Raises InputError: Permuted names fit much better; or as well, nothing excludes them, and the case does not accept
    that.
    """
    test, where = registration.residual_test, f"{case.path}: registration"
    found, complete = renamings(registration.markers, case.target_ct, test.alike_mm)
    better = [one for one in found if test.contradicted_by(one.fre_mm)]
    given = f"as named, FRE is {test.fre_mm:.2f} mm"
    if better:
        what = f"the marker names look permuted: {min(better, key=lambda one: one.fre_mm).text()}; {given}"
        refuse(what, where, "the names in the order of the touches", "markers_permuted")
    excluded = [place_excluded(case, skin.mesh, one.T_base_ct) for one in found]
    possible = [one for one, why in zip(found, excluded, strict=True) if not why]
    stated = case.registration or case.robot.stated
    if possible and not (stated is not None and stated.accept_symmetry):
        what = f"swapped marker names would go unnoticed: {_worst(possible)}; {given}"
        allowed = (
            "markers without symmetry, the smallest known fle_mm, or registration.accept_symmetry = true after you "
            "checked the names at the patient"
        )
        refuse(what, where, allowed, "markers_ambiguous")
    if not complete:
        said = f"with {len(registration.markers)} markers, only swaps of two names were tested"
        yield Finding("names_not_all_tested", Severity.WARNING, said)
    if possible:
        said = f"marker names: {_worst(possible)}; accepted by accept_symmetry, {given}"
        yield Finding("marker_names_alike", Severity.WARNING, said)
    elif found:
        said = f"marker names: {_worst(found)}; excluded only because then {excluded[0]}"
        yield Finding("marker_names_alike", Severity.WARNING, said)


def _worst(found: Sequence[Renaming]) -> str:
    """The first, which puts the target farthest away, and how many more there are."""
    more = len(found) - 1
    return found[0].text() + (f" (and {plural(more, 'more permutation')})" if more else "")


HALF_TURNS: Mapping[str, Signs] = {
    "x and y negated, as LPS and RAS differ,": (-1.0, -1.0, 1.0),
    "y and z negated": (1.0, -1.0, -1.0),
    "x and z negated": (-1.0, 1.0, -1.0),
}
"""The slips of axes that are proper rotations; a list with one or three axes negated is refused as mirrored."""

REFUSING_LEVEL = 0.01
"""Significance level at which a list is refused; honest lists are less often: on a symmetric body both are alike."""
SCATTER_MM = 0.25
"""No skin is known better: a third of a millimetre's voxel, and the marker's own reading."""
USUAL_SCATTER_MM = 3.0
"""Markers of one kind on the skin of their own CT scatter less."""
EXCLUDING_LEVEL = 0.001
"""Significance level at which a half turn is excluded, and no more mentioned."""


def check_axes(
    case: Case, around: Surroundings, registration: Registration, given: MarkerList, cache: Cache = NO_CACHE
) -> Iterator[Finding]:
    """Compare the given list with its half turns; yields warnings."""
    slips = {name: marker_list(case, around, registration, signs, cache) for name, signs in HALF_TURNS.items()}
    likely = {}  # the given list is the other one, slipped: off the skin, or on it where no needle touches it
    for name, slip in slips.items():
        hidden = bool(given.behind) and not _worse(slip.fit, given.fit, level=REFUSING_LEVEL)
        if slip.plausible and (hidden or _worse(given.fit, slip.fit, level=REFUSING_LEVEL)):
            likely[name] = slip
    if likely:
        best = min(likely.values(), key=lambda slip: slip.fit.scatter_mm)
        alike = {name: one for name, one in likely.items() if not _excluded(one, best)}
        fits = ", or ".join(
            f"with {name} they lie on the skin to {one.fit.scatter_mm:.1f} mm (rms)" for name, one in alike.items()
        )
        as_given = f"to {given.fit.scatter_mm:.1f} mm"
        if not _worse(given.fit, best.fit, level=REFUSING_LEVEL):
            row, before = given.behind[0]
            as_given = f"{registration.markers.names[row]} lies behind {before}, where no needle can touch it"
        refuse(
            f"markers_ct look like coordinates of other axes: {fits}, as given {as_given}",
            f"{case.path}: registration",
            "markers_ct in the axes (LPS, RAS) that the case or their file states",
            "other_axes",
        )
    for name, slip in slips.items():
        if not _excluded(slip, given):
            said = (
                f"markers_ct with {name} would lie on the skin to {slip.fit.scatter_mm:.1f} mm rms, as given to "
                f"{given.fit.scatter_mm:.1f} mm: too similar to decide, and the target would be {slip.target_mm:.0f} "
                "mm away; check the axes of their file"
            )
            yield Finding("marker_axes_alike", Severity.WARNING, said, {"target_mm": slip.target_mm})


def _excluded(slip: MarkerList, given: MarkerList) -> bool:
    """Whether a list is implausible, or so much farther off the skin than the given one that it is not meant."""
    unusual = slip.fit.scatter_mm > USUAL_SCATTER_MM >= given.fit.scatter_mm
    return unusual or not slip.plausible or _worse(slip.fit, given.fit, level=EXCLUDING_LEVEL)


def _worse(fit: SkinFit, other: SkinFit, *, level: float) -> bool:
    """Whether the same markers scatter more in one list than in another beyond chance, by an F-test."""
    freedom = len(fit.gaps_mm) - 1
    limit = float(np.sqrt(fdtri(freedom, freedom, 1 - level)))
    return fit.scatter_mm > limit * max(other.scatter_mm, SCATTER_MM)


def off_the_skin(registration: Registration, given: MarkerList) -> Iterator[Finding]:
    """Markers far from the skin, or behind an obstacle: warnings."""
    names = registration.markers.names
    gaps = zip(names, np.abs(given.fit.gaps_mm), strict=True)
    far = [f"{name} ({gap:.0f} mm)" for name, gap in gaps if gap > MARKER_ON_SKIN_MM]
    if far:
        said = f"markers far from the skin: {', '.join(far)}; is their file in the case's space (LPS/RAS) and unit?"
        yield Finding("markers_off_skin", Severity.WARNING, said)
    for row, before in given.behind:
        said = f"marker {names[row]} lies behind {before}: no needle can touch it there"
        yield Finding("marker_behind", Severity.WARNING, said, {"marker": names[row]})


LOCAL_AXES = Finding(
    "axes_not_checked",
    Severity.NOTE,
    'space "local": a 180 degree rotation of the axes of markers_ct cannot be detected',
)
BASE_AXES = Finding(
    "axes_not_checked",
    Severity.NOTE,
    "not checked: a 180 degree rotation of markers_base (such as ROS base_link instead of the controller's base); "
    "residuals, skin and couch cannot show it",
)


def check_markers(
    case: Case, around: Surroundings, registration: Registration, cache: Cache = NO_CACHE
) -> Iterator[Finding]:
    """Check a registration's markers against permuted names, half turns, skin and couch.

    Yields warnings of what these markers leave open, and notes of what no markers can show.

    Raises InputError: Names as of `check_names`, or a list that lies on the skin only after a half turn.
    """
    yield from check_names(case, around.skin, registration)
    given = marker_list(case, around, registration, cache=cache)
    local = case.space is Space.LOCAL
    if not local:
        yield from check_axes(case, around, registration, given, cache)
    yield from off_the_skin(registration, given)
    yield from (LOCAL_AXES, BASE_AXES) if local else (BASE_AXES,)
