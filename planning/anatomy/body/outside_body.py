"""What a CT shows outside of the body that is not air: table, mattress, clothes, lines, limbs that nobody recognised.

None of it is free space for a needle, its holder or the arm. It becomes one closed surface of role ``unknown``,
checked by the same engine as every organ, along the whole needle while it waits at its standoff.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.body_mask import BODY_HU
from puncture_twin.planning.anatomy.body.tables import TableSide
from puncture_twin.planning.anatomy.body.unscanned import Unscanned, find_unscanned
from puncture_twin.planning.base.arrays import Bools, Floats, Ints32, widened
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.formats.labels.label_surface import box_in, mask_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh, box, joined
from puncture_twin.planning.geometry.parts import parts_of
from puncture_twin.planning.geometry.rigid import apply, pose

SMOOTH_MM = 3.0
"""Means over a cube of this edge are compared with air: noise of a finer image falls below that of 3 mm voxels."""
LEAST_HU = -1024.0
"""What is below counts as this in a mean: some scanners write less than air has."""
DENSE_HU = -700.0
"""A single voxel above this is no noise (ten times that of a low-dose image)."""
MIN_PIECE_MM3 = 100.0
"""Pieces that hold less above ``BODY_HU`` are noise, or cloth: a full line of 4 mm diameter has this in 8 mm of its
length. A gown on the skin of a real chest has -850, and -600 in its folds; it stops no needle. So has a line with a
bore (4 and 2.6 mm) in voxels of 2 mm and more, and one of 2 mm in any: it is not seen."""
BULKY_ML = 50.0
"""Pieces of this volume that the border of the image cuts (a table, a mattress) go on beyond it, also between the
places where they are cut: of a table that sags below the image both ends are seen."""
BEYOND_MM = (100.0, 100.0, 2000.0)
"""How far what the border cuts is taken to go on to the sides, to front and back, and along the bed. A CT table is at
most 550 mm wide and an image at least 350; along the bed table and mattress go on farther than a needle reaches."""
BEYOND_LONG_MM = (*BEYOND_MM[:2], 1000.0)
"""`BEYOND_MM` where an image is so long that the surface would be larger than any that is plausible."""
CUT_AT_MM = (30.0, 120.0, 480.0)
"""What goes on along the bed is cut across so far beyond the image: a triangle as long as all of it would lie near
every needle, and the search would measure most axes from most of them."""
RIM_MM = 50.0
"""Where what is dense ends at voxels that were not scanned, they count as dense so far from it."""


@dataclass(frozen=True, eq=False)
class OutsideImage:
    """A CT beside its body, axes running to the left, back and head.

    Attributes:
        hu: Shape (nx, ny, nz), Hounsfield units.
        body: Same shape, the body.
        T_ct_index: Shape (4, 4), voxel index to LPS mm.
        spacing_mm: Shape (3,).
        beyond_mm: How far what the border cuts is taken to go on.
        measured: What was not measured, where it was found before.
    """

    hu: NDArray[Any]
    body: Bools
    T_ct_index: Floats
    spacing_mm: Floats
    beyond_mm: tuple[float, float, float] = BEYOND_MM
    measured: Unscanned | None = None

    @cached_property
    def unscanned(self) -> Unscanned:
        """What was not measured."""
        return self.measured or find_unscanned(self.hu)


def outside_mask(image: OutsideImage, air_hu: float) -> Bools:
    """Voxels outside of the body that are not air.

    Beside the body's surface a voxel, or the mean about it, is partly skin, partly air; there only what is denser than
    half of both counts.

    Args:
        image: The CT and its body.
        air_hu: Voxels whose surroundings are denser than this are not air.
    """
    hu, body, unscanned = image.hu, image.body, image.unscanned
    size = np.maximum(1, np.round(SMOOTH_MM / image.spacing_mm)).astype(np.int64)
    dense = np.zeros(hu.shape, bool)
    plain_hu, plain_body = (np.require(one, requirements=["C", "W"]) for one in (hu, body))
    _mark_dense(plain_hu, plain_body, size, float(air_hu), dense)
    if not unscanned.voxels.any():
        return _stiff_pieces(dense, hu, image.spacing_mm)
    dense = _stiff_pieces(dense & ~unscanned.voxels, hu, image.spacing_mm)
    return dense | (_unscanned_beside(dense | body, body, unscanned, image.spacing_mm) & ~body)


@nb.njit(cache=True)
def _mark_dense(hu, body, size, air_hu, dense):  # type: ignore[no-untyped-def]  # numba infers
    """Set what is no air beside the body: by itself, and farther off by the mean over a cube of ``size`` voxels too."""
    ni, nj, nk = hu.shape
    before, after = size // 2, (size - 1) // 2
    least, alone = np.float32(LEAST_HU), max(DENSE_HU, air_hu)
    sums, wide = np.empty(nk, np.float32), np.empty(nk, np.uint8)
    for i in range(ni):
        for j in range(nj):
            wide[:] = 0
            for x in range(max(0, i - before[0] - 1), min(ni, i + before[0] + 2)):
                for y in range(max(0, j - before[1] - 1), min(nj, j + before[1] + 2)):
                    for k in range(nk):
                        wide[k] |= body[x, y, k]
            for k in range(nk):
                dense[i, j, k] = hu[i, j, k] > BODY_HU and not body[i, j, k]
            if wide.all():
                continue
            sums[:] = 0.0
            for x in range(i - before[0], i + after[0] + 1):
                for y in range(j - before[1], j + after[1] + 1):
                    line = hu[min(max(x, 0), ni - 1), min(max(y, 0), nj - 1)]
                    for k in range(nk):
                        sums[k] += max(np.float32(line[k]), least)
            for k in range(nk):
                mean = np.float32(0.0)
                for z in range(k - before[2], k + after[2] + 1):
                    mean += sums[min(max(z, 0), nk - 1)]
                if mean > air_hu * size.prod() or hu[i, j, k] > alone:
                    beside = wide[max(0, k - before[2] - 1) : k + before[2] + 2].any()
                    dense[i, j, k] |= not beside


def outside_surface(image: OutsideImage, mask: Bools, *, where: str | Path) -> TriangleMesh | None:
    """The closed surface of what is dense outside of the body, LPS mm; None where there is only air.

    Where the border of the image cuts it, it goes on beyond: every cut section is drawn out by ``beyond_mm``, and of
    bulky pieces also the convex hull of all cut sections at one side.

    Args:
        image: The CT and its body.
        mask: Of `outside_mask`.
        where: The file, for messages.
    """
    if not mask.any():
        return None
    beyond = _layers_mm(image)
    layered = np.pad(mask, [(len(layers), len(layers)) for layers in beyond], mode="edge")
    T_ct_layered = image.T_ct_index @ pose(np.eye(3), [-float(len(layers)) for layers in beyond])
    drawn = _drawn_out(mask_surface(layered, T_ct_layered, where=where), image)
    return joined([drawn, *_hulls_beyond(mask & ~image.unscanned.padded, image)])


def beyond_face(image: OutsideImage, axis: int, end: int, *, wider_mm: float = 0.0) -> TriangleMesh:
    """A box beyond a whole face of the image, at the low (0) or high (-1) end of an axis, and so much wider."""
    low, high = np.full(3, -0.5) - wider_mm / image.spacing_mm, image.hu.shape + wider_mm / image.spacing_mm - 0.5
    away = image.beyond_mm[axis] / image.spacing_mm[axis]
    near = -0.5 if end == 0 else image.hu.shape[axis] - 0.5
    low[axis], high[axis] = (near - away, near) if end == 0 else (near, near + away)
    return _box(low, high, image)


def _box(low: Floats, high: Floats, image: OutsideImage) -> TriangleMesh:
    """A box between two corners, voxels."""
    return box(image.T_ct_index @ pose(np.eye(3), (low + high) / 2), high - low)


def beyond_table(image: OutsideImage, side: TableSide) -> TriangleMesh:
    """Voxels beyond a section drawn along the bed: the table's far side, and its continuation along the bed.

    Where its edges count as table, what is beyond it goes on to both sides, from ``edge_mm`` before the section: what
    comes out of an edge is not free.

    Args:
        image: The CT and its body.
        side: The section.
    """
    edges = side.edge_mm is not None
    along_mm, across_mm, step_mm = (float(image.spacing_mm[axis]) for axis in (side.axis, 1 - side.axis, 2))
    outward = 1.0 if side.end else -1.0
    away, edge = (
        image.beyond_mm[1 - side.axis] / across_mm if edges else 1.0,
        outward * (side.edge_mm or 0.0) / along_mm,
    )
    last = image.hu.shape[1 - side.axis] - 1.0 if edges else 0.0
    before = [min(0.0 if edges else np.inf, side.across[0]) - away, side.across[0] - 0.5]
    after = [side.across[-1] + 0.5, max(last, side.across[-1]) + away]
    across = np.concatenate([before, side.across, after])
    along = np.concatenate([np.full(2, side.along[0] - edge), side.along, np.full(2, side.along[-1] - edge)])
    far = (image.hu.shape[side.axis] - 1.0 if side.end else 0.0) + outward * image.beyond_mm[side.axis] / along_mm
    beyond = np.array([0.0, *CUT_AT_MM, image.beyond_mm[2]]) / step_mm
    slices = np.unique(np.concatenate([-beyond, image.hu.shape[2] - 1.0 + beyond]))
    sink = outward * abs(side.slope[1]) * float(np.abs(slices).max())
    rows = [_row(side, across, values, z) for z in slices for values in (along, np.full(len(along), far + sink))]
    index = np.concatenate(rows)
    T = image.T_ct_index
    vertices = apply(T, index)
    return TriangleMesh(vertices, _outward_faces(vertices, len(across)))


def _row(side: TableSide, across: Floats, along: Floats, at_slice: float) -> Floats:
    """Voxel indices (n, 3) of points in one slice of a bed that may run at an angle to the slices' axis."""
    index = np.empty((len(across), 3))
    index[:, side.axis] = along + side.slope[1] * at_slice
    index[:, 1 - side.axis] = across + side.slope[0] * at_slice
    index[:, 2] = at_slice
    return index


def _outward_faces(vertices: Floats, n: int) -> Ints32:
    """Triangles of a strip's prism: near and far row (n vertices each) of each of its sections, from end to end."""
    i, j = np.arange(n - 1), np.arange(1, n)
    last = len(vertices) - 2 * n
    ends = [np.stack([i, j, j + n, i + n], axis=1), np.stack([i, i + n, j + n, j], axis=1) + last]
    between = np.concatenate(
        [
            np.stack([i, i + 2 * n, j + 2 * n, j], axis=1),
            np.stack([i + n, j + n, j + 3 * n, i + 3 * n], axis=1),
            np.array([[0, n, 3 * n, 2 * n], [3 * n - 1, 4 * n - 1, 2 * n - 1, n - 1]]),
        ]
    )
    corners = np.concatenate([*ends, *(between + first for first in range(0, last, 2 * n))])
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]).astype(np.int32)
    return _facing_outward(vertices, faces)


def _facing_outward(vertices: Floats, faces: Ints32) -> Ints32:
    """Triangles that are wound alike, seen counter-clockwise from outside.

    Surfaces that overlap are joined: where one looked inward, or was wound against itself, what lies in both would
    count as outside.
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = float(np.einsum("ij,ij->", a, np.cross(b, c))) < 0.0
    return faces[:, ::-1] if inward else faces


def _stiff_pieces(mask: Bools, hu: NDArray[Any], spacing_mm: Floats) -> Bools:
    """The pieces that are bulky, and of others what is solid with its rim: the rest is noise, or cloth on the skin."""
    stiff = _bulky(mask, spacing_mm)
    solid = hu > BODY_HU
    solid &= mask
    if not solid.any():
        return stiff
    box = box_in(solid, margin=2)
    near = parts_of(widened(solid[box], (1, 1, 1)), corners=True)
    large = near.counts(solid[box]) >= MIN_PIECE_MM3 / np.prod(spacing_mm)
    stiff[box] |= widened(near.painted(large), (1, 1, 1)) & mask[box]
    return stiff


def _bulky(mask: Bools, spacing_mm: Floats) -> Bools:
    found = parts_of(mask, corners=True)
    return found.painted(found.sizes * np.prod(spacing_mm) >= 1000.0 * BULKY_ML)


def _unscanned_beside(dense: Bools, body: Bools, unscanned: Unscanned, spacing_mm: Floats) -> Bools:
    """Voxels that were not scanned, near to where something dense ends at them.

    A padding that cuts the body is not free anywhere, as what is beyond a face of the image that cuts it.
    """
    ends = widened(dense, (1, 1, 1)) & unscanned.voxels & ~body
    if not ends.any():
        return np.zeros_like(dense)
    beside, box = np.zeros_like(dense), box_in(ends, np.ceil(RIM_MM / spacing_mm).astype(int))
    beside[box] = scipy.ndimage.distance_transform_edt(~ends[box], sampling=spacing_mm) <= RIM_MM
    beside &= unscanned.voxels
    cut = unscanned.padded & widened(body, (1, 1, 1))
    return beside | unscanned.padded if cut.any() else beside


def _layers_mm(image: OutsideImage) -> tuple[tuple[float, ...], ...]:
    """How far beyond its border voxels' centres an image is continued by layers of voxels, along each axis.

    The last layer is where what is drawn out ends: up to there it keeps its width.
    """
    to_side, to_back, along = image.beyond_mm
    return (to_side,), (to_back,), (*CUT_AT_MM, along)


def _drawn_out(surface: TriangleMesh, image: OutsideImage) -> TriangleMesh:
    """The surface with the layers beyond its border voxels' centres, and its caps half a voxel after, moved outward."""
    T = image.T_ct_index
    index = np.linalg.solve(T[:3, :3], (surface.vertices - T[:3, 3]).T).T
    for axis, layers_mm in enumerate(_layers_mm(image)):
        last, count = image.hu.shape[axis] - 1.0, len(layers_mm)
        beyond = np.array([*range(1, count + 1), count + 0.5])
        moved = np.array([*layers_mm, layers_mm[-1] + 0.5 * image.spacing_mm[axis]]) / image.spacing_mm[axis]
        index[:, axis] = np.interp(
            index[:, axis],
            np.concatenate([-beyond[::-1], [0.0, last], last + beyond]),
            np.concatenate([-moved[::-1], [0.0, last], last + moved]),
        )
    return TriangleMesh(apply(T, index), surface.faces)


def _hulls_beyond(mask: Bools, image: OutsideImage) -> list[TriangleMesh]:
    """Prisms beyond the sides of the image, over the convex hull of the bulky pieces that a side cuts.

    Not beyond head and feet: there a table goes on as it is cut.
    """
    if not any(mask.take(end, axis=axis).any() for axis in (0, 1) for end in (0, -1)):
        return []
    bulky, prisms = _bulky(mask, image.spacing_mm), []
    for axis, end in itertools.product((0, 1), (0, -1)):
        cut = np.argwhere(bulky.take(end, axis=axis))
        corners = (cut[:, None] + np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])).reshape(-1, 2)
        if len(corners):
            rim = corners[scipy.spatial.ConvexHull(corners).vertices]  # whole voxels have an area
            away = image.beyond_mm[axis] / image.spacing_mm[axis]
            near, far = (-0.5, -away) if end == 0 else (image.hu.shape[axis] - 0.5, away)
            prisms.append(prism(image.T_ct_index, rim, axis, (near, near + far)))
    return prisms


def prism(T_ct_index: Floats, outline: Floats, axis: int, between: tuple[float, float]) -> TriangleMesh:
    """Solid over a convex polygon, shape (n, 2), between two planes across an axis; in voxels or mm."""
    n = len(outline)
    index = np.concatenate([np.insert(outline, axis, at, axis=1) for at in between])
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    fan = np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    sides = np.concatenate([np.stack([i, i + n, j], axis=1), np.stack([j, i + n, j + n], axis=1)])
    faces = np.concatenate([fan, fan[:, ::-1] + n, sides]).astype(np.int32)
    vertices = apply(T_ct_index, index)
    return TriangleMesh(vertices, _facing_outward(vertices, faces))
