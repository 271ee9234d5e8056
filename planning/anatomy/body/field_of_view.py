"""What was imaged of the body: a box, the sides at which it cuts the body, and where rays leave it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import pose

BOX_TOLERANCE_MM = 1e-6
"""Rounding in the position of a box face, relative to coordinates of a metre."""
OPEN_AIR_MM = 2000.0
"""Beyond the sides at which a body mesh was not cut there is air, farther than any needle reaches."""
SIDES: Mapping[str, tuple[int, int]] = MappingProxyType(
    {"right": (0, 0), "left": (0, 1), "front": (1, 0), "back": (1, 1), "feet": (2, 0), "head": (2, 1)}
)
"""The patient's sides: LPS axis, and whether its low (0) or high (1) end."""


@dataclass(frozen=True, eq=False)
class FieldExit:
    """Where rays leave the field of view.

    Attributes:
        depth_mm: Shape (n,), from the origin along the ray.
        cut: Shape (n,), whether through a face that cuts the body, so that the body may go on there.
    """

    depth_mm: NDArray[np.float64]
    cut: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FieldOfView:
    """What lies between the faces at which the body was cut, and is open to all other sides.

    Beyond the plane of such a face nothing is known, wherever a path passes it: also one that has left the image
    before, through the air in front of the belly. An image that shows less of that air must make nothing safe.

    Attributes:
        T_ct_box: Shape (4, 4), rigid; the box frame's origin is its low corner, its axes run mostly to the
            patient's left, back and head.
        size_mm: Shape (3,). A side that is not cut lies ``OPEN_AIR_MM`` beyond the image or the mesh.
        cut: Shape (3, 2), which low and high face the body reaches: those of the image, or of a mesh that was cut.
    """

    T_ct_box: NDArray[np.float64]
    size_mm: NDArray[np.float64]
    cut: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for name, dtype in (("T_ct_box", np.float64), ("size_mm", np.float64), ("cut", np.bool_)):
            array = np.array(getattr(self, name), dtype=dtype)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def to_box(self, points_ct: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) from LPS mm to mm from the box's low corner along its axes."""
        return np.asarray((points_ct - self.T_ct_box[:3, 3]) @ self.T_ct_box[:3, :3])

    def exit(self, origin_ct: NDArray[np.float64], directions_ct: Floats) -> FieldExit:
        """Where rays from a point inside the box leave it. An exit on an edge counts for both of its faces.

        Args:
            origin_ct: Shape (3,), LPS mm.
            directions_ct: Shape (n, 3), any length but 0.

        Raises:
            InputError: If the origin lies outside the box, or a direction has no length.
        """
        start = self.to_box(np.reshape(origin_ct, (1, 3)))[0]
        lengths = np.linalg.norm(directions_ct, axis=1, keepdims=True)
        if not np.all((start >= -BOX_TOLERANCE_MM) & (start <= self.size_mm + BOX_TOLERANCE_MM)):
            what = f"the point {np.ravel(origin_ct).round(2)} lies outside the image"
            raise InputError(what, where="field of view", allowed="a point inside the imaged box")
        if not np.all(np.isfinite(lengths) & (lengths > 0)):
            raise InputError("a ray without direction", where="field of view", allowed="finite vectors, not 0")
        rays = (directions_ct / lengths) @ self.T_ct_box[:3, :3]
        faces = np.where(rays > 0, self.size_mm, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):  # a ray along a face never reaches it
            depths = np.where(rays == 0, np.inf, np.maximum((faces - start) / rays, 0.0))
        depth = depths.min(axis=1)
        reached = depths <= depth[:, None] + BOX_TOLERANCE_MM
        cut_ahead = np.where(rays > 0, self.cut[:, 1], self.cut[:, 0])
        return FieldExit(depth, np.any(reached & cut_ahead, axis=1))


def open_to_air(T_ct_image: Floats, size_mm: Floats, cut: NDArray[np.bool_]) -> FieldOfView:
    """A box from its low corner, opened to the sides at which it does not cut the body."""
    low = np.where(cut[:, 0], 0.0, -OPEN_AIR_MM)
    high = np.where(cut[:, 1], size_mm, size_mm + OPEN_AIR_MM)
    return FieldOfView(T_ct_image @ pose(np.eye(3), low), high - low, cut)


def cut_warnings(view: FieldOfView) -> tuple[str, ...]:
    """What a field of view leaves unknown, in one sentence; nothing where it cuts the body at no side."""
    cut = [name for name, (axis, end) in SIDES.items() if view.cut[axis, end]]
    if not cut:
        return ()
    return (
        f"the body is cut at its {', '.join(cut)} side: no skin is known there, and no body that the arm could meet",
    )
