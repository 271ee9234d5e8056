"""Independent check of a certificate: plain numpy and FCL, cell by cell, without any code that made the certificate.

What a cell claims is proven from the surfaces by the lemmas of docs/concepts/certificate.md. A triangle that is proven
clear of a cell is clear of its parts too, and what is true of the skin all over a cell is true all over its parts.
"""

from __future__ import annotations

from dataclasses import dataclass

import fcl
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.provenance import differing_input
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.certify.certificate import Certificate, question_of
from puncture_twin.planning.certify.plain_skin import PlainSkin, SkinFacts
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.reach.standoff import waiting_flange
from puncture_twin.planning.uncertainty.pose_error import PoseError

CLEARANCE_PAD_MM = 1e-4
"""Within this of a margin the search leaves the verdict to FCL's capsule; the certifier keeps twice as much."""
DEPTH_PAD_MM = 5e-5
"""Kept from limits on depths; the certifier keeps twice as much."""
ANGLE_PAD_RAD = 5e-8
"""Kept from the largest skin angle; the certifier keeps twice as much."""
CONTACT_MM = 0.01
"""A triangle of the skin that keeps so far from an axis is not crossed, also where the search tilts a ray a little."""
WIDEST = np.radians(80)
"""Nothing is proven over a wider cone."""
NEAR_BELOW = np.radians(4)
"""Planes by the feet on the edges, which tell something of near triangles, are tried for smaller cones."""
SKIN_BELOW = np.radians(25)
"""The skin is looked at for cones of at most this half-angle: over a wider one nothing is proven."""


@dataclass(frozen=True, repr=False)
class Verification(Shown):
    """How many cells of each verdict were proven; an undecided cell claims only its size."""

    safe: int
    rejected: int
    undecided: int


class _Cell:
    """A cell of the tree: its ranges of θ and β, and its shape.

    It lies in the cone of half-angle ``rho`` about ``u``; its directions are sums, with weights that are not negative
    and add up to at least 1, of its ``corners`` (4, 3), and of a vector no longer than ``bulge``.
    """

    def __init__(self, theta: tuple[float, float], beta: tuple[float, float], R_ct_entry: Floats) -> None:
        self.theta, self.beta, self._R = theta, beta, R_ct_entry
        self.u = self.ray(0.5, 0.5)
        self.corners = np.array([self.ray(i, j) for i in (0, 1) for j in (0, 1)])
        chord, wide = float(np.linalg.norm(self.corners - self.u, axis=1).max()), beta[1] - beta[0]
        self.rho = 2 * np.arcsin(min(1.0, chord / 2)) + 1e-12 if wide <= np.pi else np.pi
        self.bulge = np.sin(np.clip(np.pi / 2, *theta)) * (1 - np.cos(wide / 2)) + 1e-12

    def ray(self, i: float, j: float) -> Floats:
        """The direction at a fraction of the range from the lowest to the highest θ and β."""
        t, b = self.theta[0] + i * (self.theta[1] - self.theta[0]), self.beta[0] + j * (self.beta[1] - self.beta[0])
        return np.asarray(self._R @ np.array([np.sin(t) * np.cos(b), np.sin(t) * np.sin(b), np.cos(t)]))

    def parts(self, letter: str) -> list[_Cell]:
        """The cell's halves or quarters, low θ first, then low β."""
        (t0, t1), (b0, b1) = self.theta, self.beta
        t, b = 0.5 * (t0 + t1), 0.5 * (b0 + b1)
        thetas = [(t0, t), (t, t1)] if letter in "tq" else [(t0, t1)]
        betas = [(b0, b), (b, b1)] if letter in "bq" else [(b0, b1)]
        return [_Cell(theta, beta, self._R) for theta in thetas for beta in betas]


@dataclass(frozen=True, eq=False)
class _Known:
    """Facts proven all over a cell: triangles that may be near, the skin, the flanges of waiting needles.

    Those count along which a tip may wait; at least and at most so far from the target, mm.
    """

    skin: Ints
    organs: Ints
    flange: tuple[float, float]
    facts: SkinFacts | None = None
    skin_good: bool = False


def verify(
    certificate: Certificate,
    case: Case,
    anatomy: Anatomy,
    progress: Count | None = None,
    *,
    error: PoseError | None = None,
) -> Verification:
    """Prove every cell of a certificate again, as `read_certificate` gives it: the cells tile the cap.

    The error of the case's needle is needed where the certificate states a chance to touch. Raises InputError: Other
    inputs, or a cell whose claim does not follow.
    """
    _check_question(certificate, case, anatomy, error)
    return _Checker(certificate, case, anatomy).run(progress)


def _check_question(certificate: Certificate, case: Case, anatomy: Anatomy, error: PoseError | None) -> None:
    stated = certificate.question
    if not (np.all(np.isfinite(stated.theta)) and 0 <= stated.theta[0] <= stated.theta[1] <= np.pi + 1e-12):
        refuse(f"theta {stated.theta} is not a range", "certificate", "0 to pi", "out_of_range")
    derived = question_of(case, anatomy, theta=stated.theta, beta=stated.beta, touch=stated.touch, error=error)
    changed = differing_input(stated.inputs, derived.inputs)
    if changed is not None:
        what = f"input '{changed}' differs from the one used for the certificate"
        refuse(what, "certificate", f"a certificate of {case.path}, unchanged since then", "input_changed")
    for name in vars(derived):
        if name != "inputs" and not np.array_equal(getattr(stated, name), getattr(derived, name)):
            what = f"its {name} differs from the case's: the certificate was made for another question"
            refuse(what, "certificate", f"a certificate of {case.path}, unchanged since then", "certificate_of_another")


class _Checker:
    def __init__(self, certificate: Certificate, case: Case, anatomy: Anatomy) -> None:
        self._certificate = certificate
        self._question = certificate.question
        self._needle = case.needle
        self._skin = PlainSkin(anatomy.skin, case.target_ct)
        self._even = self._skin.closed and not self._skin.odd()
        demanding = [s for s in anatomy.checked if s.demands_margin]
        meshes, self._is_outside = [s.mesh for s in demanding], np.array([s.outside for s in demanding], bool)
        self._organs = np.concatenate([m.triangles for m in meshes] or [np.empty((0, 3, 3))]) - case.target_ct
        self._first = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])
        self._limits = self._question.margins + self._question.radius
        self._limit = np.repeat(self._limits, np.diff(self._first))
        self._outside = np.repeat(self._is_outside, np.diff(self._first))
        self._inside = [side_of(mesh, case.target_ct) is Side.INSIDE for mesh in meshes]

    def run(self, progress: Count | None) -> Verification:
        """Walk the tree, level by level; the leaves come in the certificate's order."""
        question = self._question
        flange = float(waiting_flange(self._needle, 0.0, 0.0)), question.farthest
        nothing = _Known(np.arange(len(self._skin.corners)), np.arange(len(self._organs)), flange)
        cells = [(_Cell(question.theta, question.beta, question.R_ct_entry), nothing)]
        leaf, total = 0, len(self._certificate.leaves)
        for level in self._certificate.tree:
            below: list[tuple[_Cell, _Known]] = []
            for (cell, whole), letter in zip(cells, level, strict=True):
                if letter.islower():
                    known = self._learn(cell, whole)
                    below += [(part, known) for part in cell.parts(letter)]
                    continue
                self._check_leaf(cell, whole, letter, leaf)
                leaf += 1
                if progress is not None:
                    progress(leaf, total)
            cells = below
        return Verification(*(int((self._certificate.verdict == letter).sum()) for letter in "SRU"))

    def _learn(self, cell: _Cell, whole: _Known) -> _Known:
        question = self._question
        if cell.rho > WIDEST:
            return whole
        skin, facts, good, flange = whole.skin, None, whole.skin_good, whole.flange
        organs = self._narrowed(whole.organs, cell, flange)
        if not good or self._outside[organs].any():
            everywhere = np.full(len(skin), CONTACT_MM), cell, np.full(len(skin), question.farthest)
            skin = skin[~_apart(self._skin.corners[skin], *everywhere)]
            if cell.rho <= SKIN_BELOW:
                lengths = {"length": question.farthest, "longest": question.longest}
                facts = self._skin.facts(skin, cell.u, cell.rho, cell.ray(0.4142, 0.5432), **lengths)
                good = good or self._skin_good(facts)
                flange = self._flange(facts, flange)
                organs = self._narrowed(organs, cell, flange)
        return _Known(skin, organs, flange, facts, good)

    def _narrowed(self, organs: Ints, cell: _Cell, flange: tuple[float, float]) -> Ints:
        """The triangles, of some, that are not proven clear of a cell whose flanges wait there."""
        limit = self._limit[organs] + CLEARANCE_PAD_MM
        length = np.where(self._outside[organs], flange[1] + DEPTH_PAD_MM, self._question.length)
        return organs[~_apart(self._organs[organs], limit, cell, length)]

    def _flange(self, skin: SkinFacts, known: tuple[float, float]) -> tuple[float, float]:
        """Bounds of the flanges by the skin's facts, and by those known before (lemma 9)."""
        longest, largest = self._question.longest, self._question.max_skin_angle
        shallow, steep = max(skin.least_angle - ANGLE_PAD_RAD, 0.0), skin.largest_angle + ANGLE_PAD_RAD
        least = waiting_flange(self._needle, min(skin.least_skin, longest), min(shallow, largest))
        most = waiting_flange(self._needle, min(skin.farthest, longest), min(steep, largest))
        return max(known[0], float(least)), min(known[1], float(most))

    def _check_leaf(self, cell: _Cell, whole: _Known, letter: str, row: int) -> None:
        reason, structure = str(self._certificate.reason[row]), str(self._certificate.structure[row])
        if letter == "U":
            proven = 2 * cell.rho <= self._certificate.size + 1e-9
        elif letter == "S":
            proven = not reason and self._safe(self._learn(cell, whole))
        elif reason == "too_close":
            proven = self._too_close(cell, whole, structure, int(self._certificate.triangle[row]))
        else:
            proven = self._skin_rejects(self._learn(cell, whole), reason)
        if not proven:
            theta, beta = (f"{np.degrees(low):.4f}..{np.degrees(high):.4f}" for low, high in (cell.theta, cell.beta))
            claim = {"S": "safe", "R": f"rejected ({reason})", "U": "small"}[letter]
            what = f"cell {row} (theta {theta}, beta {beta} degrees) is not proven {claim}"
            refuse(what, "certificate", "claims that the case supports", "cell_not_proven")

    def _safe(self, known: _Known) -> bool:
        lost = any(self._inside) or self._even
        return not lost and len(known.organs) == 0 and known.skin_good

    def _too_close(self, cell: _Cell, whole: _Known, structure: str, triangle: int) -> bool:
        """The axes at all corners come so near to one triangle that all between them do too (lemma 2)."""
        if structure not in self._question.structures:
            return False
        column = self._question.structures.index(structure)
        if self._inside[column]:
            return True
        row = self._first[column] + triangle
        if not self._first[column] <= row < self._first[column + 1] or cell.rho > WIDEST:
            return False
        surface = _bvh(self._organs[row], np.array([[0, 1, 2]]))
        outside = self._is_outside[column]
        length = self._learn(cell, whole).flange[0] - DEPTH_PAD_MM if outside else self._question.length
        ends = cell.corners * length
        axes = [_bvh(np.stack([np.zeros(3), end]), np.array([[0, 1, 1]])) for end in ends]
        worst = max(max(0.0, fcl.distance(axis, surface)) for axis in axes)
        more = 3 * length * cell.bulge
        return bool(worst + more < self._limits[column] - CLEARANCE_PAD_MM)

    def _skin_good(self, facts: SkinFacts) -> bool:
        return (
            facts.count == 1
            and not facts.cut
            and facts.farthest <= self._question.longest - DEPTH_PAD_MM
            and facts.largest_angle <= self._question.max_skin_angle - ANGLE_PAD_RAD
        )

    def _skin_rejects(self, known: _Known, reason: str) -> bool:
        if reason == "unknown_region" and self._even:
            return True
        facts = known.facts
        if facts is None:
            return False
        if reason in ("too_long", "unknown_region"):
            return facts.least_skin > self._question.longest + DEPTH_PAD_MM
        if reason == "reenters_skin":
            return facts.count > 1
        return reason == "skin_angle" and facts.least_angle > self._question.max_skin_angle + ANGLE_PAD_RAD


def _apart(corners: Floats, limit: Floats, cell: _Cell, length: Floats) -> Bools:
    """Which triangles a plane proves to keep their limit from every axis of a cell (lemmas 3 and 4), shape (k,).

    However a plane was found, it is proof. Tried are planes across the cell's middle, across the triangle's, the
    triangle's own, and those through the target that look from the middle axis to the triangle's middle or to the feet
    on its edges.

    Args:
        corners: Shape (k, 3, 3), triangles, mm from the target.
        limit: Shape (k,), mm.
        cell: With a cone below a right angle.
        length: Shape (k,), how far the axis goes, mm.
    """
    depth = corners @ cell.u
    apart = (depth.min(axis=1) >= limit + length) | (depth.max(axis=1) <= -limit)  # beyond the top, behind the target
    middle = _unit(_unit(corners.reshape(-1, 3)).reshape(corners.shape).sum(axis=1))
    behind = np.flatnonzero(~apart & (middle @ cell.u <= -np.sin(cell.rho)))
    apart[behind] = np.einsum("kci,ki->kc", corners[behind], middle[behind]).min(axis=1) >= limit[behind]
    apart |= _separated(corners, depth, limit, middle - (middle @ cell.u)[:, None] * cell.u, cell)
    apart |= _before_own_plane(corners, limit, cell, length)
    rest = np.flatnonzero(~apart) if cell.rho <= NEAR_BELOW else np.empty(0, np.int64)
    shifted = corners[rest] - depth[rest, :, None] * cell.u
    edge = shifted[:, [1, 2, 0]] - shifted
    part = -(shifted * edge).sum(axis=2) / np.maximum((edge * edge).sum(axis=2), 1e-300)
    feet = shifted + np.clip(part, 0, 1)[:, :, None] * edge
    for side in range(3):
        apart[rest] |= _separated(corners[rest], depth[rest], limit[rest], feet[:, side], cell)
    return np.asarray(apart)


def _before_own_plane(corners: Floats, limit: Floats, cell: _Cell, length: Floats) -> Bools:
    """Which triangles every axis of the cell ends before, or leads away from."""
    normal = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    height = np.einsum("kci,ki->kc", corners, normal)
    side = np.where(height[:, :1] >= 0.0, 1.0, -1.0)
    normal, height = normal * side, height * side
    toward, ahead, nearest = (normal @ cell.corners.T).max(axis=1), (cell.corners @ cell.u).min(), height.min(axis=1)
    away = (toward + cell.bulge <= 0.0) & (nearest >= limit)
    if ahead <= cell.bulge:
        return np.asarray(away)
    most = np.maximum(toward, 0.0) * (1.0 + cell.bulge) / ahead + cell.bulge
    return np.asarray(away | (nearest - length * most >= limit))


def _separated(corners: Floats, depth: Floats, limit: Floats, aside: Floats, cell: _Cell) -> Bools:
    """Whether m·v <= 0 for every direction v of the cell and m·p >= limit for the corners p; m is ``aside``, tilted."""
    normal, ahead = _unit(aside), cell.corners @ cell.u
    tilt = np.full(len(corners), np.tan(cell.rho))
    if ahead.min() > cell.bulge:
        tilt = np.clip(((normal @ cell.corners.T + cell.bulge) / ahead).max(axis=1), 0.0, tilt)
    least = (np.einsum("kci,ki->kc", corners, normal) - tilt[:, None] * depth).min(axis=1)
    return np.asarray(least >= limit * np.sqrt(1 + tilt**2))


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.sqrt((vectors * vectors).sum(axis=1, keepdims=True)), 1e-300))


def _bvh(vertices: Floats, faces: NDArray[np.integer]) -> fcl.CollisionObject:
    tree = fcl.BVHModel()
    tree.beginModel(num_tris_=len(faces), num_vertices_=len(vertices))
    tree.addSubModel(vertices, faces)
    tree.endModel()
    return fcl.CollisionObject(tree)
