"""Divide a cap of directions until every cell is safe, rejected, or smaller than a stated size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.certify.cells import OFF_CENTRE, Cells, Cones, Lists, narrowed, split, zones
from puncture_twin.planning.certify.certificate import (
    PROVED_SAFE,
    REJECTED,
    UNDECIDED,
    Certificate,
    Question,
    question_of,
)
from puncture_twin.planning.certify.near_organs import Organs, organ_facts
from puncture_twin.planning.certify.skin_cones import LENGTH_PAD_MM, SkinBounds, SkinSurface, skin_bounds, skin_surface
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.reach.standoff import waiting_flange
from puncture_twin.planning.uncertainty.pose_error import PoseError

TOO_WIDE = np.radians(80)
"""Cells with a larger radius are halved at once."""
SKIN_BELOW = np.radians(25)
"""The skin is checked for cells with a smaller radius: no wider cone is ever all good."""
MEASURE_BELOW = np.radians(4)
"""Organs are checked for cells with a smaller radius: wider ones are settled by the skin or not at all."""
SMALLEST_SIZE = np.radians(0.01)
"""A finer map would need millions of cells, and the padding against rounding would begin to count."""
CLEARANCE_PAD_MM = 2e-4
"""Kept from every margin: within 1e-4 mm of one the search leaves the verdict to FCL's capsule."""
DEPTH_PAD_MM = 1e-4
"""Kept from every limit on a depth, and from where a flange is."""
ANGLE_PAD_RAD = 1e-7
"""Kept from the largest skin angle: arccos near 0 rounds to 1e-8."""
REASONS = tuple(Reason)
"""A reason as a number, while cells are checked."""


def certify(
    case: Case,
    anatomy: Anatomy,
    *,
    size: float,
    theta: tuple[float, float] | None = None,
    beta: tuple[float, float] | None = None,
    touch: float | None = None,
    error: PoseError | None = None,
) -> Certificate:
    """Certify a cap of directions, by θ and β, rad; None for the case's own.

    Cells of a smaller angular diameter than ``size``, rad, stay undecided. ``touch`` is a chance to touch each
    structure that no safe cell may exceed in any configuration of the arm; the error of the case's needle is needed for
    it.

    Raises InputError: The size, the cap or the chance makes no sense, or nothing gives a chance.
    """
    question = question_of(case, anatomy, theta=theta, beta=beta, touch=touch, error=error)
    if not SMALLEST_SIZE <= size <= np.pi:
        allowed = f"{np.degrees(SMALLEST_SIZE):g} to 180 degrees"
        refuse(f"size {np.degrees(size):g} degrees", "certify", allowed, "out_of_range")
    evaluator, tree, leaves = _Evaluator(question, anatomy, case.needle), list[str](), []
    cells, state = question.cap(), evaluator.start()
    while len(cells):
        cones = cells.cones(question.R_ct_entry)
        verdicts = evaluator.level(cells, cones, state)
        letters = np.where(verdicts.letter != UNDECIDED, verdicts.letter, cells.splits(cones.radius, size))
        letters = np.where((verdicts.letter == UNDECIDED) & (2 * cones.radius <= size), UNDECIDED, letters)
        tree.append("".join(letters.tolist()))
        columns = cells.theta, cells.beta, letters, verdicts.reason, verdicts.triangle, verdicts.bound
        leaves.append([column[np.char.isupper(letters)] for column in columns])
        inner = np.flatnonzero(np.char.islower(letters))
        cells, parent = split(cells.take(inner), letters[inner])
        state = verdicts.state.of(inner[parent])
    low_high, first_last, verdict, code, triangle, bound = map(np.concatenate, zip(*leaves, strict=True))
    reason = np.array([reason.value for reason in REASONS], dtype=np.str_)[code]
    structure, face = evaluator.names(triangle)
    of_leaves = Cells(low_high, first_last), verdict, reason, structure, face, bound
    return Certificate(question, size, tuple(tree), *of_leaves, evaluator.queries)


@dataclass(frozen=True, eq=False)
class _State:
    """Knowledge of n cells, inherited from the cells that they are parts of."""

    parent: Ints  # shape (n,), row of each cell's lists
    skin: Lists  # triangles of the skin that may matter
    organs: tuple[Lists, Lists]
    """Triangles of the body's structures that may matter, and behind them those outside of the body."""
    witness: Ints  # shape (2, n), of both the triangle that nearly rejected the whole, or -1
    skin_good: Bools  # shape (n,), the skin's constraints hold
    flange: Floats
    """Shape (n, 2), how far from the target flanges are while the tip waits, at least and at most, mm."""

    def of(self, rows: Ints) -> _State:
        """The state of parts of the cells ``rows``."""
        known = self.witness[:, rows], self.skin_good[rows], self.flange[rows]
        return _State(self.parent[rows], self.skin, self.organs, *known)


@dataclass(frozen=True, eq=False)
class _Verdicts:
    letter: NDArray[np.str_]
    reason: Ints
    triangle: Ints
    bound: Floats
    state: _State

    @classmethod
    def none(cls, state: _State) -> _Verdicts:
        n = len(state.parent)
        return cls(np.full(n, UNDECIDED), np.zeros(n, np.int64), np.full(n, -1), np.full(n, np.nan), state)

    def reject(self, where: Bools, reason: Reason, bound: Floats | float = np.nan) -> None:
        """Reject those cells of ``where`` that have no verdict yet."""
        rows = np.flatnonzero(where & (self.letter == UNDECIDED))
        self.letter[rows], self.reason[rows] = REJECTED, REASONS.index(reason)
        self.bound[rows] = np.broadcast_to(bound, len(where))[rows]


class _Evaluator:
    def __init__(self, question: Question, anatomy: Anatomy, needle: Needle) -> None:
        self.queries = 0
        self._question, self._needle = question, needle
        self._skin: SkinSurface = skin_surface(anatomy.skin, question.target_ct)
        demanding = [s for s in anatomy.checked if s.demands_margin]
        limits, outside = question.margins + question.radius, np.array([s.outside for s in demanding], bool)
        self._organs = tuple(_organs(demanding, question, limits, which) for which in (~outside, outside))
        group = np.concatenate([one.group for one in self._organs])
        self._column = np.concatenate([group, [len(demanding)]])
        self._first = np.array([np.argmax(self._column == column) for column in range(len(demanding) + 1)])
        meshes, target = [s.mesh for s in demanding], question.target_ct
        self._inside = [bool(_in_box(one.vertices, target)) and side_of(one, target) is Side.INSIDE for one in meshes]

    def start(self) -> _State:
        """State of the whole cap: only which triangles a needle can come to at all."""
        farthest = self._question.farthest + LENGTH_PAD_MM
        near = [one.limits.max(initial=0.0) + farthest for one in self._organs]
        organs = [
            Lists.one(np.flatnonzero(one.zones.nearest <= limit)) for one, limit in zip(self._organs, near, strict=True)
        ]
        skin = np.flatnonzero(self._skin.zones.nearest <= farthest)
        first, flange = np.zeros(1, np.int64), any_flange(self._needle, self._question, 1)
        return _State(first, Lists.one(skin), (organs[0], organs[1]), np.full((2, 1), -1), np.zeros(1, bool), flange)

    def level(self, cells: Cells, cones: Cones, state: _State) -> _Verdicts:
        """Evaluate the cells of one level."""
        if any(self._inside) or not self._skin.odd:  # in a structure to avoid, or no ray leaves the skin as it must
            verdicts, everywhere = _Verdicts.none(state), np.ones(len(state.parent), bool)
            if any(self._inside):
                verdicts.reject(everywhere, Reason.TOO_CLOSE, -self._question.radius)
                verdicts.triangle[:] = self._first[self._inside.index(True)]
            verdicts.reject(everywhere, Reason.UNKNOWN_REGION)
            return verdicts
        if cones.radius.max() > TOO_WIDE:
            return _Verdicts.none(state)
        skin = narrowed(self._skin.zones, state.skin, state.parent, cones.centres, cones.radius)
        rows, good = np.arange(len(cells)), state.skin_good.copy()
        known = _State(rows, skin, state.organs, state.witness.copy(), good, state.flange.copy())
        verdicts = _Verdicts.none(known)
        within = self._near(0, verdicts, cones, state, np.tile(self._question.length, (len(cells), 2)))
        if cones.radius.max() <= SKIN_BELOW:  # it says where the flanges are, too
            self._check_skin(verdicts, cells, cones, ~known.skin_good | _filled(state.organs[1])[state.parent])
        around = self._near(1, verdicts, cones, state, known.flange)
        clear = ~_filled(within) & ~_filled(around)
        verdicts.letter[clear & known.skin_good & (verdicts.letter == UNDECIDED)] = PROVED_SAFE
        return replace(verdicts, state=replace(known, organs=(within, around)))

    def _near(self, part: int, verdicts: _Verdicts, cones: Cones, state: _State, lengths: Floats) -> Lists:
        """Reject cells by structures within the body (0) or outside of it (1); the lists that matter to their parts."""
        witness, pad = state.witness[part], CLEARANCE_PAD_MM
        facts = organ_facts(
            self._organs[part], state.organs[part], state.parent, witness, cones, lengths, wide=MEASURE_BELOW, pad=pad
        )
        self.queries += facts.measured
        first, fresh = part * len(self._organs[0].group), facts.rejected & (verdicts.letter == UNDECIDED)
        verdicts.reject(fresh, Reason.TOO_CLOSE, facts.largest - self._question.radius)
        verdicts.triangle[fresh] = facts.witness[fresh] + first
        verdicts.state.witness[part] = facts.witness
        return facts.near

    def names(self, triangle: Ints) -> tuple[NDArray[np.str_], Ints]:
        """The structure of each triangle, and which of its triangles it is; "" and -1 for -1."""
        column = self._column[triangle]
        face = np.where(triangle < 0, -1, triangle - self._first[column])
        return np.array([*self._question.structures, ""], dtype=np.str_)[column], face

    def _check_skin(self, verdicts: _Verdicts, cells: Cells, cones: Cones, which: Bools) -> None:
        question, state = self._question, verdicts.state
        rows = np.flatnonzero((verdicts.letter == UNDECIDED) & which)
        if not len(rows):
            return
        bounds = skin_bounds(
            self._skin,
            state.skin.take(rows),
            cones.centres[rows],
            cones.radius[rows],
            cells.take(rows).at(*OFF_CENTRE) @ question.R_ct_entry.T,
            length=question.farthest,
            longest=question.longest,
        )
        state.skin_good[rows] |= (
            (bounds.count == 1)
            & ~bounds.cut
            & (bounds.farthest <= question.longest - DEPTH_PAD_MM)
            & (bounds.largest_angle <= question.max_skin_angle - ANGLE_PAD_RAD)
        )
        n = len(cells)
        none_near = bounds.least_skin > question.longest + DEPTH_PAD_MM
        steep = ~none_near & (bounds.least_angle > question.max_skin_angle + ANGLE_PAD_RAD)
        nearest = np.where(np.isfinite(bounds.least_skin), bounds.least_skin, np.nan)
        verdicts.reject(_spread(none_near & bounds.cut, rows, n), Reason.UNKNOWN_REGION)
        verdicts.reject(_spread(none_near, rows, n), Reason.TOO_LONG, _spread(nearest, rows, n))
        verdicts.reject(_spread(bounds.count > 1, rows, n), Reason.REENTERS_SKIN)
        angle = np.degrees(bounds.least_angle)
        verdicts.reject(_spread(steep, rows, n), Reason.SKIN_ANGLE, _spread(angle, rows, n))
        flange, known = flange_bounds(self._needle, question, bounds), state.flange
        known[rows, 0] = np.maximum(known[rows, 0], flange[:, 0])
        known[rows, 1] = np.minimum(known[rows, 1], flange[:, 1])


def any_flange(needle: Needle, question: Question, count: int) -> Floats:
    """Bounds for every path and angle that the case allows, whatever the skin: shape (count, 2), mm."""
    return np.tile([waiting_flange(needle, 0.0, 0.0) - DEPTH_PAD_MM, question.farthest + DEPTH_PAD_MM], (count, 1))


def flange_bounds(needle: Needle, question: Question, skin: SkinBounds) -> Floats:
    """Least and largest distance of the flanges over n cones from the target, shape (n, 2), mm.

    They hold for every direction whose path and skin angle the case allows; along others no tip ever waits. The flange
    is the farther, the longer the path and the larger the angle.
    """
    longest, largest = question.longest, question.max_skin_angle
    low = np.clip(skin.least_angle - ANGLE_PAD_RAD, 0.0, largest)
    high = np.clip(skin.largest_angle + ANGLE_PAD_RAD, 0.0, largest)
    least = waiting_flange(needle, np.minimum(skin.least_skin, longest), low) - DEPTH_PAD_MM
    most = waiting_flange(needle, np.minimum(skin.farthest, longest), high) + DEPTH_PAD_MM
    return np.stack([least, most], axis=1)


def _organs(demanding: list[Structure], question: Question, limits: Floats, which: Bools) -> Organs:
    columns = np.flatnonzero(which)
    meshes = [demanding[column].mesh for column in columns]
    group = np.repeat(columns, [len(mesh.faces) for mesh in meshes])
    corners = np.concatenate([mesh.triangles for mesh in meshes] or [np.empty((0, 3, 3))]) - question.target_ct
    return Organs(corners.reshape(-1, 9), group, limits, zones(corners, limits[group] + CLEARANCE_PAD_MM))


def _filled(lists: Lists) -> Bools:
    return np.asarray(lists.start[1:] > lists.start[:-1])


@nb.njit(cache=True)
def _in_box(vertices, point):  # type: ignore[no-untyped-def]  # numba infers
    below, above = np.zeros(3, np.bool_), np.zeros(3, np.bool_)
    for i in range(len(vertices)):
        for axis in range(3):
            below[axis] |= vertices[i, axis] <= point[axis]
            above[axis] |= vertices[i, axis] >= point[axis]
    return below.all() and above.all()


def _spread(values: NDArray[np.generic], rows: Ints, count: int) -> NDArray[Any]:
    """Values of some rows among ``count``; False or NaN elsewhere."""
    spread = np.full(count, False if values.dtype == bool else np.nan)
    spread[rows] = values
    return spread
