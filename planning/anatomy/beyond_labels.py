"""What lies in the body beyond the box of a label map: no organ there has a label, so it is not known to be free.

TotalSegmentator and Slicer write maps that were cropped to a part of the CT. The part of the body beyond each face of
the map becomes a closed surface of role ``unknown``; the air beyond it, outside of the skin, does not.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.label_grids import LabelGrid, label_grids
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.arrays import Floats, widened
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.labels.label_surface import mask_surface
from puncture_twin.planning.formats.volumes.orientation import canonical
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.voxelize import voxels_inside

BEYOND_LABELS = "beyond_labels"
"""Its name among the structures."""

VOXELS_OF_SLACK = 1.0
"""A map may end so many voxels inside the skin's box: the skin itself is found to that."""

CELL_MM = 2.0
"""Least edge of the cells by which the body beyond a map is found; it is widened by one cell to all sides."""

ENDS = (
    "label map {name} ends {voxels:.0f} voxels inside the body, within the needle's reach: what lies beyond is unknown"
)


class Beyond(NamedTuple):
    """The body beyond all maps of a case.

    Attributes:
        mesh: Closed, LPS mm; None where every map holds the body within the needle's reach.
        margin_mm: What an organ that is not seen there may demand, and half a voxel.
        warnings: One sentence a map that ends.
    """

    mesh: TriangleMesh | None
    margin_mm: float
    warnings: tuple[str, ...]

    @property
    def structures(self) -> tuple[Structure, ...]:
        """The one of role ``unknown`` that it is, or none."""
        if self.mesh is None:
            return ()
        at_map = np.zeros((3, 3))  # where the map ends is known; the margin has half a voxel
        return (Structure(BEYOND_LABELS, Role.UNKNOWN, self.margin_mm, self.mesh, BEYOND_LABELS, voxel_ct=at_map),)


@dataclass(frozen=True, eq=False)
class _Extent:
    """A map against the body, both in the map's voxels, which may be oblique to the patient.

    Attributes:
        grid: The map.
        low, high: Shape (3,), of the body within the needle's reach.
    """

    grid: LabelGrid
    low: Floats
    high: Floats

    @property
    def box(self) -> tuple[Floats, Floats]:
        """The map's outer faces."""
        return np.full(3, -0.5), np.array(self.grid.voxels.shape) - 0.5

    @property
    def gaps(self) -> Floats:
        """By how many voxels the body goes on beyond each low and high face, shape (2, 3)."""
        low, high = self.box
        return np.stack([low - self.low, self.high - high])


def beyond_labels(case: Case, skin: Skin, structures: Sequence[Structure]) -> Beyond:
    """Find where label maps end inside the body.

    An organ that the map would have shown demands its margin of the needle's surface. So the margin of what is beyond
    is the largest that the case demands of any label of the map, and half a voxel more: a label that ends at the map's
    face has its edges cut off by so much there.

    Args:
        case: The case.
        skin: Its skin; where it is open, a map that ends is refused.
        structures: What was read of the maps.

    Raises:
        InputError: A map that does not hold the target, or one that ends in a body whose skin is open.
    """
    meshes, margins, warnings = [], [0.0], []
    for grid in label_grids(case):
        margin = _largest_margin(case, grid, structures) + float(grid.voxels.spacing_mm.max()) / 2
        extent = _extent(case, skin, grid, margin)
        _refuse_without_target(case, grid)
        if extent.gaps.max() <= VOXELS_OF_SLACK:
            continue
        said = ENDS.format(name=grid.name, voxels=extent.gaps.max())
        if not skin.mesh.closed:
            allowed = "a label map of the whole body about the target, or a closed skin"
            raise InputError(f"{said} (the skin is open)", where=case.path, allowed=allowed)
        warnings.append(f"{said} ({BEYOND_LABELS})")
        margins.append(margin)
        meshes += list(_slabs(extent, skin.mesh))
    return Beyond(joined(meshes) if meshes else None, max(margins), tuple(warnings))


def _largest_margin(case: Case, grid: LabelGrid, structures: Sequence[Structure]) -> float:
    """Of the labels that are there, those that patterns name and that may lie beyond, and of what nobody named; mm."""
    sections = [one for one in case.structures if one.source == grid.name]
    named = [margin for one in sections for margin in (*one.avoid.values(), *one.unknown.values())]
    return max([case.ct.margin_mm, *named, *(one.margin_mm for one in grid.own(structures))])


def _extent(case: Case, skin: Skin, grid: LabelGrid, margin_mm: float) -> _Extent:
    T_index_ct = np.linalg.inv(grid.voxels.T_ct_index)
    body = apply(T_index_ct, skin.mesh.vertices)
    target = apply(T_index_ct, case.target_ct[None])[0]
    # |row| is how many voxels an axis advances for a step of 1 mm along its normal
    reach = (case.needle.length_mm + margin_mm) * np.linalg.norm(T_index_ct[:3, :3], axis=1)
    return _Extent(grid, np.maximum(body.min(axis=0), target - reach), np.minimum(body.max(axis=0), target + reach))


def _refuse_without_target(case: Case, grid: LabelGrid) -> None:
    index = apply(np.linalg.inv(grid.voxels.T_ct_index), case.target_ct[None])[0]
    if np.any(index < -0.5) or np.any(index > np.array(grid.voxels.shape) - 0.5):
        what = f"label map {grid.name} ends before the target, so that all about it is unknown"
        raise InputError(what, where=case.path, allowed="label maps that hold the target")


def _slabs(extent: _Extent, skin: TriangleMesh) -> Iterator[TriangleMesh]:
    """The body beyond each face of the map, which it exceeds, as closed surfaces."""
    for end, axis in itertools.product(range(2), range(3)):
        if extent.gaps[end, axis] <= 0:
            continue
        low, high = extent.low.copy(), extent.high.copy()
        (high if end == 0 else low)[axis] = extent.box[end][axis]
        mesh = _body_between(extent.grid, skin, low, high, axis, end)
        if mesh is not None:
            yield mesh


def _body_between(
    grid: LabelGrid, skin: TriangleMesh, low: Floats, high: Floats, axis: int, end: int
) -> TriangleMesh | None:
    """The body between two corners, voxels, in cells of which one layer ends in the map's face."""
    step = np.maximum(1.0, CELL_MM / grid.voxels.spacing_mm)
    count = np.ceil((high - low) / step).astype(int) + 2
    first = low - step / 2
    if end == 0:
        first[axis] = high[axis] - (count[axis] - 0.5) * step[axis]
    else:
        first[axis] = low[axis] + step[axis] / 2
    T_index_cell = np.eye(4)
    T_index_cell[:3, :3], T_index_cell[:3, 3] = np.diag(step), first
    T_ct_cell = grid.voxels.T_ct_index @ T_index_cell
    inside = widened(voxels_inside(skin, T_ct_cell, tuple(count)), (1, 1, 1))
    if not inside.any():
        return None
    oriented = canonical(inside, T_ct_cell)
    return mask_surface(oriented.values, oriented.T_ct_index, where=grid.name)
