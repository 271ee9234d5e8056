"""Compiled proofs that parts of an arm are clear, check by check, at states and in boxes of joint angles about them.

Each bound is a lower bound of a distance, mm: above ``MIN_GAP_MM`` it proves that nothing touches; else it proves
nothing. The bounds of two hulls are in `hulls`, those of a body and the skin in `surfaces`. Along a path a gap proves
more than one state: it holds until the bodies may have moved by as much (`first_unproven`).
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free, nb
from puncture_twin.planning.collision.kernels.hulls import Hulls, hull_gap
from puncture_twin.planning.collision.kernels.surfaces import STACK, moved, skin_gap

SKIN, BOX, PAIR = 0, 1, 2
"""Kinds of checks: body against skin, hull against a box of the workcell, hull against hull."""
MIN_GAP_MM = 1e-3
"""What a gap must exceed to prove anything: far above the rounding of these sums (1e-10 mm) and FCL's tolerance."""
ENOUGH_MM = 12.0
"""Gap from which on no tighter bound is sought along a path: the larger a gap, the later the check is due again."""
FAR_MM = 200.0
"""Distance from the skin up to which a search is worth it: larger ones are reported as this."""


class SkinTree(NamedTuple):
    """The patient's surface."""

    tree: tuple[Floats, Floats, Floats]
    """Lowest and highest corners of its boxes and the triangles' corners: see :class:`TriangleTree`."""
    field: NDArray[np.float32]
    """Shape (i, j, k), mm: distances of the middles of cells; NaN where not computed yet."""
    origin: Floats  # shape (3,), mm: the lowest corner of the field
    outside: NDArray[np.bool_]
    """Shape (leaves, k): which of the tree's triangles are no skin but what the CT shows besides."""


class ProofScene(NamedTuple):
    """The checks of a workcell, and the geometry of what they compare."""

    checks: Ints
    """Shape (k, 5): kind, first, second, and the frames of both. Both are rows of hulls; for ``SKIN`` the first is that
    of a round body, -1 for others, and the second the row of the body's root among the spheres."""
    skin: SkinTree
    spheres: tuple[Floats, Floats, Ints]
    """Centres, radii and children of all bodies' trees of bounding spheres, each in the frame of its body."""
    hulls: Hulls
    T_box_base: Floats  # shape (h, 4, 4): by hull, where it is a box
    halves: Floats  # shape (h, 3), mm: the box's half sizes; -1 where it is none


class Movers(NamedTuple):
    """The moving body of each check, and a sphere about it in the frame that it moves with."""

    of_check: Ints
    frames: Ints
    centres: Floats
    radii: Floats


class ProofScratch(NamedTuple):
    """Scratch of the search for a proof, and where each check's last search ended: see :func:`proof_scratch`."""

    axes: Floats
    """Shape (k, 3): each check's last separating direction, with which the next search begins; zero for none."""
    corners: Ints  # shape (k, 2): the corners of its last search
    spheres: Floats  # shape (h, 3), mm: where the centres of the hulls' spheres are
    stack: Ints
    inner_stack: Ints
    M: Floats
    S: Floats


@nb.njit(cache=True)
def proof_scratch(checks, hulls):
    """Scratch for so many checks and hulls."""
    axes, corners, spheres = np.zeros((checks, 3)), np.zeros((checks, 2), np.int64), np.empty((hulls, 3))
    stacks = np.empty(STACK, np.int64), np.empty(STACK, np.int64)
    return ProofScratch(axes, corners, spheres, stacks[0], stacks[1], np.empty((3, 4)), np.empty((4, 3)))


@allocation_free()
def place_sphere(hulls, frames, hull, spheres):
    """Fill a row of ``spheres`` (h, 3) with the centre of a hull's sphere, the arm standing at ``frames`` (7, 4, 4)."""
    frame = hulls.frames[hull]
    x, y, z = hulls.centres[hull, 0], hulls.centres[hull, 1], hulls.centres[hull, 2]
    for i in range(3):
        along = frames[frame, i, 0] * x + frames[frame, i, 1] * y + frames[frame, i, 2] * z
        spheres[hull, i] = along + frames[frame, i, 3]


@allocation_free()
def place_spheres(hulls, frames, spheres):
    """Fill all rows of ``spheres``, see :func:`place_sphere`."""
    for hull in range(len(spheres)):
        place_sphere(hulls, frames, hull, spheres)


@allocation_free()
def sphere_gap(is_box, first, second, spheres, radii, T_box_base, halves):
    """Lower bound on the distance of two hulls: of their spheres, or of a box and a sphere."""
    x, y, z = spheres[second, 0], spheres[second, 1], spheres[second, 2]
    squared = 0.0
    if is_box:
        for i in range(3):
            along = T_box_base[first, i, 0] * x + T_box_base[first, i, 1] * y + T_box_base[first, i, 2] * z
            squared += max(0.0, abs(along + T_box_base[first, i, 3]) - halves[first, i]) ** 2
        return math.sqrt(squared) - radii[second]
    squared = (x - spheres[first, 0]) ** 2 + (y - spheres[first, 1]) ** 2 + (z - spheres[first, 2]) ** 2
    return math.sqrt(squared) - radii[first] - radii[second]


@allocation_free()
def _between(A, B, M):
    """Fill ``M`` (3, 4) with the upper rows of inv(A) B, for poses A and B (4, 4)."""
    for i in range(3):
        M[i, 3] = 0.0
        for k in range(3):
            M[i, 3] += A[k, i] * (B[k, 3] - A[k, 3])
            M[i, k] = A[0, i] * B[0, k] + A[1, i] * B[1, k] + A[2, i] * B[2, k]


@allocation_free()
def near_gap(scene, work, at, frames, enough, far, needed):
    """Lower bound on the distance of the bodies of check ``at``, the arm at ``frames`` (7, 4, 4), mm.

    The search ends where the bound cannot come above ``needed``. ``TOUCHING`` says that they certainly touch. See
    :func:`skin_gap` and :func:`hull_gap`.
    """
    kind, second, frame_a, frame_b = scene.checks[at, 0], scene.checks[at, 2], scene.checks[at, 3], scene.checks[at, 4]
    if kind == SKIN:
        stacks = work.stack, work.inner_stack
        gap = skin_gap(scene.skin, scene.spheres, second, frames[frame_b], enough, far, needed, stacks[0], stacks[1])
        return gap if gap > needed else 0.0
    _between(frames[frame_a], frames[frame_b], work.M)
    return hull_gap(scene.hulls, scene.checks[at, 1], second, work.M, work.axes[at], work.corners[at], needed, work.S)


@allocation_free(inline="always")
def state_gap(scene, work, at, frames, enough, far, needed):
    """Lower bound as :func:`near_gap`, or that of the bounding spheres where it is above ``enough``, which is faster.

    ``work.spheres`` must be filled by :func:`place_spheres`.
    """
    kind, first, second = scene.checks[at, 0], scene.checks[at, 1], scene.checks[at, 2]
    if kind != SKIN:
        boxes, spheres = (scene.T_box_base, scene.halves), (work.spheres, scene.hulls.radii)
        gap = sphere_gap(kind == BOX, first, second, spheres[0], spheres[1], boxes[0], boxes[1])
        if gap > enough:
            return gap
    return near_gap(scene, work, at, frames, enough, far, needed)


@allocation_free()
def _moved_apart(checks, levers, motion, at, row):
    """Upper bound on how far the bodies of a check have moved against one another since a path's first state, mm."""
    kind, frame_a, frame_b = checks[at, 0], checks[at, 3], checks[at, 4]
    _, moved_mm, rotated = motion
    if kind != PAIR:  # the other body, skin or box, stays where it is
        return moved_mm[row, frame_b]
    path = 0.0
    for joint in range(frame_a, frame_b):  # only the joints between them move two bodies of the arm apart
        path += levers[at, joint] * rotated[row, joint]
    return path


@allocation_free()
def _due(checks, levers, motion, at, row, proven):
    """The first state after ``row`` at which the bodies of a check may have moved by ``proven``, mm, or more.

    Found by halving, for the bound on their motion never falls. The number of states where there is none.
    """
    low, high = row + 1, len(motion[0])
    while low < high:
        middle = (low + high) // 2
        if _moved_apart(checks, levers, motion, at, middle) < proven:
            low = middle + 1
        else:
            high = middle
    return low


@allocation_free()
def _earliest(due, tested):
    """The first state at which a check that is tested is due."""
    earliest = np.iinfo(np.int64).max
    for at in range(len(due)):
        if tested[at]:
            earliest = min(earliest, due[at])
    return earliest


@allocation_free()
def first_unproven(scene, levers, motion, work, due, tested, clear_mm):
    """The next state and check, in order, that the bounds do not prove to be more than ``clear_mm`` apart.

    A check whose gap was g stays clear until its two bodies have moved by g - ``clear_mm`` against one another
    (conservative advancement): there it is due again. One that is not proven is due at the next state, so that a
    further call goes on from there.

    Args:
        levers: Shape (k, 6), mm: how far a radian of each joint may move the two bodies of a PAIR.
        motion: (frames, moved, rotated), with
            frames: Shape (m, 7, 4, 4), mm: the states;
            moved: Shape (m, 7), mm: how far each frame's bodies may have moved since the first state; rising;
            rotated: Shape (m, 6), rad: how far each joint has rotated since the first state; rising.
        due: Shape (k,): the state at which each check is due; 0 at the beginning.
        tested: Shape (k,): which checks.
        clear_mm: ``MIN_GAP_MM``, or any other distance that is wanted.

    Returns:
        state * k + check; -1 where all that is left is clear.
    """
    frames, checks = motion[0], scene.checks
    enough, far = (clear_mm + ENOUGH_MM, clear_mm + FAR_MM) if len(frames) > 1 else (clear_mm, clear_mm + MIN_GAP_MM)
    row = _earliest(due, tested)
    while row < len(frames):  # states at which no check is due are skipped
        place_spheres(scene.hulls, frames[row], work.spheres)
        for at in range(len(checks)):
            if not tested[at] or due[at] > row:
                continue
            gap = state_gap(scene, work, at, frames[row], enough, far, clear_mm)
            if gap <= clear_mm:
                due[at] = row + 1
                return row * len(checks) + at
            proven = _moved_apart(checks, levers, motion, at, row) + gap - clear_mm
            due[at] = _due(checks, levers, motion, at, row, proven)
        row = _earliest(due, tested)
    return -1


@allocation_free()
def paths_about(frames, body_frame, centre, radius, rotations, fraction, paths):
    """Fill ``paths`` (7,), mm: how far a body may move while joints rotate by a fraction of ``rotations`` (6,), rad.

        paths[j] = paths[j + 1] + fraction rotations[j] (distance of centre and axis j + radius + paths[j + 1])

    Entry j bounds the motion against the frame before joint j, either way from the arm at ``frames`` (7, 4, 4): a point
    is no farther from axis j than its body's bounding sphere, plus what the joints beyond j have moved it.
    """
    x, y, z = moved(frames[body_frame], centre)
    paths[body_frame] = 0.0
    for joint in range(body_frame - 1, -1, -1):
        dx, dy, dz = x - frames[joint, 0, 3], y - frames[joint, 1, 3], z - frames[joint, 2, 3]
        ax, ay, az = frames[joint, 0, 2], frames[joint, 1, 2], frames[joint, 2, 2]
        cx, cy, cz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
        lever = math.sqrt(cx * cx + cy * cy + cz * cz) + radius + paths[joint + 1]
        paths[joint] = paths[joint + 1] + fraction * rotations[joint] * lever


@nb.njit(cache=True)
def clear_about(scene, movers, frames, rotations, work, gaps, unproven):
    """Prove checks clear in boxes of joint angles: wherever each joint is within ``rotations`` of some states.

    Args:
        frames: Shape (m, 7, 4, 4), mm: the states.
        rotations: Shape (6,), rad.
        gaps: Shape (m, k): filled, for what is tested, with the bound at the state itself, or ``TOUCHING``.
        unproven: Shape (m, k): True where a check is to be tested; set to False where it is proven clear.
    """
    paths = np.empty(7)
    for row in range(len(frames)):
        for at in range(len(scene.checks)):
            if unproven[row, at]:
                mover = movers.of_check[at]
                sphere = movers.centres[mover], movers.radii[mover]
                paths_about(frames[row], movers.frames[mover], sphere[0], sphere[1], rotations, 1.0, paths)
                path = paths[scene.checks[at, 3]] + MIN_GAP_MM
                gaps[row, at] = near_gap(scene, work, at, frames[row], path, path + MIN_GAP_MM, path)
                unproven[row, at] = gaps[row, at] <= path
