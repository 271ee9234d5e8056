"""What a CT shows outside of the body that is not air: table, mattress, clothes, lines, limbs that nobody recognised.

None of it is free space for a needle, its holder or the arm. It becomes one closed surface of role ``unknown``,
checked by the same engine as every organ, along the whole needle while it waits at its standoff.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from puncture_twin.planning.anatomy.body.body_mask import BODY_HU, unscanned_voxels
from puncture_twin.planning.anatomy.body.flat_side import FlatSide
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.formats.labels.label_surface import field_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh

SMOOTH_MM = 3.0
"""Means over a cube of this edge are compared with air: noise of a finer image falls below that of 3 mm voxels."""
DENSE_HU = -700.0
"""A single voxel above this is no noise (ten times that of a low-dose image)."""
MIN_PIECE_MM3 = 100.0
"""Smaller pieces are noise: a line of 4 mm diameter has this volume in 8 mm of its length."""
BULKY_ML = 50.0
"""Pieces of this volume that the border of the image cuts (a table, a mattress) go on beyond it, also between the
places where they are cut: of a table that sags below the image both ends are seen."""
BEYOND_MM = (100.0, 100.0, 2000.0)
"""How far what the border cuts is taken to go on to the sides, to front and back, and along the bed. A CT table is at
most 550 mm wide and an image at least 350; along the bed table and mattress go on farther than a needle reaches."""
RIM_MM = 50.0
"""Where what is dense ends at voxels that were not scanned, they count as dense so far from it."""


BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
"""Triangles of a box whose corners run with x slowest and z fastest, outward."""

FULL = np.ones((3, 3, 3), bool)
"""Voxels that share a face, an edge or a corner are neighbours."""


@dataclass(frozen=True, eq=False)
class OutsideImage:
    """A CT beside its body, axes running to the left, back and head.

    Attributes:
        hu: Shape (nx, ny, nz), Hounsfield units.
        body: Same shape, the body.
        T_ct_index: Shape (4, 4), voxel index to LPS mm.
        spacing_mm: Shape (3,).
    """

    hu: NDArray[np.float32]
    body: Bools
    T_ct_index: Floats
    spacing_mm: Floats


def outside_mask(image: OutsideImage, air_hu: float) -> Bools:
    """Voxels outside of the body that are not air.

    Beside the body's surface a voxel, or the mean about it, is partly skin, partly air; there only what is denser than
    half of both counts.

    Args:
        image: The CT and its body.
        air_hu: Voxels whose surroundings are denser than this are not air.
    """
    hu, body = image.hu, image.body
    scanned = ~unscanned_voxels(hu)
    size = np.maximum(1, np.round(SMOOTH_MM / image.spacing_mm)).astype(int)
    mean = ndimage.uniform_filter(np.maximum(hu, -1024.0), size=tuple(size), mode="nearest")
    dense = (mean > air_hu) | (hu > max(DENSE_HU, air_hu))
    dense &= ~ndimage.maximum_filter(body, size=tuple(2 * (size // 2 + 1) + 1))
    dense = (dense | (hu > BODY_HU)) & scanned & ~body
    dense = _without_specks(dense, MIN_PIECE_MM3 / float(np.prod(image.spacing_mm)))
    return dense | _unscanned_beside(dense | body, ~scanned & ~body, image.spacing_mm)


def outside_surface(image: OutsideImage, *, air_hu: float, where: str | Path) -> TriangleMesh | None:
    """The closed surface of what is dense outside of the body, LPS mm; None where there is only air.

    Where the border of the image cuts it, it goes on beyond: every cut section is drawn out by ``BEYOND_MM``, and of
    bulky pieces also the convex hull of all cut sections at one side.

    Args:
        image: The CT and its body.
        air_hu: See `outside_mask`.
        where: The file, for messages.
    """
    mask = outside_mask(image, air_hu)
    if not mask.any():
        return None
    surface = field_surface(mask.astype(np.float32) - 0.5, image.T_ct_index, where=where)
    drawn = _drawn_out(surface, image)
    return joined([drawn, *_hulls_beyond(mask, image)])


def beyond_body(image: OutsideImage) -> list[TriangleMesh]:
    """Boxes beyond each face of the image that cuts the body: where the skin goes on and the image does not.

    Of a skin that comes from the image itself the same is known from its cut triangles.
    """
    boxes = []
    for axis, end in itertools.product(range(3), (0, -1)):
        if image.body.take(end, axis=axis).any():
            across = np.delete(image.hu.shape, axis) - 0.5
            corners = np.array([[x, y] for x in (-0.5, across[0]) for y in (-0.5, across[1])])
            boxes.append(_prism(corners, axis, end, image))
    return [box for box in boxes if box is not None]


def beyond_flat_sides(image: OutsideImage, sides: Sequence[FlatSide]) -> list[TriangleMesh]:
    """Boxes beyond the planes in which a body ends that lies on something: to both sides and along the bed too."""
    T, shape = image.T_ct_index, np.array(image.hu.shape)
    boxes = []
    for side in sides:
        low, high = -np.array(BEYOND_MM) / image.spacing_mm, shape - 1.0 + np.array(BEYOND_MM) / image.spacing_mm
        (high if side.end == 0 else low)[side.axis] = side.plane
        index = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        boxes.append(TriangleMesh(index @ T[:3, :3].T + T[:3, 3], BOX_FACES))
    return boxes


def joined(meshes: list[TriangleMesh]) -> TriangleMesh:
    """Several surfaces as one."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, first, strict=True)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def _without_specks(mask: Bools, least_voxels: float) -> Bools:
    labels, _ = ndimage.label(mask, FULL)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray((sizes >= least_voxels)[labels])


def _unscanned_beside(dense: Bools, unscanned: Bools, spacing_mm: Floats) -> Bools:
    """Voxels that were not scanned, near to where something dense ends at them."""
    ends = ndimage.binary_dilation(dense, FULL) & unscanned
    if not ends.any():
        return np.zeros_like(dense)
    return np.asarray((ndimage.distance_transform_edt(~ends, sampling=spacing_mm) <= RIM_MM) & unscanned)


def _drawn_out(surface: TriangleMesh, image: OutsideImage) -> TriangleMesh:
    """The surface with its caps, vertices beyond the border voxels' centres, moved outward."""
    T = image.T_ct_index
    index = np.linalg.solve(T[:3, :3], (surface.vertices - T[:3, 3]).T).T
    last = np.array(image.hu.shape) - 1.0
    away = np.array(BEYOND_MM) / image.spacing_mm
    index = np.where(index < -1e-6, index - away, np.where(index > last + 1e-6, index + away, index))
    return TriangleMesh(index @ T[:3, :3].T + T[:3, 3], surface.faces)


def _hulls_beyond(mask: Bools, image: OutsideImage) -> list[TriangleMesh]:
    """Prisms beyond the sides of the image, over the convex hull of the bulky pieces that a side cuts.

    Not beyond head and feet: there a table goes on as it is cut.
    """
    labels, _ = ndimage.label(mask, FULL)
    sizes = np.bincount(labels.ravel()) * float(np.prod(image.spacing_mm)) / 1000.0
    sizes[0] = 0.0
    bulky = (sizes >= BULKY_ML)[labels]
    prisms = []
    for axis, end in itertools.product((0, 1), (0, -1)):
        cut = np.argwhere(bulky.take(end, axis=axis))
        corners = (cut[:, None] + np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])).reshape(-1, 2)
        if len(corners):
            prisms.append(_prism(corners, axis, end, image))
    return [prism for prism in prisms if prism is not None]


def _prism(section: Floats, axis: int, end: int, image: OutsideImage) -> TriangleMesh | None:
    """What stands over the convex hull of points (n, 2) of one face of the image, from the face outward."""
    try:
        rim = section[ConvexHull(section).vertices]
    except QhullError:  # cannot be: whole voxels have an area
        return None
    away = BEYOND_MM[axis] / image.spacing_mm[axis]
    near = -0.5 if end == 0 else image.hu.shape[axis] - 0.5
    far = near - away if end == 0 else near + away
    n = len(rim)
    index = np.concatenate([np.insert(rim, axis, near, axis=1), np.insert(rim, axis, far, axis=1)])
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    fan = np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    sides = np.concatenate([np.stack([i, j, i + n], axis=1), np.stack([j, j + n, i + n], axis=1)])
    faces = np.concatenate([fan, fan[:, ::-1] + n, sides])
    T = image.T_ct_index
    return TriangleMesh(index @ T[:3, :3].T + T[:3, 3], faces)
