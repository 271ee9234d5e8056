"""Markers and a lesion found in a CT: by a voxel, as a person reads them, and by less than a voxel.

The rule of Chen 2019, section 3.1, is a voxel's: the number of the slice that shows a marker best, and its place there
to 1 mm. The finer place is that of the drawn marker nearest to the image (`planning.registration.fiducial_reading`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from puncture_twin.planning.anatomy.metal import Metal, centroid, metal_pieces, metal_weights, spacing_mm
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.fiducial_reading import find_middle, read_marker
from puncture_twin.planning.registration.fiducials import box_about, clipped_at, noise_hu

READING_MM = 1.0
"""mm to which a person reads a place in a slice."""
FARTHEST_MM = 15.0
"""A marker lies no farther from where it is expected."""
LARGEST_MM = 25.0
"""A larger piece of metal is no marker."""


class Markers(NamedTuple):
    """Markers in the order of those expected: by the drawn marker, and by slice number and millimetre."""

    fine: NamedPoints
    rule: NamedPoints


def find_markers(volume: Volume, expected: NamedPoints) -> Markers:
    """Find markers of metal near where they are expected, LPS mm; one that no piece of metal is near to is refused."""
    pieces = [piece for piece in metal_pieces(volume) if piece.size_mm <= LARGEST_MM]
    chosen = _named(pieces, expected, volume)
    ceiling, noise = clipped_at(volume.values), noise_hu(volume.values)
    weights = [metal_weights(volume, piece) for piece in chosen]
    rule = [_by_rule(some, piece, volume) for some, piece in zip(weights, chosen, strict=True)]
    fine = [_fine(some, piece, volume, ceiling, noise) for some, piece in zip(weights, chosen, strict=True)]
    return Markers(*(NamedPoints(expected.names, np.array(points), Space.LPS) for points in (fine, rule)))


def _fine(weights: Floats, piece: Metal, volume: Volume, ceiling_hu: float, noise: float) -> Floats:
    """The centre of the drawn marker, shape (3,), LPS mm; of what touches other metal the weighted middle."""
    begin = np.array([one.start for one in piece.box])
    inside = np.argwhere(piece.voxels) + begin
    peak = inside[int(np.argmax(volume.values[tuple(inside.T)]))]
    ends = np.stack([inside.min(axis=0), inside.max(axis=0) + 1], axis=1)
    middle = find_middle(box_about(volume, ends, peak, ceiling_hu, noise))
    if middle is None:
        return centroid(weights, piece.box, volume.T_ct_index)
    return read_marker(middle, middle.outward).centre_ct


def _named(pieces: list[Metal], expected: NamedPoints, volume: Volume) -> list[Metal]:
    middles = np.array([piece.middle_ct for piece in pieces]).reshape(-1, 3)
    distance = np.linalg.norm(expected.points[:, None] - middles, axis=2)
    rows, columns = linear_sum_assignment(np.where(distance < FARTHEST_MM, distance, 1e6))
    pairs = {int(row): int(column) for row, column in zip(rows, columns, strict=True)}
    for row, name in enumerate(expected.names):
        if row not in pairs or distance[row, pairs[row]] >= FARTHEST_MM:
            voxels = " x ".join(f"{size:g}" for size in spacing_mm(volume))
            near = f"metal within {FARTHEST_MM:g} mm of the expected position"
            allowed = f"{near}, and voxels far smaller than the marker"
            what = f"marker {name} is not seen in the image (voxels of {voxels} mm)"
            refuse(what, volume.path, allowed, "marker_not_seen")
    return [pieces[pairs[row]] for row in range(len(expected.names))]


def _by_rule(weights: Floats, piece: Metal, volume: Volume) -> Floats:
    """The place by the paper's rule: the slice with most of the metal, and there its middle to a millimetre."""
    k = int(np.argmax(weights.sum(axis=(0, 1))))
    sides = weights[:, :, k].sum(axis=1), weights[:, :, k].sum(axis=0)
    i, j = (float(line @ np.arange(len(line)) / line.sum()) for line in sides)
    spacing = spacing_mm(volume)
    index = np.array([i, j, k]) + [axis.start for axis in piece.box]
    index[:2] = np.round(index[:2] * spacing[:2] / READING_MM) * READING_MM / spacing[:2]
    return apply(volume.T_ct_index, index)


RIM_MM = 4.0
"""Beyond a segmentation, so far the surroundings are looked at."""


def read_lesion(volume: Volume, mask: NDArray[np.bool_]) -> Floats:
    """The middle of what a mask of the CT outlines, by the values in and around it, shape (3,), LPS mm."""
    boxes = ndimage.find_objects(mask.astype(np.uint8))
    if not boxes:
        refuse("no voxel belongs to the lesion", volume.path, "a lesion larger than a voxel", "lesion_not_seen")
    spacing = spacing_mm(volume)
    around = np.ceil(RIM_MM / spacing).astype(int) + 1
    low = np.maximum(np.array([one.start for one in boxes[0]]) - around, 0)
    high = np.minimum(np.array([one.stop for one in boxes[0]]) + around, mask.shape)
    box = (slice(low[0], high[0]), slice(low[1], high[1]), slice(low[2], high[2]))
    values, inside = volume.values[box].astype(np.float64), mask[box]
    distance = ndimage.distance_transform_edt(~inside, spacing)
    core = ndimage.distance_transform_edt(inside, spacing) > spacing.max()
    own = np.median(values[core if core.any() else inside])
    other = np.median(values[(distance > spacing.max()) & (distance <= RIM_MM + spacing.max())])
    if own == other:
        return centroid(inside.astype(np.float64), box, volume.T_ct_index)
    weights = np.where(core, 1.0, np.clip((values - other) / (own - other), 0.0, 1.0))
    return centroid(np.where(distance <= spacing.max(), weights, 0.0), box, volume.T_ct_index)
