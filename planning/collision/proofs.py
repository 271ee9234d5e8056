"""The checks of one workcell, packed for compiled proofs.

`Proofs` proves checks clear at states, along paths and in boxes of joint angles. `never_touching` finds the pieces two
joints apart that touch at no angle: proven once for an arm, and not tested again.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.collision.bodies import Check
from puncture_twin.planning.collision.kernels import proofs as proof_kernels, settled as settled_kernels
from puncture_twin.planning.collision.kernels.proofs import ProofScene, proof_scratch
from puncture_twin.planning.collision.kernels.surfaces import STACK
from puncture_twin.planning.collision.packed import (
    ROUND,
    WORKCELL_FRAME,
    PackedHulls,
    finer_prism,
    joint_levers,
    made_from,
    packed_movers,
    packed_skin,
    packed_trees,
)
from puncture_twin.planning.geometry.mesh import TriangleMesh


class Motion(NamedTuple):
    """A path as the compiled code takes it, see :func:`proof_kernels.first_unproven`."""

    frames: Floats
    moved: Floats
    rotated: Floats


class Around(NamedTuple):
    """The checks that :meth:`Proofs.clear_about` leaves open."""

    touching: Bools
    """Shape (m, k): at the state itself the reference must be queried, and is likely to find that something touches."""
    unproven: Bools  # shape (m, k): the checks open about each state


class NotClear(NamedTuple):
    """The first check of each state that is not proven clear."""

    checks: Ints  # shape (m,); -1 where all is clear
    answers: Ints
    """Shape (m,): what it comes to, see :mod:`puncture_twin.planning.collision.kernels.settled`."""


class Proofs:
    """The checks of one workcell, ready to be proven. Not for several threads: the scratch is shared.

    ``joint_spans`` (k, 3) says of each check whether it is between two bodies of the arm, and the frames of both.

    Args:
        patient: The skin, and behind it what the CT shows besides; or None.
        cache: Where enclosures are kept: they depend on arm and tool alone.
    """

    def __init__(
        self,
        model: UrModel,
        checks: Sequence[Check],
        boxes: Sequence[Box],
        patient: TriangleMesh | None,
        skin_triangles: int,
        cache: Cache,
    ) -> None:
        against_skin = [check.second_body for check in checks if check.hulls is None]
        finer = {body.name: finer_prism(body.full.hulls[0]) for body in against_skin if body.name in ROUND}
        hulls, rows = PackedHulls(boxes), []
        roots, spheres = packed_trees(against_skin, cache)
        for check in checks:
            frame = check.second_body.frame
            if check.hulls is None:
                body = check.second_body
                round_row = hulls.add(finer[body.name], body) if body.name in finer else -1
                row = (proof_kernels.SKIN, round_row, roots[body.name], WORKCELL_FRAME, frame)
            elif check.first_body is None:
                second = hulls.add(check.hulls[1], check.second_body)
                row = (proof_kernels.BOX, hulls.box(check.contact.other), second, WORKCELL_FRAME, frame)
            else:
                assert check.hulls[0] is not None  # only a box has none, and it belongs to no body
                pair = (hulls.add(check.hulls[0], check.first_body), hulls.add(check.hulls[1], check.second_body))
                row = (proof_kernels.PAIR, *pair, check.first_body.frame, frame)
            rows.append(row)
        packed = hulls.packed(cache)
        skin = packed_skin(patient, skin_triangles, cache)
        self.scene = ProofScene(np.array(rows, dtype=np.int64), skin, spheres, *packed)
        self._on_triangle = settled_kernels.triangle_scratch(self.scene.hulls, STACK)
        self._levers = np.array([joint_levers(model, check) for check in checks])
        self.movers = packed_movers(checks)
        self._work = proof_scratch(len(rows), len(self.scene.hulls.radii))
        self.joint_spans = np.array([(row[0] == proof_kernels.PAIR, row[3], row[4]) for row in rows], dtype=np.int64)

    def __len__(self) -> int:
        return len(self.scene.checks)

    def drop(self, never: Bools) -> None:
        """Drop some checks (k,) for good: the others keep their order."""
        others = ~never
        self.scene = self.scene._replace(checks=self.scene.checks[others])
        self.movers = self.movers._replace(of_check=self.movers.of_check[others])
        self._levers, self.joint_spans = self._levers[others], self.joint_spans[others]
        self._work = proof_scratch(int(others.sum()), len(self.scene.hulls.radii))

    def unproven(
        self, motion: Motion, tested: Bools, clear_mm: float = proof_kernels.MIN_GAP_MM
    ) -> Iterator[tuple[int, int]]:
        """The states of a path, each with the checks, in order, that are not proven clear there.

        Of the ``tested`` (k,) ones; the distance must exceed ``clear_mm``.
        """
        due = np.zeros(len(self), np.int64)
        arguments = (self.scene, self._levers, tuple(motion), self._work, due, tested, clear_mm)
        while (at := int(proof_kernels.first_unproven(*arguments))) >= 0:
            yield divmod(at, len(self))

    def first_not_clear(self, frames: Floats, begins: Ints, tested: Bools, of_state: Ints) -> NotClear:
        """First check of each state that is not proven clear, at or after one.

        Args:
            frames: Shape (m, 7, 4, 4), mm.
            begins: Shape (m,): where to begin; ``len(self)`` to pass a state over.
            tested: Shape (t, k): which checks, in so many choices.
            of_state: Shape (m,): which of the choices.
        """
        not_clear = NotClear(np.empty(len(frames), np.int64), np.empty(len(frames), np.int64))
        settled_kernels.first_not_clear(
            self.scene, frames, self._work, self._on_triangle, tested, of_state, begins, *not_clear
        )
        return not_clear

    def not_clear(self, motion: Motion, tested: Bools) -> Iterator[tuple[int, int, int]]:
        """The states of a path, each with the checks, in order, that are not proven clear there, and their results.

        Of the ``tested`` (k,) ones; results are those of :mod:`puncture_twin.planning.collision.kernels.settled`.
        """
        arguments = (self.scene, self._levers, tuple(motion), self._work, self._on_triangle)
        due = np.zeros(len(self), np.int64)
        while (state := settled_kernels.next_not_clear(*arguments, due, tested))[0] >= 0:
            yield *divmod(int(state[0]), len(self)), int(state[1])

    def clear_about(self, frames: Floats, rotations: Floats, tested: Bools) -> Around:
        """Prove checks clear all about some states.

        Args:
            frames: Shape (m, 7, 4, 4), mm: the states.
            rotations: Shape (6,), rad: how far each joint may rotate either way from each of them.
            tested: Shape (m, k): what is to be proven.
        """
        unproven, gaps = tested.copy(), np.full(tested.shape, np.inf)
        proof_kernels.clear_about(self.scene, self.movers, frames, rotations, self._work, gaps, unproven)
        return Around(gaps <= 0.0, unproven)


Touches = Callable[[int, Floats], bool]

JOINTS_BETWEEN = 2
"""Such pairs see two angles alone, whose square can be searched in full; a cube of three would take too long."""
HALVINGS = 9
"""Halvings of the square of a whole turn each way: down to 0.7 deg, where a UR3's pieces move by about 2 mm."""
QUARTERS = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])
"""Where the middles of a square's quarters lie, in half sides of the square."""


def without_neighbours(model: UrModel, checks: Sequence[Check], proofs: Proofs, cache: Cache) -> tuple[Check, ...]:
    """The checks without pairs that touch at no angle; the proofs are made to test these.

    The answer is cached: it depends on arm and tool alone.
    """
    between = proofs.joint_spans[:, 0] > 0
    pairs = [check.hulls or () for check, pair in zip(checks, between, strict=True) if pair]
    pieces = [hull for pair in pairs for hull in pair if hull is not None]

    def touches(check: int, frames: Floats) -> bool:
        return checks[check].contact_at(frames) is not None

    stored = cache.arrays(
        made_from("never touching", [model.lengths, proofs.joint_spans[between], *pieces]),
        lambda: {"never": never_touching(model, proofs, touches)[between]},
        by=__name__,
    )
    never = between.copy()
    never[between] = stored["never"]
    proofs.drop(never)
    return tuple(check for check, gone in zip(checks, never.tolist(), strict=True) if not gone)


def never_touching(model: UrModel, proofs: Proofs, touches: Touches) -> Bools:
    """Which checks of a cell (k,) are proven clear at every angle: squares of angles, quartered until each is proven.

    Where enclosures overlap, ``touches`` says whether a check's bodies do, at frames (7, 4, 4).
    """
    never = np.zeros(len(proofs), np.bool_)
    spans = proofs.joint_spans
    apart = np.where(spans[:, 0] > 0, spans[:, 2] - spans[:, 1], 0)
    for first in range(6):
        tested = (apart == JOINTS_BETWEEN) & (spans[:, 1] == first)
        if tested.any():
            never |= _clear_all_over(model, proofs, touches, first, tested)
    return never


def _clear_all_over(model: UrModel, proofs: Proofs, touches: Touches, joint: int, tested: Bools) -> Bools:
    """Which of the tested checks (k,) are clear at all angles of two neighbouring joints."""
    middles, half = np.zeros((1, 2)), np.pi
    unproven, touching = tested[None], np.zeros_like(tested)
    for _ in range(HALVINGS):
        q, rotations = np.zeros((len(middles), 6)), np.zeros(6)
        q[:, joint : joint + 2], rotations[joint : joint + 2] = middles, half  # other joints do not matter to the pair
        frames = link_poses(model, q)
        left = proofs.clear_about(frames, rotations, unproven)
        for square, check in np.argwhere(left.touching).tolist():
            touching[check] = touching[check] or touches(check, frames[square])  # FCL decides at the middle
        still = left.unproven & ~touching
        unsettled = still.any(axis=1)
        if not unsettled.any():
            break
        middles = (middles[unsettled, None] + half * QUARTERS).reshape(-1, 2)
        unproven, half = np.repeat(still[unsettled], len(QUARTERS), axis=0), half / 2.0
    else:
        touching |= unproven.any(axis=0)
    return tested & ~touching
