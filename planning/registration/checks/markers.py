"""Errors of markers that residuals cannot show: permuted names, slipped axes, markers off the skin, an impossible base.

*Names* come from the user and are normally right; the danger is a slip. Permuted names that fit as well within the
noise leave no trace in the residuals, and skin and couch are blind to them: markers stay markers. Only the place where
the robot would stand can exclude a permutation; where it does not, the case is refused, or its user has checked the
names. *Axes*: coordinates of RAS read as LPS are turned by 180 degrees about z: a proper rotation, which the
registration swallows without a residual. But markers lie on the skin, and a needle's tip touched them. A list that does
so only after a half turn is refused; one that does so before and after it is named in a warning. *The place of the
base*, however it is stated: nothing stands in a patient, and a patient lies in no box of the robot's frame, but on one.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import fcl
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, NO_MEMORY, Cache, Memory
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.case.case import Case, up_axis
from puncture_twin.planning.case.settings import Obstacle
from puncture_twin.planning.collision.bodies import surface, touch
from puncture_twin.planning.geometry.containment import Side, crossings, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.marker_pairs import Renaming, renamings
from puncture_twin.planning.registration.registration import Registration

ALLOWANCE_MM = 30.0
"""A mattress gives way and a box is measured by hand: so deep a patient may lie in one, or to its middle."""
THIN = 0.05
"""Least fraction of a box's half size that is left of it, so that a patient who goes through a thin one is seen."""
REST_MM = 100.0
"""Mattress and cushions between a table and the patient on it."""
FAR_MM = 400.0
"""What lies farther below is a floor, what lies farther above a ceiling."""


def in_box(case: Case, skin: TriangleMesh, T_base_ct: Floats) -> str:
    """The obstacle of frame ``base`` in which the patient would lie deeper than `ALLOWANCE_MM`; empty for none.

    FCL is asked whether the skin (CT frame) touches what is left of the box without the allowance, and a point whether
    the whole box lies in the patient. T_base_ct: shape (4, 4), mm.
    """
    points_base = apply(T_base_ct, skin.vertices)
    for box in _boxes(case, "base"):
        half = box.size_mm / 2
        core = np.maximum(half - ALLOWANCE_MM, THIN * half)
        local = points_base - box.center_mm
        corners = local[skin.faces]
        near = np.all((corners.min(axis=1) <= core) & (corners.max(axis=1) >= -core), axis=1)
        if near.any():
            part = fcl.CollisionObject(surface(TriangleMesh(local, skin.faces[near])))
            if touch(part, fcl.CollisionObject(fcl.Box(*(2 * core)))):
                return box.name
        if side_of(skin, apply(np.linalg.inv(T_base_ct), box.center_mm)) is Side.INSIDE:
            return box.name
    return ""


def lying(case: Case, skin: TriangleMesh, T_base_ct: Floats) -> tuple[str, str]:
    """How the patient lies to the boxes of the robot's frame, by the skin's vertices; arguments as of `in_box`.

    The obstacle under the patient, no farther away than `REST_MM`, or empty; and where they lie on none, that an
    obstacle is below or above them, with its distance, or empty. Up is the axis of the robot's frame that is nearest to
    it, within 45 degrees: an arm may stand, hang or reach out of a wall.
    """
    up = up_base(case, T_base_ct)
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) < np.cos(np.pi / 4):
        return "", ""
    points, level, off = apply(T_base_ct, skin.vertices), np.arange(3) != axis, ""
    for box in _boxes(case, "base"):
        away, half = points - box.center_mm, box.size_mm / 2
        height = np.sign(up[axis]) * away[np.all(np.abs(away[:, level]) <= half[level], axis=1), axis]
        if not len(height):
            continue
        over, under = height.min() - half[axis], -half[axis] - height.max()
        if -ALLOWANCE_MM <= over <= REST_MM:
            return box.name, ""
        if REST_MM < over <= FAR_MM:
            off = f"the patient would float {over:.0f} mm above obstacle '{box.name}'"
        elif 0.0 <= under <= FAR_MM:
            off = f"the patient would lie {under:.0f} mm under obstacle '{box.name}'"
    return "", off


def up_base(case: Case, T_base_ct: Floats) -> Floats:
    """Up in the base frame, shape (3,), unit, as the case states it or a patient usually lies."""
    up = np.asarray(up_axis(case))
    return np.asarray(T_base_ct[:3, :3] @ (up / np.linalg.norm(up)))


def _boxes(case: Case, frame: str) -> tuple[Obstacle, ...]:
    return tuple(box for box in case.obstacles if box.frame == frame)


SKIN_POINTS = 2000
"""Places of the skin that are tried for a marker."""
CONE = np.radians(60.0)
"""A marker is touched from within this angle of the skin's outward normal."""
CONE_DIRECTIONS = 100
"""Tried in that cone: one every 10 degrees."""


def place_excluded(case: Case, skin: TriangleMesh, T_base_ct: Floats) -> str:
    """Why the arm cannot stand where a registration puts it, in words; empty where it can; arguments as of `in_box`.

    Its base or shoulder lies in the patient or in a box of the CT frame, or the target is farther from the shoulder
    than links and needle span.
    """
    column = _column_ct(case, T_base_ct)
    if base_in_patient(case, skin, T_base_ct):
        return "the robot's base would be in the patient"
    for box in boxes_ct(case):
        if any(np.all(np.abs(point - box.center_mm) <= box.size_mm / 2) for point in column):
            return f"the robot's base would be in obstacle '{box.name}'"
    return "the target would be out of the arm's reach" if out_of_reach(case, T_base_ct) else ""


def base_in_patient(case: Case, skin: TriangleMesh, T_base_ct: Floats) -> bool:
    """Whether base or shoulder lie in the patient; arguments as of `place_excluded`."""
    return any(side_of(skin, point) is Side.INSIDE for point in _column_ct(case, T_base_ct))


def out_of_reach(case: Case, T_base_ct: Floats) -> bool:
    """Whether the target is farther from the shoulder than links and needle span."""
    model = case.robot.model
    span = abs(model.a2) + abs(model.a3) + model.d4 + model.d5 + model.d6 + case.needle.length_mm
    return bool(np.linalg.norm(case.target_ct - _column_ct(case, T_base_ct)[1]) > span)


def _column_ct(case: Case, T_base_ct: Floats) -> Floats:
    """The base's origin and the shoulder, shape (2, 3), CT frame."""
    return apply(np.linalg.inv(T_base_ct), np.stack([np.zeros(3), case.robot.model.shoulder_base]))


COUCH = "the couch that the CT shows"


def untouchable(
    case: Case, points_ct: Floats, normals_ct: Floats, couch: TriangleMesh | None = None
) -> tuple[tuple[int, str], ...]:
    """Which points (n, 3), mm, with unit normals (n, 3) out of the skin no needle can have touched from any side.

    A box of the CT frame is before them, or the couch: what lies beyond what the patient lies on, closed, or None. By
    row, in words what is before it.
    """
    boxes, length = boxes_ct(case), case.needle.length_mm
    if (not boxes and couch is None) or not len(points_ct):
        return ()
    directions = _cones(normals_ct)
    blocks = {f"obstacle '{box.name}'": _intersects(box, points_ct[:, None], directions, length) for box in boxes}
    if couch is not None:
        blocks[COUCH] = _crosses(couch, points_ct, directions, length)
    blocked, names = np.stack([*blocks.values()]), [*blocks]
    before_most = blocked.sum(axis=2).argmax(axis=0)
    rows = np.flatnonzero(np.all(np.any(blocked, axis=0), axis=1))
    return tuple((int(row), names[before_most[row]]) for row in rows)


def _crosses(mesh: TriangleMesh, points: Floats, directions: Floats, length_mm: float) -> NDArray[np.bool_]:
    """Which segments from points (n, 3) along directions (n, k, 3) cross a surface, shape (n, k)."""
    low, high, crossed = mesh.triangles.min(axis=1), mesh.triangles.max(axis=1), []
    for point, some in zip(points, directions, strict=True):
        gap = np.maximum(np.maximum(low - point, point - high), 0.0)
        near = TriangleMesh(mesh.vertices, mesh.faces[np.linalg.norm(gap, axis=1) <= length_mm])
        crossed.append(crossings(near, point, some, length_mm).count > 0)
    return np.stack(crossed)


def touchable_points(case: Case, skin: TriangleMesh, T_base_ct: Floats) -> Floats:
    """Where on the skin a marker could sit and be touched straight: no box before it, within reach, shape (n, 3), mm.

    Arguments as of `in_box`.
    """
    a, b, c = np.moveaxis(skin.triangles[:: max(1, len(skin.triangles) // SKIN_POINTS)], 1, 0)
    normals = np.cross(b - a, c - a) * np.copysign(1.0, skin.volume)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    points, model, length = (a + b + c) / 3, case.robot.model, case.needle.length_mm
    poses = flange_poses(apply(T_base_ct, points), normals @ T_base_ct[:3, :3].T, length)
    reached = ~np.isnan(inverse(model, poses)).all(axis=(1, 2))
    blocked = {row for row, _ in untouchable(case, points, normals)}
    return points[[row for row in np.flatnonzero(reached) if row not in blocked]]


def boxes_ct(case: Case) -> tuple[Obstacle, ...]:
    """The obstacles of the CT frame."""
    return _boxes(case, "ct")


def box_keys(boxes: tuple[Obstacle, ...]) -> tuple[tuple[str, bytes, bytes], ...]:
    """Key of boxes in a cache: names, centres, sizes."""
    return tuple((box.name, box.center_mm.tobytes(), box.size_mm.tobytes()) for box in boxes)


def _cones(axes: Floats) -> Floats:
    """Unit vectors within `CONE` of each axis (n, 3), evenly spread (Fibonacci), the axis first, shape (n, k, 3)."""
    number = np.arange(CONE_DIRECTIONS)
    z = 1 - (1 - np.cos(CONE)) * number / (CONE_DIRECTIONS - 1)
    angle = number * np.pi * (3 - np.sqrt(5))
    local = np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    across = np.cross(axes, np.eye(3)[np.argmin(np.abs(axes), axis=1)])
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(local @ np.stack([across, np.cross(axes, across), axes], axis=1))


def _intersects(box: Obstacle, points: Floats, directions: Floats, length_mm: float) -> NDArray[np.bool_]:
    """Which segments from points (..., 3) along unit vectors (..., 3) intersect a box (slabs)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # along a slab: from -inf to inf, or nowhere
        one, other = ((box.center_mm + side * box.size_mm / 2 - points) / directions for side in (-1.0, 1.0))
    into, out = np.fmin(one, other).max(axis=-1), np.fmax(one, other).min(axis=-1)
    return np.asarray((into <= out) & (out >= 0) & (into <= length_mm))


OF_MOUNT = (
    "robot.mount: {what}; the usual causes are other axes, another origin or another unit than the case's, or the "
    "axes of another robot"
)
OF_MARKERS = (
    "registration: by the markers {what}; the usual causes are touches in other axes than the base's (a URDF's "
    "base_link is rotated by 180 degrees), or lists of another patient or robot"
)


class BasePlace(NamedTuple):
    """Arguments for and against a position of the base."""

    impossible: str  # why nothing can be so, or empty
    unlikely: str  # what hardly is so, or empty
    rests_on: str  # the obstacle of frame ``base`` that the patient lies on, or empty


def base_place(case: Case, skin: TriangleMesh, T_base_ct: Floats, memory: Memory = NO_MEMORY) -> BasePlace:
    """Check a position of the base, as of `in_box`; ``memory`` keeps how the skin lies to the boxes."""

    def lies() -> tuple[str, str, str]:
        return in_box(case, skin, T_base_ct), *lying(case, skin, T_base_ct)

    placed = up_base(case, T_base_ct).tobytes(), np.ascontiguousarray(T_base_ct).tobytes()
    box, bed, off = memory.get((__name__, skin.digest, *placed, box_keys(_boxes(case, "base"))), lies, lambda _: 1000)
    impossible = ""
    if base_in_patient(case, skin, T_base_ct):
        impossible = "the robot's base would be in the patient"
    elif box:
        impossible = f"the patient would lie more than {ALLOWANCE_MM:g} mm deep in obstacle '{box}' or through it"
    far = "the target would be out of the arm's reach" if out_of_reach(case, T_base_ct) else ""
    at, shoulder = _column_ct(case, T_base_ct)[1], ""
    for one in boxes_ct(case):  # a base on top of one is in none
        if not shoulder and np.all(np.abs(at - one.center_mm) < one.size_mm / 2):
            shoulder = f"the robot's shoulder would be in obstacle '{one.name}'"
    return BasePlace(impossible, " and ".join(filter(None, (far, shoulder, off))), bed)


def place_warnings(
    case: Case, skin: TriangleMesh, T_base_ct: Floats, text: str, memory: Memory = NO_MEMORY
) -> Iterator[Finding]:
    """One warning where something speaks against the place of a mount or of markers; arguments as of `in_box`.

    They say in words where the base is, and have no other reading that could be meant, so they are not refused: without
    an arm the verdicts are about the organs alone, and with one nothing is reached from there.
    """
    place = base_place(case, skin, T_base_ct, memory)
    if what := place.impossible or place.unlikely:
        yield Finding("base_place", Severity.WARNING, text.format(what=what))


MARKER_ON_SKIN_MM = 30.0
"""Height of a skin marker: one whose centre is farther from the skin is on a frame, or is misread."""


@dataclass(frozen=True, eq=False)
class SkinFit:
    """Distances of markers from the skin, and the skin's normals there."""

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
    permuted, complete = renamings(registration.markers, case.target_ct, test.alike_mm)
    better = [one for one in permuted if test.contradicted_by(one.fre_mm)]
    given = f"as named, FRE is {test.fre_mm:.2f} mm"
    if better:
        what = f"the marker names look permuted: {min(better, key=lambda one: one.fre_mm).text()}; {given}"
        refuse(what, where, "the names in the order of the touches", "markers_permuted")
    excluded = [place_excluded(case, skin.mesh, one.T_base_ct) for one in permuted]
    possible = [one for one, why in zip(permuted, excluded, strict=True) if not why]
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
    elif permuted:
        said = f"marker names: {_worst(permuted)}; excluded only because then {excluded[0]}"
        yield Finding("marker_names_alike", Severity.WARNING, said)


def _worst(permuted: Sequence[Renaming]) -> str:
    """Text of the permutation that puts the target farthest away, and how many more there are."""
    more = len(permuted) - 1
    return permuted[0].text() + (f" (and {plural(more, 'more permutation')})" if more else "")


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
