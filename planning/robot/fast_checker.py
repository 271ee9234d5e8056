"""The same verdicts as :class:`CellChecker`, sooner: FCL is asked only where balls and planes prove nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.mesh import TriangleMesh
from planning.robot import proof_kernels
from planning.robot.bodies import Body
from planning.robot.cell import NEEDLE_IN_PATIENT, CellChecker, Check, Contact, Met, require_finite
from planning.robot.enclosures import ball_tree, coarse_hull, enclosing_ball
from planning.robot.kinematics import link_poses
from planning.robot.shapes import touch
from planning.robot.sweep import SweptBodies
from planning.robot.tool import Box, Tool
from planning.robot.triangle_tree import TriangleTree
from planning.robot.ur import UrModel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
_Axes = tuple[Array, Array, Array]

ROOM_FRAME = 0
"""The frame of what does not move: the base's."""

NO_BOX = -1.0
"""Half sizes of what is no box."""


class FastChecker(CellChecker):
    """Asks FCL the questions of :class:`CellChecker` that cheap lower bounds on the distances leave open.

    The questions come in the same order and their answers are FCL's or proven, so each verdict is the same, down to the
    contact that is named (docs/arm.md). Distances are FCL's. Not for several threads at once.

    Args:
        model: See :class:`CellChecker`.
        tool: The same.
        boxes: The same.
        patient: The same.
        padding_mm: The same.

    Raises:
        InputError: The same.
    """

    def __init__(
        self,
        model: UrModel,
        tool: Tool,
        boxes: Sequence[Box] = (),
        patient: TriangleMesh | None = None,
        *,
        padding_mm: float = 0.0,
    ) -> None:
        super().__init__(model, tool, boxes, patient, padding_mm=padding_mm)
        self._swept_full = SweptBodies.of(model, tool, padding_mm)
        self._proofs = _Proofs(model, self._checks, boxes, patient)
        self._still = (np.zeros((1, 7)), np.zeros((1, 6)))
        allowed = [i for i, check in enumerate(self._checks) if check.contact == NEEDLE_IN_PATIENT]
        self._needle_check = allowed[0] if allowed else -1

    def contact(self, q: Array, *, needle_may_touch_patient: bool) -> Contact | None:
        """See :meth:`CellChecker.contact`."""
        met = self.first_contact(np.asarray(q)[None], needle_may_touch_patient=needle_may_touch_patient)
        return None if met is None else met.contact

    def first_contact(self, q_path: Array, *, needle_may_touch_patient: bool) -> Met | None:
        """See :meth:`CellChecker.first_contact`."""
        path = np.asarray(q_path, dtype=np.float64)
        require_finite(path)
        motion = self._motion(path)
        skip = self._needle_check if needle_may_touch_patient else -1
        open_at = self._proofs.first_unproven(motion, 0, skip)
        while open_at >= 0:
            index, check = divmod(open_at, len(self._checks))
            if self._touches(self._checks[check], motion.frames[index]):
                return Met(index, self._checks[check].contact)
            open_at = self._proofs.first_unproven(motion, open_at + 1, skip)
        return None

    def open_checks(self, q: Array, *, needle_may_touch_patient: bool) -> list[Contact]:
        """The questions at ``q`` (6,) that are left to FCL."""
        motion = self._motion(np.asarray(q, dtype=np.float64)[None])
        skip = self._needle_check if needle_may_touch_patient else -1
        found, open_at = [], self._proofs.first_unproven(motion, 0, skip)
        while open_at >= 0:
            found.append(self._checks[open_at].contact)
            open_at = self._proofs.first_unproven(motion, open_at + 1, skip)
        return found

    def _motion(self, path: Array) -> _Motion:
        if len(path) <= 1:
            return _Motion(link_poses(self.model, path), *self._still)
        moved, turned = np.zeros((len(path), 7)), np.zeros((len(path), 6))
        np.cumsum(self._swept_full.bounds_mm(path), axis=0, out=moved[1:, 1:])
        np.cumsum(np.abs(np.diff(path, axis=0)), axis=0, out=turned[1:])
        return _Motion(link_poses(self.model, path), moved, turned)

    def _touches(self, check: Check, poses: Array) -> bool:
        check.second.setTransform(check.second_body.pose(poses))
        if check.first_body is not None:
            check.first.setTransform(check.first_body.pose(poses))
        return touch(check.first, check.second)


class _Motion(NamedTuple):
    """A path as the compiled code takes it, see :func:`proof_kernels.first_unproven`."""

    frames: Array
    moved: Array
    turned: Array


class _Proofs:
    """Checks as the compiled code takes them, with its scratch."""

    def __init__(
        self, model: UrModel, checks: Sequence[Check], boxes: Sequence[Box], patient: TriangleMesh | None
    ) -> None:
        skin = _skin(patient)
        roots, balls = _trees([check.second_body for check in checks if check.hulls is None])
        hulls = _Hulls(boxes)
        rows = []
        for check in checks:
            frame = check.second_body.frame
            if check.hulls is None:
                row = (proof_kernels.SKIN, -1, roots[check.second_body.name], ROOM_FRAME, frame)
            elif check.first_body is None:
                second = hulls.add(check.hulls[1], check.second_body)
                row = (proof_kernels.BOX, hulls.box(check.contact.other), second, ROOM_FRAME, frame)
            else:
                assert check.hulls[0] is not None  # only a box has none, and it belongs to no body
                pair = (hulls.add(check.hulls[0], check.first_body), hulls.add(check.hulls[1], check.second_body))
                row = (proof_kernels.PAIR, *pair, check.first_body.frame, frame)
            rows.append(row)
        points, coarse, packed, cuboids = hulls.packed()
        levers = np.array([_levers(model, check) for check in checks])
        self._scene = (np.array(rows, dtype=np.int64), levers, skin, balls, points, coarse, packed, cuboids)
        self._axes = np.zeros((len(rows), 3))
        self._proven = np.empty(len(rows))

    def first_unproven(self, motion: _Motion, begin: int, skip: int) -> int:
        """The first check at or after ``begin``, counted as state * checks + check, that is not proven; -1 for none.

        Args:
            motion: The states, in order.
            begin: 0 for a new path.
            skip: A check to leave out; -1 for none.
        """
        if begin == 0:
            self._proven.fill(-np.inf)
        state, check = divmod(begin, len(self._proven))
        kernel = proof_kernels.first_unproven
        return int(kernel(self._scene, tuple(motion), self._axes, self._proven, state, check, skip))


def _levers(model: UrModel, check: Check) -> Array:
    """How far a turn of each joint (6,) may move the second body against the first, mm/rad.

    A body's point is no farther from a joint's axis than the links between reach, end to end, and the body itself.
    Only the joints between the two bodies move them against one another.
    """
    levers = np.zeros(6)
    if check.hulls is None or check.first_body is None:
        return levers
    body = check.second_body
    own = np.linalg.norm(check.hulls[1] @ body.T_frame_body[:3, :3].T + body.T_frame_body[:3, 3], axis=1).max()
    lengths = np.hypot(model.a, model.d)
    for joint in range(check.first_body.frame, body.frame):
        levers[joint] = abs(model.a[joint]) + lengths[joint + 1 : body.frame].sum() + own
    return levers


class _Hulls:
    """Convex hulls, each once: the boxes first."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._rows: dict[int, int] = {}
        self._boxes = list(boxes)
        self._names = {box.name: row for row, box in enumerate(boxes)}
        self._corners = [box.corners for box in boxes]

    def box(self, name: str) -> int:
        """Row of the box of that name."""
        return self._names[name]

    def add(self, corners: Array, body: Body) -> int:
        """Row of a hull of a body, which is added if it is new."""
        row = self._rows.setdefault(id(corners), len(self._corners))
        if row == len(self._corners):
            self._corners.append(corners @ body.T_frame_body[:3, :3].T + body.T_frame_body[:3, 3])
        return row

    def packed(self) -> tuple[_Axes, _Axes, tuple[Indices, Array, Array, Indices, Array], tuple[Array, Array]]:
        """``points``, ``coarse``, ``hulls`` and ``boxes`` of :func:`proof_kernels.hull_gap`."""
        balls = [enclosing_ball(corners) for corners in self._corners]
        centres, radii = np.array([ball.centre for ball in balls]), np.array([ball.radius for ball in balls])
        coarse = [coarse_hull(corners) for corners in self._corners]
        few, slack = [hull.corners for hull in coarse], np.array([hull.slack_mm for hull in coarse])
        poses, halves = np.tile(np.eye(4), (len(balls), 1, 1)), np.full((len(balls), 3), NO_BOX)
        for row, box in enumerate(self._boxes):
            poses[row], halves[row] = np.linalg.inv(box.T_base_box), np.asarray(box.size_mm) / 2.0
        hulls = (_starts(self._corners), centres, radii, _starts(few), slack)
        return _axes(self._corners), _axes(few), hulls, (poses, halves)


def _starts(hulls: Sequence[Array]) -> Indices:
    return np.cumsum([0] + [len(corners) for corners in hulls])


def _axes(hulls: Sequence[Array]) -> _Axes:
    x, y, z = (np.ascontiguousarray(axis) for axis in np.concatenate(hulls).T)
    return x, y, z


def _skin(patient: TriangleMesh | None) -> tuple[Array, Array, Array]:
    """The skin's tree, or one that no check asks for."""
    if patient is None:
        return np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 1, 3, 3))
    tree = TriangleTree.of(patient)
    return tree.lows, tree.highs, tree.corners


def _trees(bodies: Sequence[Body]) -> tuple[dict[str, int], tuple[Array, Array, Indices]]:
    """The balls of the bodies' full shapes, each in the body's frame, and the row of each body's root."""
    roots: dict[str, int] = {}
    centres, radii, children = [np.empty((0, 3))], [np.empty(0)], [np.empty((0, 2), np.int64)]
    for body in bodies:
        T = body.T_frame_body
        tree = ball_tree([hull @ T[:3, :3].T + T[:3, 3] for hull in body.full.hulls])
        start = sum(len(part) for part in radii)
        roots[body.name] = start
        centres.append(tree.centres)
        radii.append(tree.radii)
        children.append(np.where(tree.children < 0, -1, tree.children + start))
    return roots, (np.concatenate(centres), np.concatenate(radii), np.concatenate(children))
