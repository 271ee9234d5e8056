"""Divide a cap of directions until every cell is safe, rejected, or smaller than a stated size."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from planning.anatomy import Anatomy
from planning.case import Case
from planning.certify.bounds import (
    ANGLE_PAD_RAD,
    CLEARANCE_PAD_MM,
    DEPTH_PAD_MM,
    view_bounds,
)
from planning.certify.cells import OFF_CENTRE, Cells, split
from planning.certify.certificate import REJECTED, SAFE, UNDECIDED, Certificate
from planning.certify.cones import Lists, Zones, narrowed, zones
from planning.certify.near_organs import organ_bounds
from planning.certify.question import Question, question_of
from planning.certify.skin_cones import LENGTH_PAD_MM, skin_bounds
from planning.certify.skin_surface import SkinSurface, skin_surface
from planning.clearance.containment import Side, side_of
from planning.errors import InputError
from planning.reasons import Reason

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

TOO_WIDE = np.radians(25)
"""Cells with a larger radius are halved unasked: no cone so wide is ever all safe."""

ASK_BELOW = np.radians(4)
"""Distances are measured for cells with a smaller radius: wider ones are settled by the skin or not at all."""

SMALLEST_SIZE = np.radians(0.01)
"""A finer map would need millions of cells, and the padding against rounding would begin to count."""


def certify(
    case: Case,
    anatomy: Anatomy,
    *,
    size: float,
    theta: tuple[float, float] | None = None,
    beta: tuple[float, float] | None = None,
) -> Certificate:
    """Certify a cap of directions.

    Args:
        case: The validated case.
        anatomy: Its structures.
        size: Cells of a smaller angular diameter stay undecided, rad.
        theta: The cap's puncture angles, rad; the case's own for None.
        beta: The cap's azimuths, rad; the case's own for None.

    Raises:
        InputError: The size or the cap makes no sense.
    """
    question = question_of(case, anatomy, theta=theta, beta=beta)
    if not SMALLEST_SIZE <= size <= np.pi:
        allowed = f"{np.degrees(SMALLEST_SIZE):g} to 180 degrees"
        raise InputError(f"size {np.degrees(size):g} degrees", where="certify", allowed=allowed)
    judge = _Judge(question, anatomy)
    record = _Record()
    cells, state = question.cap(), judge.start()
    while len(cells):
        radius = cells.radius()
        verdicts = judge.level(cells, radius, state)
        letters = np.where(verdicts.letter != UNDECIDED, verdicts.letter, cells.splits(size))
        letters = np.where((verdicts.letter == UNDECIDED) & (2 * radius <= size), UNDECIDED, letters)
        record.add(cells, letters, verdicts)
        inner = np.flatnonzero(np.char.islower(letters))
        children = split(cells.take(inner), letters[inner])
        state = verdicts.state.of(inner[children.parent])
        cells = children.cells
    return record.certificate(question, size, judge.queries)


@dataclass(frozen=True, eq=False)
class _State:
    """What n cells know from the cells that they are parts of.

    Attributes:
        parent: Shape (n,), row of each cell's lists.
        skin: Triangles of the skin that may matter.
        organs: Triangles of the organs that may matter.
        skin_good: Shape (n,), the skin's constraints hold.
        view_good: Shape (n,), the field of view is kept.
    """

    parent: Ints
    skin: Lists
    organs: Lists
    skin_good: Bools
    view_good: Bools

    def of(self, rows: Ints) -> _State:
        """For parts of the cells ``rows``."""
        return _State(self.parent[rows], self.skin, self.organs, self.skin_good[rows], self.view_good[rows])


@dataclass(frozen=True, eq=False)
class _Verdicts:
    """The verdicts on the n cells of a level, with their witnesses, and what their parts inherit."""

    letter: NDArray[np.str_]
    reason: NDArray[np.str_]
    structure: NDArray[np.str_]
    bound: Floats
    depth: Floats
    state: _State

    @classmethod
    def none(cls, state: _State) -> _Verdicts:
        n = len(state.parent)
        texts = np.full(n, UNDECIDED, "U1"), np.full(n, "", "U32"), np.full(n, "", "U80")
        return cls(*texts, np.full(n, np.nan), np.full(n, np.nan), state)

    def reject(self, where: Bools, reason: Reason, structure: NDArray[np.str_] | str, bound: Floats) -> None:
        """Reject those cells of ``where`` that have no verdict yet."""
        rows = np.flatnonzero(where & (self.letter == UNDECIDED))
        self.letter[rows], self.reason[rows], self.bound[rows] = REJECTED, reason.value, bound[rows]
        self.structure[rows] = structure if isinstance(structure, str) else structure[rows]


class _Judge:
    """Judges the cells of one question, level by level."""

    def __init__(self, question: Question, anatomy: Anatomy) -> None:
        self.queries = 0
        self._question = question
        self._anatomy = anatomy
        self._limits = question.margins + question.radius
        self._skin: SkinSurface = skin_surface(anatomy.skin, question.target_ct)
        demanding = [s for s in anatomy.structures if s.demands_margin]
        self._group = np.repeat(np.arange(len(demanding)), [len(s.mesh.faces) for s in demanding])
        triangles = [s.mesh.triangles for s in demanding] or [np.empty((0, 3, 3))]
        self._organs = np.concatenate(triangles) - question.target_ct
        self._zones: Zones = zones(self._organs, self._limits[self._group])
        self._inside = np.array([side_of(s.mesh, question.target_ct) is Side.INSIDE for s in demanding], bool)

    def start(self) -> _State:
        """What the whole cap knows: nothing, but which triangles a needle can come to at all."""
        limit = self._limits.max(initial=0.0) + self._question.length
        organs = np.flatnonzero(self._zones.nearest <= limit)
        skin = np.flatnonzero(self._skin.zones.nearest <= self._question.length + LENGTH_PAD_MM)
        no = np.zeros(1, bool)
        return _State(np.zeros(1, np.int64), Lists.one(skin), Lists.one(organs), no, no)

    def level(self, cells: Cells, radius: Floats, state: _State) -> _Verdicts:
        """Judge the cells of one level."""
        if self._inside.any() or not self._skin.odd:
            return self._all_rejected(state)
        if radius.max() > TOO_WIDE:
            return _Verdicts.none(state)
        centres = cells.centres() @ self._question.R_ct_entry.T
        verdicts = _Verdicts.none(self._narrowed_skin(centres, radius, state))
        self._judge_view(verdicts, centres, radius)
        self._judge_skin(verdicts, cells, centres, radius)
        return self._judge_organs(verdicts, centres, radius)

    def _all_rejected(self, state: _State) -> _Verdicts:
        """The target lies in a structure to avoid, or no ray leaves the skin as it must."""
        verdicts = _Verdicts.none(state)
        everywhere, nothing = np.ones(len(state.parent), bool), np.full(len(state.parent), np.nan)
        if self._inside.any():
            column = int(np.argmax(self._inside))
            name = self._question.structures[column]
            verdicts.reject(everywhere, Reason.TOO_CLOSE, name, nothing - self._question.radius)
        verdicts.reject(everywhere, Reason.UNKNOWN_REGION, "skin", nothing)
        return verdicts

    def _narrowed_skin(self, centres: Floats, radius: Floats, state: _State) -> _State:
        rows = np.arange(len(centres))
        group = np.zeros(len(self._skin.corners), np.int64)
        skin = narrowed(self._skin.zones, group, 1, state.skin, state.parent, centres, radius).lists
        organs = narrowed(
            self._zones, self._group, max(1, len(self._limits)), state.organs, state.parent, centres, radius
        )
        self._reach = np.minimum(organs.reach, self._question.length)
        return _State(rows, skin, organs.lists, state.skin_good.copy(), state.view_good.copy())

    def _judge_view(self, verdicts: _Verdicts, centres: Floats, radius: Floats) -> None:
        question = self._question
        view = view_bounds(self._anatomy.skin.field_of_view, question.target_ct, centres, radius, question.length)
        verdicts.state.view_good[view.kept] = True
        verdicts.reject(view.left, Reason.UNKNOWN_REGION, "skin", view.depth)

    def _judge_skin(self, verdicts: _Verdicts, cells: Cells, centres: Floats, radius: Floats) -> None:
        question, state = self._question, verdicts.state
        rows = np.flatnonzero((verdicts.letter == UNDECIDED) & ~state.skin_good)
        if not len(rows):
            return
        found = skin_bounds(
            self._skin,
            _some(state.skin, rows),
            centres[rows],
            radius[rows],
            cells.take(rows).at(*OFF_CENTRE) @ question.R_ct_entry.T,
            length=question.length,
            longest=question.longest,
        )
        state.skin_good[rows] = (
            (found.count == 1)
            & ~found.cut
            & (found.farthest <= question.longest - DEPTH_PAD_MM)
            & (found.largest_angle <= question.max_skin_angle - ANGLE_PAD_RAD)
        )
        n = len(cells)
        none_near = found.least_skin > question.longest + DEPTH_PAD_MM
        steep = ~none_near & (found.least_angle > question.max_skin_angle + ANGLE_PAD_RAD)
        nearest = np.where(np.isfinite(found.least_skin), found.least_skin, np.nan)
        nothing = np.full(n, np.nan)
        verdicts.reject(_where(none_near & found.cut, rows, n), Reason.UNKNOWN_REGION, "skin", nothing)
        verdicts.reject(_where(none_near, rows, n), Reason.TOO_LONG, "skin", _spread(nearest, rows, n))
        verdicts.reject(_where(found.count > 1, rows, n), Reason.REENTERS_SKIN, "skin", nothing)
        angle = _spread(np.degrees(found.least_angle), rows, n)
        verdicts.reject(_where(steep, rows, n), Reason.SKIN_ANGLE, "skin", angle)

    def _judge_organs(self, verdicts: _Verdicts, centres: Floats, radius: Floats) -> _Verdicts:
        question, state = self._question, verdicts.state
        good = state.skin_good & state.view_good & (verdicts.letter == UNDECIDED)
        clear = (self._reach <= 0).all(axis=1)
        verdicts.letter[good & clear] = SAFE
        rows = np.flatnonzero((verdicts.letter == UNDECIDED) & ~clear & (radius <= ASK_BELOW))
        if not len(rows):
            return verdicts
        self.queries += len(rows)
        found = organ_bounds(
            self._organs.reshape(-1, 9),
            self._group,
            self._limits,
            state.organs,
            rows,
            self._reach,
            centres,
            radius,
            length=question.length,
            pad=CLEARANCE_PAD_MM,
        )
        names = np.array(question.structures, dtype="U80")
        safe = good[rows] & (found.slack >= CLEARANCE_PAD_MM)
        verdicts.letter[rows[safe]] = SAFE
        verdicts.structure[rows[safe]] = names[found.tightest[safe]]
        verdicts.bound[rows[safe]] = found.slack[safe]
        structure = np.full(len(centres), "", "U80")
        structure[rows] = names[found.hit]
        clearance = _spread(found.largest - question.radius, rows, len(centres))
        verdicts.reject(_where(found.hit >= 0, rows, len(centres)), Reason.TOO_CLOSE, structure, clearance)
        verdicts.depth[rows] = found.depth
        return verdicts


@dataclass(eq=False)
class _Record:
    """Collects levels into a certificate."""

    tree: list[str] = field(default_factory=list)
    leaves: list[tuple[Floats, ...]] = field(default_factory=list)
    witnesses: list[tuple[NDArray[np.str_], ...]] = field(default_factory=list)

    def add(self, cells: Cells, letters: NDArray[np.str_], verdicts: _Verdicts) -> None:
        """Record one level."""
        self.tree.append("".join(letters))
        leaf = np.char.isupper(letters)
        self.leaves.append((cells.theta[leaf], cells.beta[leaf], verdicts.bound[leaf], verdicts.depth[leaf]))
        self.witnesses.append((letters[leaf], verdicts.reason[leaf], verdicts.structure[leaf]))

    def certificate(self, question: Question, size: float, queries: int) -> Certificate:
        """All levels together."""
        theta, beta, bound, depth = (np.concatenate(column) for column in zip(*self.leaves, strict=True))
        verdict, reason, structure = (np.concatenate(column) for column in zip(*self.witnesses, strict=True))
        tree = tuple(self.tree)
        return Certificate(question, size, tree, Cells(theta, beta), verdict, reason, structure, bound, depth, queries)


def _some(lists: Lists, rows: Ints) -> Lists:
    """The lists of some cells."""
    sizes = (lists.start[1:] - lists.start[:-1])[rows]
    start = np.concatenate([[0], np.cumsum(sizes)])
    where = np.arange(start[-1]) - np.repeat(start[:-1] - lists.start[rows], sizes)
    return Lists(start, lists.items[where])


def _where(values: Bools, rows: Ints, count: int) -> Bools:
    """Answers for some rows among ``count``; False elsewhere."""
    spread = np.zeros(count, np.bool_)
    spread[rows] = values
    return spread


def _spread(values: Floats, rows: Ints, count: int) -> Floats:
    """Numbers of some rows among ``count``; NaN elsewhere."""
    spread = np.full(count, np.nan)
    spread[rows] = values
    return spread
