"""Several meshes as the arrays of one cache entry, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.geometry.mesh import TriangleMesh


def packed_meshes(meshes: Sequence[TriangleMesh]) -> dict[str, NDArray[Any]]:
    """All vertices and faces, one mesh after the other, and how many each has, shape (k, 2)."""
    return {
        "sizes": np.array([(len(mesh.vertices), len(mesh.faces)) for mesh in meshes], np.int64).reshape(-1, 2),
        "vertices": np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in meshes)]),
        "faces": np.concatenate([np.empty((0, 3), np.int32), *(mesh.faces for mesh in meshes)]),
    }


def unpacked_meshes(arrays: dict[str, NDArray[Any]]) -> tuple[TriangleMesh, ...]:
    """The meshes of `packed_meshes`, equal to the bit.

    Raises:
        KeyError, ValueError: These arrays are none.
    """
    ends = np.cumsum(arrays["sizes"], axis=0)[:-1]
    vertices, faces = np.split(arrays["vertices"], ends[:, 0]), np.split(arrays["faces"], ends[:, 1])
    for some, corners in zip(vertices, faces, strict=True):
        if not np.isfinite(some).all() or corners.min(initial=0) < 0 or corners.max(initial=-1) >= len(some):
            raise ValueError("no mesh")
    return tuple(TriangleMesh(some, corners) for some, corners in zip(vertices, faces, strict=True))
