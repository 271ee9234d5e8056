"""Images cut through the body and filled up with air: the faces at which they were cut.

Resampling, padding and some exports lay air around an image, and the face at which it was cut looks like skin. But no
body ends by itself as wide as it is a few millimetres before, across the bed; and no organ ends where all else does.
Such a face is a cut: the image ends there, as it once did. Of a phantom a flat end is its own, unless a structure ends
there that does not run through it; the key ``cut`` of the skin says what is right where that is not.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats, read_only
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.parts import slice_counts

SIDES: Mapping[str, tuple[int, int]] = MappingProxyType(
    {"right": (0, 0), "left": (0, 1), "front": (1, 0), "back": (1, 1), "feet": (2, 0), "head": (2, 1)}
)
"""The patient's sides: LPS axis, and whether its low (0) or high (1) end."""
SPECK_MM2, THICK_MM = 100.0, 12.0
"""What is dense in a slice and smaller is noise, a line or a sheet; into a body that was cut such a ball fits."""
WIDE, ROUND_MM = 0.75, 150.0
"""A ball's outermost slice is at most half as large as the next one, a lying cylinder's .71 of it; and no head, foot or
stump is flatter than a ball of this radius."""
CAP_MM2, WALL, AT_PLANE = 100.0, 0.5, 0.75
"""Area of the flat end of an organ that was cut; what is so much of the face is the body, or a phantom's wall. It ends
so near to the face, voxels."""
Box = tuple[tuple[int, int], ...]
"""Along each axis the first voxel and the one after the last."""
FILLED = (
    "behind the body's {names} side the image has only air, up to {voxels} voxels: the body counts as cut there and "
    "the image as padded (override in the skin's table: cut = [] if it ends there{or_phantom})"
)
ENDS_FLAT = (
    "the phantom ends flat at its {names} side, and no structure is cut there except those that run through it: it "
    "counts as whole (cut in the skin's table overrides this)"
)


@dataclass(frozen=True, eq=False)
class FieldOfView:
    """The imaged box: beyond a face that cuts the body, the body goes on (`planning.anatomy.unseen`)."""

    T_ct_box: NDArray[np.float64]
    """Shape (4, 4), rigid; the box frame's origin is its low corner, its axes run mostly to the patient's left, back
    and head."""
    size_mm: NDArray[np.float64]  # shape (3,), of the image, or of the mesh that was cut
    cut: NDArray[np.bool_]
    """Shape (3, 2), which low and high face the body reaches: those of the image, or of a mesh that was cut."""

    def __post_init__(self) -> None:
        for name, dtype in (("T_ct_box", np.float64), ("size_mm", np.float64), ("cut", np.bool_)):
            object.__setattr__(self, name, read_only(getattr(self, name), dtype))

    def to_box(self, points_ct: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) from LPS mm to mm from the box's low corner along its axes."""
        return np.asarray((points_ct - self.T_ct_box[:3, 3]) @ self.T_ct_box[:3, :3])


@dataclass(frozen=True, eq=False)
class Content:
    """What an image holds that is denser than air: the outermost slices across each axis, low and high, shape (3, 2).

    ``last`` is their number; ``thick`` tells whether what they hold is thick enough for a body, ``wide`` whether it is
    wider than any round body is that ends there by itself.
    """

    shape: tuple[int, int, int]
    T_ct_index: Floats  # shape (4, 4), voxel index to LPS mm
    last: NDArray[np.int64]
    area_mm2: Floats  # shape (3, 2), how much that is
    thick: Bools
    wide: Bools

    @property
    def beyond(self) -> NDArray[np.int64]:
        """Shape (3, 2), how many slices without content lie outside of it."""
        return np.stack([self.last[:, 0], np.array(self.shape) - 1 - self.last[:, 1]], axis=1)

    @property
    def inside(self) -> bool:
        """Whether the image shows all of it."""
        return bool((self.beyond > 0).all())

    def box(self, cut: Bools) -> Box:
        """The image without what lies behind the faces at which it was cut, those of shape (3, 2)."""
        low = np.where(cut[:, 0], self.last[:, 0], 0)
        high = np.where(cut[:, 1], self.last[:, 1] + 1, self.shape)
        return tuple((int(a), int(b)) for a, b in zip(low, high, strict=True))


def content_of(dense: Bools, T_ct_index: Floats) -> Content:
    """Where, and how, what is denser than air ends in an image (nx, ny, nz), axes to the left, back and head."""
    spacing_mm, ends = spacing_of(T_ct_index), []
    for axis, counts in enumerate(slice_counts(dense)):
        step_mm, across_mm = float(spacing_mm[axis]), np.delete(spacing_mm, axis)
        areas = counts * float(np.prod(across_mm))
        held = np.flatnonzero(areas >= SPECK_MM2)
        for k, inward in zip(held[[0, -1]] if len(held) else (0, len(areas) - 1), (1, -1), strict=True):
            next_area = areas[np.clip(k + inward, 0, len(areas) - 1)]
            wide = areas[k] > min(WIDE * next_area, 2.0 * np.pi * ROUND_MM * step_mm)
            ends.append((k, areas[k], _is_thick(dense.take(k, axis=axis), across_mm), wide))
    columns = (np.array(column).reshape(3, 2) for column in zip(*ends, strict=True))
    return Content((dense.shape[0], dense.shape[1], dense.shape[2]), T_ct_index, *columns)


def _is_thick(section: Bools, spacing_mm: Floats) -> bool:
    """Whether a disc of `THICK_MM` fits into a section; beyond the image it goes on."""
    if not section.any():
        return False
    reach = np.ceil(THICK_MM / spacing_mm).astype(int)
    padded = np.pad(section, [(r, r) for r in reach], mode="edge")
    return bool(scipy.ndimage.distance_transform_edt(padded, sampling=spacing_mm).max() > THICK_MM)


def cut_ends(content: Content, organs: Iterable[tuple[TriangleMesh, float]], *, whole: bool) -> Bools:
    """The sides at which an image was cut and then filled up, shape (3, 2).

    A side behind which lie as many slices as behind one that was cut counts as cut too, but not of a phantom: that may
    be whole, and end flat by itself with what runs through it. Of the organs inside, LPS mm, the longest side of their
    voxels is known.
    """
    filled = content.thick & (content.beyond > 0)
    across_bed = np.array([[False], [False], [not whole]])
    cut = filled & across_bed & content.wide
    inside = list(organs) if (filled & ~cut).any() else []
    for axis, end in np.argwhere(filled & ~cut):
        sides = [axis, end], [axis, 1 - end]
        cut[axis, end] = any(
            _ends_flat(content, organ, *sides[0]) and not (whole and _ends_flat(content, organ, *sides[1]))
            for organ in inside
        )
    alike = (content.beyond > 0) & np.isin(content.beyond, content.beyond[cut])
    return np.asarray(cut if whole else cut | alike)


def _ends_flat(content: Content, organ: tuple[TriangleMesh, float], axis: int, end: int) -> bool:
    """Whether an organ has a flat end in the outer face of the outermost slice, and is not all of what ends there."""
    mesh, voxel_mm = organ
    to_index = np.linalg.inv(content.T_ct_index)[axis] * (1.0 if end else -1.0)
    face = (content.last[axis, end] + 0.5) if end else (0.5 - content.last[axis, end])
    near = AT_PLANE * max(1.0, voxel_mm / float(spacing_of(content.T_ct_index)[axis]))
    at = mesh.vertices @ to_index[:3] + to_index[3]
    if abs(at.max() - face) > near:
        return False
    a, b, c = np.moveaxis(mesh.triangles[np.all(at[mesh.faces] > at.max() - near / 3.0, axis=1)], 1, 0)
    area_mm2 = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    return bool(CAP_MM2 < area_mm2 < WALL * content.area_mm2[axis, end])


def spacing_of(T_ct_index: Floats) -> Floats:
    """Voxel size along each axis, shape (3,), mm."""
    return np.asarray(np.linalg.norm(T_ct_index[:3, :3], axis=0))


def shifted(T_ct_index: Floats, box: Box) -> Floats:
    """Shape (4, 4), voxel index in a box of an image to LPS mm."""
    T_ct_box = T_ct_index.copy()
    T_ct_box[:3, 3] += T_ct_box[:3, :3] @ [low for low, _ in box]
    return T_ct_box


def stated_ends(names: Collection[str]) -> Bools:
    """Sides by their names, shape (3, 2)."""
    return np.array([name in names for name in SIDES]).reshape(3, 2)


def end_warnings(content: Content, cut: Bools, whole: bool) -> tuple[str, ...]:
    """Warnings of what was left out behind cut faces, and of flat ends of a phantom that count as its own."""
    filled = cut & (content.beyond > 0)
    flat = np.array([[False], [False], [whole]]) & content.thick & content.wide & (content.beyond > 0) & ~cut
    voxels, or_phantom = content.beyond[filled].max(initial=0), "" if whole else '; or region = "phantom"'
    said = (
        (filled, FILLED.format(names=_names(filled), voxels=voxels, or_phantom=or_phantom)),
        (flat, ENDS_FLAT.format(names=_names(flat))),
    )
    return tuple(sentence for sides, sentence in said if sides.any())


def _names(sides: Bools) -> str:
    return ", ".join(name for name, side in SIDES.items() if sides[side])
