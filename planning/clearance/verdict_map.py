"""Verdicts of a grid of directions without distances: the first structure whose margin a needle breaks.

A needle of direction u from the target comes within r of a sphere (centre c from the target, radius R) only if

    angle(u, c) <= asin((R + r) / |c|),    any u where |c| <= R + r,    and none where |c| > R + r + L.

So each triangle visits only the directions of the grid in its own cone; those that are blocked already are passed by,
and a block of 16 triangles in whose cone all are is passed by as a whole. A direction that is left is tested exactly,
by the distance that the fast engine ends with (`segment_triangle`); within `NEAR_THRESHOLD_MM` of a limit the engine's
`collides` decides, as in `engine.too_near`. So every verdict is that of `measure_clearances`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats, Ints32
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.case.entry import AngleGrid
from puncture_twin.planning.clearance.engine import NEAR_THRESHOLD_MM, ROUNDING_MM, ClearanceEngine
from puncture_twin.planning.clearance.kernels.blocks import Blocks
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.segment_triangle import axis_triangle
from puncture_twin.planning.geometry.containment import contains

BLOCKED, FREE, TIED = 0, 1, 2
"""States of a direction while structures are added: blocked, free so far, or so near to a limit that FCL decides."""
SLACK_MM = 1e-3
"""Added to a limit where it decides what is visited: more than `NEAR_THRESHOLD_MM` and all rounding."""
SLACK_RAD = 1e-6
"""By which a cone is widened: more than the rounding of its angles, arcsines close to a right angle included."""
ALL_AROUND_SINE = 0.999
"""Sine of a cone's half-angle from which on all directions are visited."""
CUT_FROM_LIMITS = 4.0
"""Radius of a triangle, in limits, from which on it may be cut: a smaller one costs less than its parts."""
SLIVER_AREA = 0.25
"""Area over radius squared below which a triangle is cut: its cone holds far more directions than it blocks."""
CLOSE_RADIUS = 1.0 / 3.0
"""Radius over distance from the target above which a triangle is cut, for the same reason."""
PARTS = 64
"""Parts of a triangle that wait at most: each cut of the longest edge adds one."""


class VerdictMap:
    """Directions of a grid from one target, blocked by structures that are added one by one.

    Args:
        target_ct: Shape (3,), where every needle ends, mm.
        grid: The directions' angles.
        outward_ct: Shape (n, 3), the directions, unit vectors.
        R_ct_entry: Shape (3, 3), the frame of the angles.

    Attributes:
        structure: Shape (n,), number of the first structure added that blocks each direction; -1 where none does.
    """

    def __init__(self, target_ct: Floats, grid: AngleGrid, outward_ct: Floats, R_ct_entry: Floats) -> None:
        self._target, self._outward = np.array(target_ct, dtype=np.float64), np.array(outward_ct, dtype=np.float64)
        self._frame = np.array(R_ct_entry.T, dtype=np.float64)
        self._angles = (float(grid.theta[0]), float(grid.beta[0]), grid.step)
        self._shape = len(grid.theta), len(grid.beta)
        self.structure: Ints32 = np.full(len(outward_ct), -1, np.int32)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Directions that no structure blocks, shape (n,)."""
        return self.structure < 0

    def add(self, engine: ClearanceEngine, number: int, one: Structure, lengths: Floats, radius: float) -> None:
        """Block the free directions in which a needle comes nearer to a structure than its margin.

        Args:
            engine: Whose structure ``number`` it is; FCL's word in a tie, and its packed blocks.
            lengths: Shape (n,), of the needles from the target, mm.
            radius: Needle radius, mm.
        """
        free, limit = self.free, radius + one.margin_mm
        if not one.demands_margin or not free.any():
            return
        if contains(one.mesh, self._target):
            self.structure[free] = number
            return
        state = free.astype(np.uint8).reshape(self._shape)
        blocks, lengths = engine.blocks[number], np.array(lengths, dtype=np.float64)
        _block(
            blocks.triangles, _spheres(blocks), self._target, self._frame, self._angles, self._outward, lengths,
            float(lengths[free].max()), limit, state, np.int64(LANES),
        )  # fmt: skip
        self.structure[free & (state.ravel() == BLOCKED)] = number
        for row in np.flatnonzero(state == TIED):
            if engine.collides(number, self._target, self._outward[row], float(lengths[row]), limit):
                self.structure[row] = number


def _spheres(blocks: Blocks) -> Floats:
    """Centre and radius of the sphere about each block, shape (b, 4), mm."""
    count = len(blocks.local)
    radius = np.hypot(*blocks.disc[3:, :count].astype(np.float64)) * (1 + 1e-6)
    return np.column_stack([blocks.center[:count], radius])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _block(triangles, spheres, target, frame, angles, outward, lengths, longest, limit, state, lanes):  # type: ignore[no-untyped-def]  # numba infers
    """Set the state of every free direction that a surface blocks, or that ties."""
    reach, waiting = limit + SLACK_MM, np.empty((PARTS, 9))
    for block in range(len(spheres)):
        x, y, z = spheres[block, 0] - target[0], spheres[block, 1] - target[1], spheres[block, 2] - target[2]
        distance, contact_radius = math.sqrt(x * x + y * y + z * z), spheres[block, 3] + reach
        if distance > contact_radius + longest:
            continue
        if not _any_free(state, _window(x, y, z, distance, contact_radius, frame, angles, state.shape)):
            continue
        for row in range(block * lanes, (block + 1) * lanes):
            for k in range(9):
                waiting[0, k] = triangles[row, k] - target[k % 3]
            count = 1
            while count > 0:
                count = _part(waiting, count - 1, reach, frame, angles, outward, lengths, longest, limit, state)


@nb.njit(cache=True, error_model="numpy")
def _part(waiting, last, reach, frame, angles, outward, lengths, longest, limit, state):  # type: ignore[no-untyped-def]  # numba infers
    """Let the last part of a triangle visit its directions, or cut it in two; how many parts wait then."""
    p = waiting[last]
    a, b, c = (p[0], p[1], p[2]), (p[3], p[4], p[5]), (p[6], p[7], p[8])
    m = (a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, (a[2] + b[2] + c[2]) / 3.0
    square = _dot(m, m)
    radius = math.sqrt(max(_square(a, m), _square(b, m), _square(c, m)))
    distance, contact_radius = math.sqrt(square), radius + reach
    if distance > contact_radius + longest:
        return last
    window = _window(m[0], m[1], m[2], distance, contact_radius, frame, angles, state.shape)
    if radius > CUT_FROM_LIMITS * reach and last + 1 < PARTS:
        if not _any_free(state, window):
            return last
        if _area(a, b, c) < SLIVER_AREA * radius * radius or radius > CLOSE_RADIUS * distance:
            return _cut(waiting, last, a, b, c)
    first, end, low, high, around, circles = window
    # Of the middle, squared and with slack for rounding: beyond the first all is free, within the second blocked.
    far2, near2 = (contact_radius * contact_radius) * (1 + 1e-9) + 1e-6, (limit - SLACK_MM) * abs(limit - SLACK_MM)
    sure2, tie2, columns = (limit - ROUNDING_MM) ** 2, (limit + NEAR_THRESHOLD_MM) ** 2, state.shape[1]
    for i in range(first, end):
        for circle in range(circles[0], circles[1] + 1):
            begin, stop = _columns(low, high, around, circle, columns)
            for k in range(begin, stop):
                if state[i, k] == BLOCKED:
                    continue
                n = i * columns + k
                u, length = (outward[n, 0], outward[n, 1], outward[n, 2]), lengths[n]
                along = _dot(u, m)
                s = min(max(along, 0.0), length)
                middle2 = square - 2.0 * s * along + s * s  # of the part's middle from the axis
                if middle2 > far2:
                    continue
                if middle2 < near2:  # the middle is a point of the triangle
                    state[i, k] = BLOCKED
                    continue
                square_distance = axis_triangle(u, length, a, b, c)[0]
                if square_distance < sure2:
                    state[i, k] = BLOCKED
                elif square_distance < tie2:
                    state[i, k] = TIED
    return last


@nb.njit(cache=True, error_model="numpy")
def _window(x, y, z, distance, contact_radius, frame, angles, shape):  # type: ignore[no-untyped-def]  # numba infers
    """Rows and columns of the grid that hold the cone of a sphere.

    A circle of angular radius a about a point of polar angle p spans azimuths of +- asin(sin a / sin p).

    Args:
        distance: Of the sphere's centre (x, y, z) from the target, |c|, mm.
        contact_radius: R + r, within which of the centre a needle comes too near, mm.

    Returns:
        The first row and the row after the last; the first and the last column, not rounded; columns of a full circle;
        and by how many circles these columns are to be displaced, from and to.
    """
    rows, columns, around = shape[0], shape[1], 2.0 * math.pi / angles[2]
    if contact_radius >= ALL_AROUND_SINE * distance:
        return 0, rows, 0.0, columns - 1.0, around, (0, 0)
    ex = frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z
    ey = frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z
    ez = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z
    across = math.sqrt(ex * ex + ey * ey)
    polar, half = math.atan2(across, ez), math.asin(contact_radius / distance) + SLACK_RAD
    first = max(0, math.ceil((polar - half - angles[0]) / angles[2]))
    end = min(rows, math.floor((polar + half - angles[0]) / angles[2]) + 1)
    sine = contact_radius / across
    if half >= polar or half >= math.pi - polar or sine >= ALL_AROUND_SINE:
        return first, end, 0.0, columns - 1.0, around, (0, 0)
    azimuth, half = math.atan2(ey, ex) - angles[1], math.asin(sine) + SLACK_RAD
    low, high = (azimuth - half) / angles[2], (azimuth + half) / angles[2]
    return first, end, low, high, around, (math.ceil(-high / around), math.floor((columns - 1.0 - low) / around))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _columns(low, high, around, circle, columns):  # type: ignore[no-untyped-def]  # numba infers
    """The first column of a window, displaced by full circles, and the column after its last."""
    by = circle * around
    return max(0, math.ceil(low + by)), min(columns, math.floor(high + by) + 1)


@nb.njit(cache=True, error_model="numpy")
def _any_free(state, window):  # type: ignore[no-untyped-def]  # numba infers
    """Whether any direction of a window is not blocked."""
    first, end, low, high, around, circles = window
    for circle in range(circles[0], circles[1] + 1):
        begin, stop = _columns(low, high, around, circle, state.shape[1])
        for i in range(first, end):
            total = 0
            for k in range(begin, stop):
                total |= state[i, k]
            if total != BLOCKED:
                return True
    return False


@nb.njit(cache=True, error_model="numpy")
def _cut(waiting, last, a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    """Cut a triangle across the middle of its longest edge, in place and behind it; how many parts wait then."""
    ab, bc, ca = _square(a, b), _square(b, c), _square(c, a)
    if bc >= ab and bc >= ca:
        a, b, c = b, c, a
    elif ca >= ab:
        a, b, c = c, a, b
    for x in range(3):
        middle = 0.5 * (a[x] + b[x])
        waiting[last, x], waiting[last, 3 + x], waiting[last, 6 + x] = a[x], middle, c[x]
        waiting[last + 1, x], waiting[last + 1, 3 + x], waiting[last + 1, 6 + x] = middle, b[x], c[x]
    return last + 2


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _dot(p, q):  # type: ignore[no-untyped-def]  # numba infers
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _square(p, q):  # type: ignore[no-untyped-def]  # numba infers
    x, y, z = p[0] - q[0], p[1] - q[1], p[2] - q[2]
    return x * x + y * y + z * z


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _area(a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    dx, dy, dz, ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
    return 0.5 * math.sqrt(x * x + y * y + z * z)
