"""Does a certificate hold? Plain numpy and FCL, cell by cell; nothing of what made the certificate is used.

What a cell claims is proven from the surfaces, the distance at the cell's centre and the bounds of docs/certificate.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import fcl
import numpy as np
from numpy.typing import NDArray

from planning.anatomy import Anatomy
from planning.case import Case
from planning.certify.certificate import Certificate
from planning.certify.plain_skin import PlainSkin, SkinFacts
from planning.certify.question import question_of
from planning.clearance.containment import Side, side_of
from planning.errors import InputError
from planning.skin import FieldOfView

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Progress = Callable[[int, int], None]

CLEARANCE_PAD_MM = 1e-4
"""Within this of a margin the search leaves the verdict to FCL's capsule; the certifier keeps twice as much."""
DEPTH_PAD_MM = 5e-5
"""Kept from limits on depths; the certifier keeps twice as much."""
ZONE_PAD_RAD = 5e-7
"""Widens the directions to which a triangle matters; the certifier widens twice as much."""
STATED_TO_MM = 1e-5
"""To which the file states depths, and more."""
WIDEST = np.radians(80)
"""Nothing is proven over a wider cone."""


@dataclass(frozen=True)
class Verification:
    """How many cells of each verdict were proven; an undecided cell claims only its size."""

    safe: int
    rejected: int
    undecided: int


@dataclass(frozen=True, eq=False)
class _Node:
    """A cell of the tree: its ranges, its cone, and the triangles that may matter to it."""

    theta: tuple[float, float]
    beta: tuple[float, float]
    u: Floats
    rho: float
    ray: Floats
    skin: Ints
    organs: Ints
    parent: _Node | None


def verify(certificate: Certificate, case: Case, anatomy: Anatomy, progress: Progress | None = None) -> Verification:
    """Prove every cell of a certificate again.

    Args:
        certificate: As read from a file; `read_certificate` has checked that the cells tile the cap.
        case: The case that it must belong to.
        anatomy: The case's structures.
        progress: Called with (cells done, cells in all).

    Raises:
        InputError: Other inputs, or a cell whose claim does not follow.
    """
    _check_question(certificate, case, anatomy)
    return _Checker(certificate, case, anatomy).run(progress)


def _check_question(certificate: Certificate, case: Case, anatomy: Anatomy) -> None:
    stated = certificate.question
    if not (np.all(np.isfinite(stated.theta)) and 0 <= stated.theta[0] <= stated.theta[1] <= np.pi + 1e-12):
        raise InputError(f"theta {stated.theta} is no range", where="certificate", allowed="0 to pi")
    asked = question_of(case, anatomy, theta=stated.theta, beta=stated.beta)
    for name in ("case_name", "inputs", "length", "radius", "longest", "max_skin_angle", "structures"):
        if getattr(stated, name) != getattr(asked, name):
            what = f"its {name} is not that of the case: the certificate was made for something else"
            raise InputError(what, where="certificate", allowed=f"a certificate of {case.path}, unchanged since")
    for name in ("target_ct", "R_ct_entry", "margins"):
        if not np.array_equal(getattr(stated, name), getattr(asked, name)):
            raise InputError(f"its {name} is not that of the case", where="certificate", allowed=f"as in {case.path}")


class _Checker:
    def __init__(self, certificate: Certificate, case: Case, anatomy: Anatomy) -> None:
        self._certificate = certificate
        self._question = certificate.question
        self._view = anatomy.skin.field_of_view
        self._structures = [s for s in anatomy.structures if s.demands_margin]
        self._limits = self._question.margins + self._question.radius
        self._skin = PlainSkin(anatomy.skin, case.target_ct)
        self._skin_zone = _zone(self._skin.corners, np.zeros(len(self._skin.corners)))
        self._group = np.repeat(np.arange(len(self._structures)), [len(s.mesh.faces) for s in self._structures])
        organs = [s.mesh.triangles for s in self._structures] or [np.empty((0, 3, 3))]
        self._organs = np.concatenate(organs) - case.target_ct
        self._organ_zone = _zone(self._organs, self._limits[self._group])
        self._farthest = np.linalg.norm(self._organs, axis=2).max(axis=1)
        self._trees = [fcl.CollisionObject(_bvh(s.mesh.vertices, s.mesh.faces)) for s in self._structures]
        self._inside = [side_of(s.mesh, case.target_ct) is Side.INSIDE for s in self._structures]
        self._even = self._skin.closed and not self._skin.odd()

    def run(self, progress: Progress | None) -> Verification:
        """Walk the tree, level by level; the leaves come in the certificate's order."""
        whole = np.arange(len(self._skin.corners)), np.arange(len(self._organs))
        nodes = [self._node(self._question.theta, self._question.beta, *whole, None)]
        leaf, total = 0, len(self._certificate.leaves)
        for level in self._certificate.tree:
            below: list[_Node] = []
            for node, letter in zip(nodes, level, strict=True):
                if letter.islower():
                    for theta, beta in _parts(node, letter):
                        below.append(self._node(theta, beta, node.skin, node.organs, node))
                    continue
                self._check_leaf(node, letter, leaf)
                leaf += 1
                if progress is not None:
                    progress(leaf, total)
            nodes = below
        counts = [int((self._certificate.verdict == letter).sum()) for letter in "SRU"]
        return Verification(*counts)

    def _node(
        self,
        theta: tuple[float, float],
        beta: tuple[float, float],
        skin: Ints,
        organs: Ints,
        parent: _Node | None,
    ) -> _Node:
        u, ray = self._ray(theta, beta, 0.5, 0.5), self._ray(theta, beta, 0.4142, 0.5432)
        corners = [self._ray(theta, beta, i, j) for i in (0, 1) for j in (0, 1)]
        rho = max(2 * np.arcsin(min(1.0, float(np.linalg.norm(u - corner)) / 2)) for corner in corners) + 1e-12
        if beta[1] - beta[0] > np.pi or rho > WIDEST:
            return _Node(theta, beta, u, np.pi, ray, skin, organs, parent)
        skin = skin[_matters(self._skin_zone[skin], u, rho)]
        return _Node(theta, beta, u, rho, ray, skin, organs[_matters(self._organ_zone[organs], u, rho)], parent)

    def _ray(self, theta: tuple[float, float], beta: tuple[float, float], i: float, j: float) -> Floats:
        t, b = theta[0] + i * (theta[1] - theta[0]), beta[0] + j * (beta[1] - beta[0])
        entry = np.array([np.sin(t) * np.cos(b), np.sin(t) * np.sin(b), np.cos(t)])
        return np.asarray(self._question.R_ct_entry @ entry)

    def _check_leaf(self, node: _Node, letter: str, row: int) -> None:
        reason, structure = str(self._certificate.reason[row]), str(self._certificate.structure[row])
        if letter == "U":
            holds = 2 * node.rho <= self._certificate.size + 1e-9
        elif letter == "S":
            holds = not reason and self._safe(node)
        elif reason == "too_close":
            holds = self._too_close(node, structure, float(self._certificate.depth[row]))
        else:
            holds = self._skin_rejects(node, reason)
        if not holds:
            theta, beta = (f"{np.degrees(low):.4f}..{np.degrees(high):.4f}" for low, high in (node.theta, node.beta))
            claim = {"S": "safe", "R": f"rejected ({reason})", "U": "small"}[letter]
            what = f"cell {row} (theta {theta}, beta {beta} degrees) is not proven {claim}"
            raise InputError(what, where="certificate", allowed="claims that follow from the case")

    def _safe(self, node: _Node) -> bool:
        """No structure comes near, and the skin is met once, soon enough and steeply enough, in what was imaged."""
        question = self._question
        if any(self._inside) or self._even or node.rho > WIDEST:
            return False
        groups = self._group[node.organs]
        for column in np.unique(groups):
            rows = node.organs[groups == column]
            reach = min(question.length, self._farthest[rows].max())
            enough = self._limits[column] + CLEARANCE_PAD_MM + 2 * reach * np.sin(node.rho / 2)
            if self._distance(self._trees[column], node, question.length) < enough:
                corners = self._organs[rows] + question.target_ct
                tree = _bvh(corners.reshape(-1, 3), np.arange(3 * len(rows)).reshape(-1, 3))
                if self._distance(fcl.CollisionObject(tree), node, question.length) < enough:
                    return False
        return self._anywhere(node, self._skin_good) and self._anywhere(node, lambda n: self._view_holds(n, kept=True))

    def _skin_good(self, node: _Node) -> bool:
        facts, question = self._facts(node), self._question
        return (
            facts.count == 1
            and not facts.cut
            and facts.farthest <= question.longest - DEPTH_PAD_MM
            and facts.largest_angle <= question.max_skin_angle - 5e-8
        )

    def _skin_rejects(self, node: _Node, reason: str) -> bool:
        if reason == "unknown_region" and self._even:
            return True
        if node.rho > WIDEST:
            return False
        facts, question = self._facts(node), self._question
        none_near = facts.least_skin > question.longest + DEPTH_PAD_MM
        if reason == "unknown_region":
            return none_near or self._view_holds(node, kept=False)
        if reason == "too_long":
            return none_near
        if reason == "reenters_skin":
            return facts.count > 1
        return reason == "skin_angle" and facts.least_angle > question.max_skin_angle + 5e-8

    def _too_close(self, node: _Node, structure: str, depth: float) -> bool:
        """An axis point no deeper than ``depth`` is near the structure and stays so, however the axis turns."""
        if structure not in self._question.structures:
            return False
        column = self._question.structures.index(structure)
        if self._inside[column]:
            return True
        if not 0 <= depth <= self._question.length:
            return False
        depth = min(depth + STATED_TO_MM, self._question.length)
        moved = 2 * depth * np.sin(min(node.rho, np.pi) / 2)
        return self._distance(self._trees[column], node, depth) + moved < self._limits[column] - CLEARANCE_PAD_MM

    def _distance(self, surface: fcl.CollisionObject, node: _Node, length: float) -> float:
        """FCL's distance of the centre's axis, so long, from a surface: its triangle distance, exact, 0 on contact."""
        tip = self._question.target_ct
        axis = fcl.CollisionObject(_bvh(np.stack([tip, tip + length * node.u]), np.array([[0, 1, 1]])))
        return max(0.0, float(fcl.distance(axis, surface, fcl.DistanceRequest(), fcl.DistanceResult())))

    def _facts(self, node: _Node) -> SkinFacts:
        question = self._question
        return self._skin.facts(node.skin, node.u, node.rho, node.ray, length=question.length, longest=question.longest)

    def _view_holds(self, node: _Node, *, kept: bool) -> bool:
        return _keeps(self._view, self._question.target_ct, node, self._question.length) is kept

    @staticmethod
    def _anywhere(node: _Node, holds: Callable[[_Node], bool]) -> bool:
        """Whether something holds for a cell, or for a cell that it is part of."""
        at: _Node | None = node
        while at is not None and at.rho <= WIDEST:
            if holds(at):
                return True
            at = at.parent
        return False


def _keeps(view: FieldOfView | None, target_ct: Floats, node: _Node, length: float) -> bool | None:
    """Whether all needles stay off the faces that cut the body (True), or all leave through one (False)."""
    if view is None:
        return True
    start, along = view.to_box(target_ct[None])[0], view.T_ct_box[:3, :3].T @ node.u
    soonest, latest, cut = [], [], []
    for axis in range(3):
        for end, toward, height in ((0, -along[axis], start[axis]), (1, along[axis], view.size_mm[axis] - start[axis])):
            angle = np.arccos(np.clip(toward, -1, 1))
            best, worst = np.cos(max(angle - node.rho, 0)), np.cos(min(angle + node.rho, np.pi))
            soonest.append(max(height, 0.0) / best if best > 0 else np.inf)
            latest.append(max(height, 0.0) / worst if worst > 0 else np.inf)
            cut.append(bool(view.cut[axis, end]))
    first_cut = min((late for late, is_cut in zip(latest, cut, strict=True) if is_cut), default=np.inf)
    first_other = min((soon for soon, is_cut in zip(soonest, cut, strict=True) if not is_cut), default=np.inf)
    if first_cut < length - DEPTH_PAD_MM and first_other > first_cut + DEPTH_PAD_MM:
        return False
    limit = min(length, *latest) + DEPTH_PAD_MM
    return True if all(soon > limit for soon, is_cut in zip(soonest, cut, strict=True) if is_cut) else None


def _parts(node: _Node, letter: str) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    (t0, t1), (b0, b1) = node.theta, node.beta
    t, b = 0.5 * (t0 + t1), 0.5 * (b0 + b1)
    thetas = [(t0, t), (t, t1)] if letter in "tq" else [(t0, t1)]
    betas = [(b0, b), (b, b1)] if letter in "bq" else [(b0, b1)]
    return [(theta, beta) for theta in thetas for beta in betas]


def _zone(corners: Floats, limits: Floats) -> Floats:
    """Cone of directions (axis, half-angle) to which each triangle matters, shape (m, 4)."""
    lengths = np.linalg.norm(corners, axis=2)
    centre = corners.mean(axis=1)
    nearest = np.linalg.norm(centre, axis=1) - np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1) - 1e-9
    units = corners / np.maximum(lengths, 1e-300)[:, :, None]
    total = units.sum(axis=1)
    axis = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
    least = np.einsum("nci,ni->nc", units, axis).min(axis=1)
    narrow = (lengths.min(axis=1) > 0) & (nearest > limits) & (np.linalg.norm(total, axis=1) > 0.5) & (least > 0.1)
    grown = np.arcsin(np.clip(limits / np.where(narrow, nearest, 1.0), 0, 1))
    half = np.where(narrow, np.arccos(np.clip(least, -1, 1)) + grown + ZONE_PAD_RAD, np.pi)
    return np.column_stack([axis, half])


def _matters(zone: Floats, u: Floats, rho: float) -> NDArray[np.bool_]:
    return np.asarray(zone[:, :3] @ u >= np.cos(np.minimum(zone[:, 3] + rho, np.pi)) - 1e-15)


def _bvh(vertices: Floats, faces: NDArray[np.integer]) -> fcl.BVHModel:
    tree = fcl.BVHModel()
    tree.beginModel(num_tris_=len(faces), num_vertices_=len(vertices))
    tree.addSubModel(vertices, faces)
    tree.endModel()
    return tree
