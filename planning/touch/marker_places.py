"""Where to put markers on a new patient: places on the skin that leave the least expected error at the target.

With markers i at p_i, read and touched with covariance C, and A_i = [I, -[p_i - t]x] about the target t, the registered
pose is off at the target by the covariance

    (sum_i A_i' C^-1 A_i)^-1,   of which the first three axes are the shift,

so that places far apart and all round the target are best. Places are exchanged, one at a time, until none is better;
those are passed over that lie in or near an entry window, at an arm or under one, on an edge, that no needle can touch,
or whose names could be swapped without a trace, also where a person puts each a few mm off. Where too few are left the
distances that are wanted shrink, and what is not met is said.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.distance import pdist

from puncture_twin.planning.anatomy.anatomy import ATTACHED_LIMB, OUTSIDE_BODY, Anatomy
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.case.case import Case, up_axis
from puncture_twin.planning.geometry.containment import crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space, point_text
from puncture_twin.planning.registration.checks.markers import untouchable
from puncture_twin.planning.registration.fits import design
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS, MarkerPairs, renamings
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.touch_planner import MOST_MARKERS, PLANNED_PADDING_MM, approach_checkers
from puncture_twin.planning.touch.tour_motions import why_not
from puncture_twin.planning.uncertainty.pose_error import touch_candidates

DRAWN, PLACES, BETWEEN_PLACES_MM = 12_000, 300, 9.0
"""Places of the skin that are drawn and that are tried, and the least distance between two of these."""
FAR_MM = 150.0
"""Greatest distance from the target: farther away the skin moves on its own, and an arm does not reach both."""
APART_MM = 35.0
"""Least distance between two markers."""
WINDOW_MM = 25.0
"""Least distance from an entry of a safe direction: half a drape's hole, and a finger."""
END_MM = 15.0
"""Least distance from where the image ends, and from what lies on the skin or is no trunk: arms, the table."""
RELAXED = ((1.0, 1.0), (0.5, 1.0), (0.2, 1.0), (0.5, 2.0), (0.2, 5.0))
"""Times what is wanted from windows and between places, and times the farthest from the target: one pair after the
other, until there are places."""
FLAT = 0.97
"""Length of the mean of the skin's normals about a place: a marker does not stick to an edge."""
LEAST_UP = 0.1
"""Cosine between the skin's normal and up: a marker below is not seen from where an arm stands."""
SLIP_MM = 6.0
"""A set of names swapped must not fit to so much (rms): a person puts a marker some mm off."""
STARTS, SWEEPS, SEED = 16, 6, 37
TRIES = 80
"""The best places that are looked at for one marker in a sweep."""
POSES = 8
"""Touches of one place that are tried."""
LEAST_KNOWN = 1e-9
"""Least over greatest information: markers on a line leave a rotation free."""
FLE_MM = 1.0
"""Error of one marker where the case declares none: the answer then is per mm of it."""


class Tape(NamedTuple):
    """A length on the skin, from the middle of the body's upper side, and the patient's side toward which it runs."""

    length_mm: float
    toward: str


@dataclass(frozen=True, eq=False)
class MarkerPlace:
    """Where one marker should be put, LPS mm."""

    name: str
    point_ct: Floats  # shape (3,), on the skin
    normal_ct: Floats
    head_mm: float  # toward the head from the target's level, negative toward the feet
    tape: Tape | None  # round the body at that level; None where the image cuts the body's sides

    def words(self, space: Space) -> str:
        """Directions to find the place on the skin; a space of its own has no anatomy, and is told by coordinates."""
        if space is Space.LOCAL:
            return f"at {point_text(self.point_ct, space)}"
        end = "head" if self.head_mm >= 0 else "feet"
        level = f"{abs(self.head_mm):.0f} mm toward the {end} from the target's level"
        if self.tape is None:
            return f"{level}, at {point_text(self.point_ct, space)}"
        along = f"{self.tape.length_mm:.0f} mm along the skin to the patient's {self.tape.toward}"
        return f"{level}, then {along} from halfway between the body's sides"


@dataclass(frozen=True, eq=False)
class Proposal:
    """Proposed places for markers, with the expected error that they leave."""

    places: tuple[MarkerPlace, ...]
    expected_mm: float  # error (rms) at the target by reading and touching these markers; of the arm's own nothing
    declared: bool  # whether the case declares the errors, or 1 mm a marker is assumed
    arm: str
    near_window_mm: float
    unmet: tuple[str, ...]  # what is wanted of places and is not so here, in words


class _Skin(NamedTuple):
    """Places (n, 3) of the skin, mm, normals out of it (n, 3), and how far each is from an entry (n,)."""

    points: Floats
    normals: Floats
    to_entry: Floats

    def of(self, rows: Ints | Bools) -> _Skin:
        return _Skin(*(one[rows] for one in self))


def check_count(count: int) -> None:
    """Refuse a number of markers that none can be proposed for, before a case is searched."""
    if not MIN_MARKERS <= count <= MOST_MARKERS:
        refuse(f"{count} markers", "--propose", f"{MIN_MARKERS} to {MOST_MARKERS}", "out_of_range")


def propose_markers(context: CaseContext, candidates: Candidates, count: int) -> Proposal:
    """Places for some markers, which the arm can touch if the context has one: the case says where its base is.

    Raises:
        InputError: A count out of range.
        NoAnswerError: No direction is safe, or too few places are left.
    """
    case, anatomy = context.case, context.anatomy
    check_count(count)
    if not candidates.safe.any():
        raise NoAnswerError("no direction is safe: there is no window to put markers beside", code="no_safe_direction")
    entries = cKDTree(candidates.path.entry_ct[candidates.safe])
    every, C = _places(case, anatomy, entries), FLE_MM**2 / 3 * np.eye(3)
    if case.errors is not None:
        C = case.errors.marker_cov_ct + case.errors.touch_mm**2 * np.eye(3)
    for less, farther in RELAXED:
        skin = _wanted(every, case, anatomy, WINDOW_MM * less, FAR_MM * farther)
        skin = skin.of(_touchable(context, candidates, skin.points))
        chosen, error = _exchanged(skin, case.target_ct, C, count, less)
        if chosen:
            break
    else:
        what = f"no {count} places that can be told apart, of {len(skin.points)} beside the windows that can be touched"
        raise NoAnswerError(what, code="no_place")
    order = sorted(chosen, key=lambda row: (-skin.points[row, 2], skin.points[row, 0]))
    chosen_skin = skin.of(np.array(order))
    places = []
    for number, (point, normal) in enumerate(zip(chosen_skin.points, chosen_skin.normals, strict=True), start=1):
        tape = None if case.space is Space.LOCAL else tape_to(anatomy.skin, point, np.asarray(up_axis(case)))
        places.append(MarkerPlace(f"M{number}", point, normal, float(point[2] - case.target_ct[2]), tape))
    unmet, near = tuple(_unmet(chosen_skin, case.target_ct)), float(chosen_skin.to_entry.min())
    return Proposal(tuple(places), error, case.errors is not None, context.arm_note, near, unmet)


def _unmet(chosen_skin: _Skin, target_ct: Floats) -> Iterator[str]:
    if (near := chosen_skin.to_entry.min()) < WINDOW_MM:
        yield f"a marker is {near:.0f} mm from an entry, less than {WINDOW_MM:g}: mind the drape"
    if (far := np.linalg.norm(chosen_skin.points - target_ct, axis=1).max()) > FAR_MM:
        yield f"a marker is {far:.0f} mm from the target, more than {FAR_MM:g}: skin moves there on its own"
    if (gap := pdist(chosen_skin.points).min()) < APART_MM:
        yield f"two markers are {gap:.0f} mm apart, less than {APART_MM:g}"
    if not _told_apart(chosen_skin.points, target_ct, SLIP_MM):
        within = SLIP_MM * RELAXED[-1][0]
        yield f"put each within {within:.1g} mm of its place: with names swapped they would fit to {SLIP_MM:g} mm"


def _places(case: Case, anatomy: Anatomy, entries: cKDTree) -> _Skin:
    """Places of the trunk's skin where a marker could stick, drawn evenly, however far from windows and target."""
    mesh, cut = anatomy.skin.mesh, anatomy.skin.cut_faces
    triangles = mesh.triangles
    middles = triangles.mean(axis=1)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    usable = ~cut & (areas > 0) & (np.linalg.norm(middles - case.target_ct, axis=1) <= FAR_MM * RELAXED[-1][1])
    for points in (middles[cut], *(mesh.vertices for mesh in _others(anatomy))):
        if len(points):
            usable &= cKDTree(points).query(middles, distance_upper_bound=END_MM)[0] > END_MM
    rows = np.flatnonzero(usable)
    if not len(rows):
        raise NoAnswerError("no skin of the trunk is seen but at its ends", code="no_place")
    rng = np.random.default_rng(SEED)
    drawn = rng.choice(rows, size=min(len(rows), DRAWN), replace=False, p=areas[rows] / areas[rows].sum())
    near = cKDTree(middles).query_ball_point(middles[drawn], BETWEEN_PLACES_MM)
    flat = np.array([normals[some].sum(axis=0) / areas[some].sum() for some in near]) * np.copysign(1.0, mesh.volume)
    up = np.asarray(up_axis(case)) / np.linalg.norm(up_axis(case))
    over = np.flatnonzero((flat @ up >= LEAST_UP) & (np.linalg.norm(flat, axis=1) >= FLAT))
    points = middles[drawn[over]]
    return _Skin(points, flat[over] / np.linalg.norm(flat[over], axis=1, keepdims=True), entries.query(points)[0])


def _others(anatomy: Anatomy) -> list[TriangleMesh]:
    """Surfaces in the CT that are not the trunk: arms at its side or across it, the table."""
    return [one.mesh for one in anatomy.surroundings if one.name in (ATTACHED_LIMB, OUTSIDE_BODY)]


def _wanted(every: _Skin, case: Case, anatomy: Anatomy, off_mm: float, far_mm: float) -> _Skin:
    """Those so far from the windows and so near to the target, evenly spread, over which nothing stands."""
    far = np.linalg.norm(every.points - case.target_ct, axis=1)
    skin = every.of((every.to_entry > off_mm) & (far <= far_mm))
    skin = skin.of(_thinned(skin.points))
    boxed = [row for row, _ in untouchable(case, skin.points, skin.normals)]
    skin = skin.of(np.setdiff1d(np.arange(len(skin.points)), boxed))
    for solid in (*_others(anatomy), *([] if anatomy.couch is None else [anatomy.couch])):
        reach_mm = case.needle.length_mm  # so far out of the skin nothing stands over a place, as an arm over a trunk
        places = zip(skin.points, skin.normals, strict=True)
        clear = [not crossings(solid, point, normal[None], reach_mm).count[0] for point, normal in places]
        skin = skin.of(np.array(clear, dtype=np.bool_))
    return skin


def _thinned(points: Floats) -> Ints:
    """Rows of points no nearer to each other than `BETWEEN_PLACES_MM`, `PLACES` at most."""
    rows: list[int] = []
    for row in range(len(points)):
        near = not rows or np.linalg.norm(points[rows] - points[row], axis=1).min() >= BETWEEN_PLACES_MM
        if near and len(rows) < PLACES:
            rows.append(row)
    return np.array(rows, dtype=np.int64)


def _touchable(context: CaseContext, candidates: Candidates, points_ct: Floats) -> Bools:
    """Which points (n, 3), CT frame, the arm can touch near the best insertion's orientation; all without an arm."""
    if context.reach is None or candidates.best is None:
        return np.ones(len(points_ct), np.bool_)
    checkers = approach_checkers(context, PLANNED_PADDING_MM)
    q, points = candidates.arm.q_insertion[candidates.best.row], apply(context.reach.T_base_ct, points_ct)
    tip_mm, free = context.case.needle.length_mm, np.zeros(len(points), np.bool_)
    for row, point in enumerate(points):
        poses = np.concatenate(touch_candidates(context.case.robot.model, tip_mm, point, q))[:POSES]
        free[row] = any(not why_not(checkers, tip_mm, one) for one in poses)
    return free


def _exchanged(skin: _Skin, target_ct: Floats, C: Floats, count: int, less: float = 1.0) -> tuple[list[int], float]:
    """Rows of the best places, by exchange from several starts, and their expected error, mm; none where none fit."""
    rng, best, least = np.random.default_rng(SEED), list[int](), np.inf
    A = design(skin.points, target_ct).reshape(-1, 3, 6)
    each = np.swapaxes(A, 1, 2) @ np.linalg.inv(C) @ A
    for _ in range(STARTS if len(skin.points) >= count else 0):
        chosen = rng.permutation(len(skin.points))[:count].tolist()
        settled = [False] * count
        for _ in range(SWEEPS):
            before = list(chosen)
            for slot in range(count):
                others = chosen[:slot] + chosen[slot + 1 :]
                costs = _errors_mm(each[others].sum(axis=0) + each)
                place = _first(costs, skin.points, others, target_ct, less)
                chosen[slot], settled[slot] = (chosen[slot], False) if place is None else (place, True)
            if chosen == before:
                break
        error = float(_errors_mm(each[chosen].sum(axis=0)[None])[0])
        if all(settled) and error < least:
            best, least = chosen, error
    return best, least


def _errors_mm(information: Floats) -> Floats:
    """Expected error (rms) at the target of each (..., 6, 6); infinite where it is not determined."""
    scale = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])  # rotations by the arm of 100 mm, so that rounding is seen
    scaled = information * np.outer(scale, scale)
    values = np.linalg.eigvalsh(scaled)
    known = values[..., 0] > LEAST_KNOWN * values[..., -1]
    shift = np.linalg.inv(np.where(known[..., None, None], scaled, np.eye(6)))[..., :3, :3]
    return np.where(known, np.sqrt(np.trace(shift, axis1=-2, axis2=-1)), np.inf)


def _first(costs: Floats, every: Floats, others: list[int], target_ct: Floats, less: float) -> int | None:
    """The place of least cost that is apart from the others and told apart from them."""
    points = every[others]
    gaps = np.linalg.norm(every[:, None] - points, axis=2).min(axis=1)
    apart = (gaps >= APART_MM * less) & np.isfinite(costs)
    rows = [row for row in np.argsort(costs, kind="stable") if apart[row]]
    distinct = (one for one in rows[:TRIES] if _told_apart(np.vstack([points, every[one]]), target_ct, SLIP_MM * less))
    return next((int(row) for row in distinct), None)


def _told_apart(points: Floats, target_ct: Floats, slip_mm: float) -> bool:
    names = tuple(map(str, range(len(points))))
    return not renamings(MarkerPairs(names, points, points), target_ct, slip_mm).found


LEVEL_MM = 4.0
"""Of a body's vertices, those so near to a level show its outline there."""
SIDES = ("left", "back", "right", "front")
"""LPS, a quarter of a rotation about the head's axis each."""


def tape_to(skin: Skin, point: Floats, up: Floats) -> Tape | None:
    """A tape round the body at a point (3,), mm, from the middle of the body's upper side.

    A tape spans hollows: it is the outline's convex hull in the axial slice. The middle is halfway between the body's
    sides, which a person sees; of a flat belly none sees the highest point. ``up`` (3,), LPS, is of any length.
    """
    vertices, cut = skin.mesh.vertices, np.zeros(len(skin.mesh.vertices), np.bool_)
    cut[skin.mesh.faces[skin.cut_faces]] = True
    near = np.abs(vertices[:, 2] - point[2]) <= LEVEL_MM
    rows = ConvexHull(vertices[near][:, :2]).vertices  # in the order left, back, right, front
    hull, upward = vertices[near][rows, :2], up[:2] / max(float(np.hypot(*up[:2])), 1e-9)
    across = hull @ [-upward[1], upward[0]]
    if cut[near][rows[[across.argmin(), across.argmax()]]].any():
        return None
    after, edges = np.roll(across, -1), np.roll(hull, -1, axis=0) - hull
    lengths, middle = np.linalg.norm(edges, axis=1), (across.min() + across.max()) / 2
    upper = int(np.flatnonzero((across <= middle) & (after > middle))[0])  # across grows along the upper side alone
    part = np.clip(np.einsum("ij,ij->i", point[:2] - hull, edges) / np.maximum(lengths**2, 1e-12), 0.0, 1.0)
    nearest = int(np.argmin(np.linalg.norm(hull + part[:, None] * edges - point[:2], axis=1)))
    begins = np.cumsum(lengths) - lengths
    start = begins[upper] + (middle - across[upper]) / (after[upper] - across[upper]) * lengths[upper]
    along = float((begins[nearest] + part[nearest] * lengths[nearest] - start) % lengths.sum())
    quarter = int(np.rint(np.arctan2(upward[1], upward[0]) / (np.pi / 2)))
    back = float(lengths.sum()) - along
    return Tape(along, SIDES[(quarter + 1) % 4]) if along <= back else Tape(back, SIDES[(quarter - 1) % 4])
