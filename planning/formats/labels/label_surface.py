"""A label's voxels to a closed surface in LPS mm.

Marching cubes on the label's 0/1 mask at 0.5, padded by background. Every vertex then lies in the middle between
the centres of a voxel inside and one outside, that is on the face that they share; and every cell of eight
voxel centres that the surface enters also holds a piece of the voxels' boundary, through its middle. So surface
and boundary are never more than half a voxel apart along any axis (the larger of the three index differences),
in both directions.

The table of Lorensen and Cline (1987) in scikit-image decides each cell by signs alone and came out closed for
every mask tried; its default (Lewiner 2003) compares products that are all equal in a 0/1 mask, and its ties
left holes in random masks.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.measure import marching_cubes

from puncture_twin.planning.base.arrays import Bools
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.labels.labelmaps import Box, LabelMap
from puncture_twin.planning.formats.mesh_guard import guard_mesh
from puncture_twin.planning.formats.volumes.volume_files import canonical
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply


def label_mesh(labelmap: LabelMap, label: int, *, where: str | Path) -> TriangleMesh:
    """The surface of one label, closed, normals outward, in LPS mm.

    A label that touches the border of the volume is closed there, on the outer face of its border voxels. The
    result does not depend on the axis order or the flips in which the map is stored.

    Args:
        where: The file or case entry, for messages.

    Raises:
        InputError: If no voxel has this label.
    """
    box = labelmap.boxes.get(label)
    if box is None:
        named = labelmap.names or {}
        shown = ", ".join(f"{n} {named[n]}" if n in named else str(n) for n in labelmap.labels_present())
        refuse(f"no voxel has label {label}", where, f"the labels present: {shown}", "label_absent")
    mask = labelmap.labels[box] == label
    T_ct_box = labelmap.T_ct_index.copy()
    T_ct_box[:3, 3] += labelmap.T_ct_index[:3, :3] @ [axis.start for axis in box]
    oriented = canonical(mask, T_ct_box)
    return mask_surface(oriented.values, oriented.T_ct_index, where=where)


def mask_surface(mask: Bools, T_ct_index: NDArray[np.float64], *, where: str | Path) -> TriangleMesh:
    """The closed surface of a mask's voxels, as `framed_surface` of a field that is 1/2 inside and -1/2 outside.

    Args:
        mask: Shape (ni, nj, nk), somewhere True; only the box of what is True is looked at.
        T_ct_index: Shape (4, 4), determinant positive.
    """
    box = box_in(mask)
    framed, field = frame([axis.stop - axis.start for axis in box])
    np.subtract(mask[box], np.float32(0.5), out=field)
    return framed_surface(framed, T_ct_index, where=where, first=[axis.start for axis in box])


def box_in(mask: Bools, margin: ArrayLike = 0) -> Box:
    """The smallest index box about the True voxels of a mask, and ``margin`` voxels more along each axis."""
    i = np.flatnonzero([plane.any() for plane in mask])
    seen: Bools = np.asarray(mask[i[0] : i[-1] + 1].any(axis=0))
    j, k = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    x, y, z = np.broadcast_to(margin, 3).tolist()
    ends = ((i, x, 0), (j, y, 1), (k, z, 2))
    a, b, c = (slice(max(0, n[0] - m), min(n[-1] + 1 + m, mask.shape[axis])) for n, m, axis in ends)
    return a, b, c


def frame(shape: Sequence[int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """An array for `framed_surface`, not filled, and the view of it within the frame, of a shape (3,)."""
    framed = np.empty([count + 2 for count in shape], np.float32)
    return framed, framed[1:-1, 1:-1, 1:-1]


def framed_surface(
    framed: NDArray[np.float32], T_ct_index: NDArray[np.float64], *, where: str | Path, first: ArrayLike = 0
) -> TriangleMesh:
    """The closed surface around where a field is positive, in LPS mm, normals outward.

    Along the border the field is continued with its sign flipped, so the surface closes on the outer faces of
    the border voxels.

    Args:
        framed: Of `frame`: within, the field, never 0, positive inside, somewhere positive; its frame is written here.
        T_ct_index: Shape (4, 4), determinant positive.
        first: Shape (3,), index of the field's first voxel, where it is part of a larger one.
    """
    for axis in range(3):
        planes = np.moveaxis(framed, axis, 0)
        planes[0], planes[-1] = -np.abs(planes[1]), -np.abs(planes[-2])
    found = marching_cubes(framed, level=0.0, method="lorensen", gradient_direction="ascent")
    index, faces = found[0].astype(np.float64) - 1.0 + first, found[1]
    return guard_mesh(apply(T_ct_index, index), faces, where=where)
