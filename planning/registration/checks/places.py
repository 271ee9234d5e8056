"""Plausibility of a registration's poses: could robot and patient be there, and could the tip have touched a marker?

Physics tells it: nothing stands in a patient, and a patient lies in no box of the robot's frame, but on one. It is
asked however a placement is stated, and of what slipped names or axes would make of it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import fcl
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import NO_MEMORY, Memory
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.case.case import Case, up_axis
from puncture_twin.planning.case.settings import Obstacle
from puncture_twin.planning.collision.bodies import surface, touch
from puncture_twin.planning.geometry.containment import Side, crossings, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply

ALLOWANCE_MM = 30.0
"""A mattress gives way and a box is measured by hand: so deep a patient may lie in one, or to its middle."""
THIN = 0.05
"""Of a box's half size is left of it at least, so that a patient who goes through a thin one is seen."""
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
    """What boxes are, as part of a key."""
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
