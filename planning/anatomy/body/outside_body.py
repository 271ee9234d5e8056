"""What a CT shows outside of the body that is not air: table, mattress, clothes, lines, limbs that nobody recognised.

It becomes one closed surface of role ``unknown``, for a needle, its holder and the arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.body_mask import BODY_HU
from puncture_twin.planning.anatomy.body.tables import DRAWN_FRACTION, FACES, Face
from puncture_twin.planning.base.arrays import Bools, Floats, widened
from puncture_twin.planning.formats.labels.labelmaps import box_in, mask_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.parts import in_blocks, parts_of
from puncture_twin.planning.geometry.rigid import apply, pose

SMOOTH_MM = (3.0, 6.0, 9.0, 12.0)
"""Means over a cube of such an edge are compared with air, the first in which air is quiet enough, else the first."""
QUIET, THIN = 4.5, 3
"""Air is quiet whose median is below the limit by so many times what its lower quarter is below it: three deviations,
and what is denser makes no bulky piece. Foam does not move that quarter. Asked of every third voxel along each axis."""
LEAST_HU, DENSE_HU = -1024, -700.0
"""What is below counts as this in a mean: some scanners write less than air has. A single voxel above the second is no
noise (ten times that of a low-dose image)."""
MIN_PIECE_MM3, MIN_SOFT_MM3, SOLID_HU = 100.0, 500.0, -250.0
"""Pieces that hold less above ``BODY_HU`` are noise, or cloth; where nothing in them is solid, less than the second. A
line of 4 mm has the first in 8 mm of its length, between voxels of 3 mm the second in 30. A gown on the skin of a real
chest has -850, and -260 in its folds; so has a line of 2 mm, or with a bore: it is not seen."""
BULKY_ML = 50.0
"""Pieces of this volume that the border cuts go on beyond it, also between the places where they are cut: of a table
that sags below the image both ends are seen."""
BEYOND_MM, BEYOND_LONG_MM = (100.0, 100.0, 2000.0), (100.0, 100.0, 1000.0)
"""So far what the border cuts goes on to the sides, to front and back, and along the bed: a CT table is at most 550 mm
wide and an image at least 350; along the bed it goes on farther than a needle reaches. The second where an image is so
long that the surface would be larger than any that is plausible."""
CUT_AT_MM = (30.0, 120.0, 480.0)
"""Along the bed it is cut across there: a triangle as long as all of it would lie near every needle."""
BLOCK_MM = 2.0
"""The surface is drawn about blocks of at most this edge that hold any of it, or lie less than half a block beside it:
means have no finer shape, and a table of .8 mm voxels has a million triangles."""
RISES_OVER_MM, STEEPEST, ON_AN_ARC = 20.0, 2.0, 2.25
"""How steeply a cradle rises at the border is seen so far from it; a larger step is that of another piece. Where it
rises at 40 degrees, an arc's chord up to 75 is so much steeper."""
RIM_MM = 50.0
"""Where what is dense ends at voxels that were not scanned, they count as dense so far from it."""


@dataclass(frozen=True, eq=False)
class OutsideImage:
    """A CT (nx, ny, nz), HU, its body, and what was not measured; axes running to the left, back and head."""

    hu: NDArray[Any]  # shape (nx, ny, nz), Hounsfield units
    body: Bools
    unscanned: Bools
    T_ct_index: Floats  # shape (4, 4), voxel index to LPS mm
    spacing_mm: Floats
    slopes: tuple[float, float] = (0.0, 0.0)
    """How what lies there moves along axes 0 and 1 beyond the image's ends, mm per mm along the bed."""
    beyond_mm: tuple[float, float, float] = BEYOND_MM
    """How far what the border cuts is taken to go on."""


def outside_mask(image: OutsideImage, air_hu: float) -> Bools:
    """Voxels outside of the body whose surroundings are denser than a limit.

    Beside the body's surface they are partly skin, partly air; there only what is denser than half of both counts.
    """
    hu, body, unscanned = image.hu, image.body, image.unscanned
    for edge_mm in (*SMOOTH_MM, SMOOTH_MM[0]):
        size = np.maximum(1, np.round(edge_mm / image.spacing_mm)).astype(int)
        means = scipy.ndimage.uniform_filter(np.maximum(hu, LEAST_HU), size, np.float32, mode="nearest")
        away = ~widened(body, size // 2 + 1)
        air = means[::THIN, ::THIN, ::THIN][(away & ~unscanned)[::THIN, ::THIN, ::THIN]]
        air = air[air < DENSE_HU]
        if air.size and (1.0 + QUIET) * np.median(air) - QUIET * np.percentile(air, 25) <= air_hu:
            break
    dense = away & ((means > air_hu) | (hu > max(DENSE_HU, air_hu)))
    dense |= (hu > BODY_HU) & ~body
    if not unscanned.any():
        return _stiff_pieces(dense, hu, image.spacing_mm)
    dense = _stiff_pieces(dense & ~unscanned, hu, image.spacing_mm)
    ends = widened(dense | body, (1, 1, 1)) & unscanned
    dense |= widened(ends, np.ceil(RIM_MM / image.spacing_mm).astype(int)) & unscanned
    padded = unscanned & ~unscanned.all(axis=2, keepdims=True)
    if (widened(body, (1, 1, 1)) & padded).any():  # beyond what is no circle's outside the image ends, as at a face
        dense |= padded
    dense &= ~body
    return dense


def outside_surface(
    image: OutsideImage, mask: Bools, open_faces: Sequence[Face] = (), *, where: str | Path
) -> TriangleMesh | None:
    """The closed surface of what is dense outside of the body, LPS mm; None where there is only air.

    Where the border of the image cuts it, it goes on beyond: every cut section is drawn out by ``beyond_mm``, and of
    bulky pieces also what lies between cut sections at one side. A cradle goes on rising: what is drawn out of it is a
    wedge from its back on. So does all that lies beyond an open face.
    """
    edge = np.maximum(1, (BLOCK_MM / image.spacing_mm).astype(int))
    # A surface bevels the corners of its blocks. So what it holds lies half a block deep: no voxel in a corner is lost.
    blocks, pads = in_blocks(widened(mask, edge // 2), edge) > 0, [(len(layers),) * 2 for layers in _layers_mm(image)]
    layered = np.pad(blocks, pads, mode="edge")
    seen = in_blocks(mask & ~image.unscanned, edge) > 0
    bulky = _bulky(seen, edge * image.spacing_mm)
    for axis, end in FACES:
        cut: Bools = np.asarray(bulky.take(end, axis=axis))
        between = np.maximum.accumulate(cut) & np.maximum.accumulate(cut[::-1])[::-1]
        others, count = [pads[other] for other in (1 - axis, 2)], pads[axis][0]
        beyond = np.moveaxis(layered, axis, 0)[-count:] if end else np.moveaxis(layered, axis, 0)[:count]
        beyond |= np.pad(between, others, mode="edge") | ((axis, end) in open_faces)
    if not layered.any():
        return None
    T_blocks_layered = pose(np.eye(3), [-float(count) for count, _ in pads])
    solid = bulky & (in_blocks(image.hu > DENSE_HU, edge) > 0)  # not what lies beyond a table's back
    arcs = [_arc(solid, end, edge * image.spacing_mm) for end in (0, -1)]
    return _drawn_out(mask_surface(layered, T_blocks_layered, where=where), edge, image, arcs)


def _arc(solid: Bools, end: int, block_mm: Floats) -> tuple[Floats, float]:
    """How solid pieces (nx, ny, nz) go on at one end of axis 0.

    By block along the bed (nz,) the block in which their back lies at the border; and how much it rises toward the
    front, mm per mm to the side.
    """
    steps = min(max(1, round(RISES_OVER_MM / block_mm[0])), len(solid) - 1)
    columns = solid[::-1][: steps + 1] if end else solid[: steps + 1]
    backs = columns.shape[1] - 1.0 - columns[:, ::-1].argmax(axis=1)
    level = np.abs(np.diff(backs, axis=0)) * block_mm[1] <= STEEPEST * block_mm[0]
    one = np.asarray(np.concatenate([columns.any(axis=1), level]).all(axis=0))
    if np.count_nonzero(one) < max(1.0, DRAWN_FRACTION * columns[0].any(axis=0).sum()):
        return backs[0], 0.0
    risen_mm = float(np.median((backs[-1] - backs[0])[one])) * block_mm[1]
    back = np.where(one, backs[0], np.median(backs[0, one]))
    return back, ON_AN_ARC * max(risen_mm, 0.0) / (steps * block_mm[0])


def _layers_mm(image: OutsideImage) -> tuple[tuple[float, ...], ...]:
    """How far beyond its border voxels' centres layers of blocks continue an image, along each axis, to the end."""
    to_side, to_back, along = image.beyond_mm
    return (float(image.spacing_mm[0]), to_side), (float(image.spacing_mm[1]), to_back), (*CUT_AT_MM, along)


def _drawn_out(
    surface: TriangleMesh, edge: NDArray[np.int_], image: OutsideImage, arcs: Sequence[tuple[Floats, float]]
) -> TriangleMesh:
    """A surface that counts blocks of ``edge`` voxels, in LPS mm; layers beyond the border moved outward with the bed.

    Those beyond a side, where a cradle rises, in front of its back to the front. Every vertex lies on a face between
    two blocks; caps half a voxel after the last layer's centre.
    """
    index = surface.vertices.copy()
    for axis, layers_mm in enumerate(_layers_mm(image)):
        size = image.hu.shape[axis]
        at = np.arange(0, size, edge[axis])  # first voxels of blocks
        beyond = np.array([*range(1, len(layers_mm) + 1), len(layers_mm) + 0.5])
        moved = np.array([*layers_mm, layers_mm[-1] + 0.5 * image.spacing_mm[axis]]) / image.spacing_mm[axis]
        last, ends = len(at) - 1.0, [(min(edge[axis], size) - 1) / 2.0, (at[-1] + size - 1) / 2.0]  # border centres
        index[:, axis] = np.interp(
            index[:, axis],
            np.concatenate([-beyond[::-1], [0.0], np.arange(last) + 0.5, [last], last + beyond]),
            np.concatenate([-moved[::-1], ends[:1], at[1:] - 0.5, ends[1:], size - 1.0 + moved]),
        )
    for (back, rise), beyond in zip(arcs, (-index[:, 0], index[:, 0] - (image.hu.shape[0] - 1.0)), strict=True):
        backs = np.interp(surface.vertices[:, 2], np.arange(len(back)), back)
        risen = rise * np.maximum(beyond, 0.0) * image.spacing_mm[0] / image.spacing_mm[1]
        index[:, 1] -= np.where(surface.vertices[:, 1] < backs, risen, 0.0)
    beyond = index[:, 2] - np.clip(index[:, 2], 0.0, image.hu.shape[2] - 1.0)
    index[:, :2] += beyond[:, None] * image.slopes * image.spacing_mm[2] / image.spacing_mm[:2]
    return TriangleMesh(apply(image.T_ct_index, index), surface.faces)


def _stiff_pieces(mask: Bools, hu: NDArray[Any], spacing_mm: Floats) -> Bools:
    """The pieces that are bulky, and of others what is solid with its rim: the rest is noise, or cloth on the skin."""
    stiff = _bulky(mask, spacing_mm)
    solid = hu > BODY_HU
    solid &= mask
    if not solid.any():
        return stiff
    box = box_in(solid, margin=2)
    near = parts_of(widened(solid[box], (1, 1, 1)), corners=True)
    least_mm3 = np.where(near.counts(solid[box] & (hu[box] > SOLID_HU)) > 0, MIN_PIECE_MM3, MIN_SOFT_MM3)
    large = near.counts(solid[box]) * np.prod(spacing_mm) >= least_mm3
    stiff[box] |= widened(near.painted(large), (1, 1, 1)) & mask[box]
    return stiff


def _bulky(mask: Bools, spacing_mm: Floats) -> Bools:
    found = parts_of(mask, corners=True)
    return found.painted(found.sizes * np.prod(spacing_mm) >= 1000.0 * BULKY_ML)
