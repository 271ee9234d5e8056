"""The checked header of a volume: its shape, its cells' type and size, where its voxels lie; and the stored voxels."""

import itertools
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError, refuse, refusing
from puncture_twin.planning.geometry.rigid import apply

MAX_VOXELS = 1_000_000_000
"""Four times a whole-body CT (512 x 512 x 1000); a header that claims more is wrong or hostile."""
MIN_SPACING_MM, MAX_SPACING_MM = 0.05, 20.0
"""Finer than a micro-CT and coarser than any clinical slice: outside, the unit was mistaken."""
SHEAR_TOLERANCE = 1e-4
"""Largest cosine between two axes; ITK accepts no more, and float32 headers stay below 1e-6."""
ONE_PLACE_MM = 1.0
"""Distance below which two volumes are taken to lie at one place."""
MAX_ORIGIN_MM = 100_000.0
"""No scanner places a patient 100 m from its own origin."""


@dataclass(frozen=True)
class VoxelLayout:
    """Storage of a file's voxels, axis i first."""

    dtype: np.dtype[Any]  # of one voxel, with the file's byte order
    encoding: str  # ``raw`` or ``gzip``: of all that the file holds from byte ``start`` on
    start: int = 0  # bytes of the file before the encoded data
    offset: int = 0  # bytes of the decoded data before the first voxel
    slope: float = 1.0  # what a stored value is multiplied with; 1 and an intercept of 0 leave it as it is
    intercept: float = 0.0


@dataclass(frozen=True, eq=False)
class VolumeGrid:
    """Grid of a volume's voxels in space; their values have not been read."""

    shape: tuple[int, int, int]  # voxels along i, j, k
    T_ct_index: NDArray[np.float64]  # shape (4, 4), maps voxel index (i, j, k) to LPS mm
    fields: dict[str, str]  # the file's own key/value remarks (NRRD ``key:=value``), empty for the other formats

    @property
    def count(self) -> int:
        """Number of voxels."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    @property
    def spacing_mm(self) -> NDArray[np.float64]:
        """Distance of neighbouring voxels along i, j and k, shape (3,)."""
        return np.asarray(np.linalg.norm(self.T_ct_index[:3, :3], axis=0))

    def contains(self, point_ct: NDArray[np.float64]) -> bool:
        """Whether a point (3,), LPS mm, lies in a voxel."""
        index = np.linalg.solve(self.T_ct_index, np.append(point_ct, 1.0))[:3]
        return bool(np.all((index >= -0.5) & (index <= np.array(self.shape) - 0.5)))


@dataclass(frozen=True, eq=False)
class VolumeHeader(VolumeGrid):
    """One volume in one or two files as its header describes it."""

    cells: VoxelLayout
    data_path: Path  # the file that holds them: the header's own, or one beside it
    layers: int = 1  # how many values each voxel has, one for each layer of segments that overlap
    notes: tuple[str, ...] = ()


def check_shape(shape: tuple[int, ...], *, where: Path) -> tuple[int, int, int]:
    """The shape of a volume. Raises InputError: no three axes of two voxels or more, or above ``MAX_VOXELS`` in all."""
    if len(shape) != 3 or min(shape) < 2:
        refuse(f"a volume of size {shape}", where, "3 axes with at least 2 voxels each", "wrong_dimension")
    count = shape[0] * shape[1] * shape[2]
    if count > MAX_VOXELS:
        refuse(f"the header claims {count} voxels", where, f"at most {MAX_VOXELS}", "too_many")
    return shape[0], shape[1], shape[2]


def check_affine(T_ct_index: NDArray[np.float64], *, where: Path) -> NDArray[np.float64]:
    """The affine (4, 4), voxel index to mm, read-only.

    Raises InputError, named: not finite, zero or singular, implausible spacing, sheared, implausible origin.
    """
    T = np.array(T_ct_index, dtype=np.float64)
    if not np.isfinite(T).all():
        refuse("the affine has NaN or infinity", where, "finite numbers", "not_finite")
    with np.errstate(over="ignore"):  # float32 headers reach 1e38; the spacing check below refuses them
        spacing = np.linalg.norm(T[:3, :3], axis=0)
    if not np.all((spacing >= MIN_SPACING_MM) & (spacing <= MAX_SPACING_MM)):
        shown = " x ".join(f"{s:.3g}" for s in spacing)
        kind = "a zero or singular affine, " if spacing.min() == 0 else ""
        allowed = f"{MIN_SPACING_MM} to {MAX_SPACING_MM} mm (is the unit right?)"
        refuse(f"{kind}voxel spacing {shown} mm", where, allowed, "implausible_spacing")
    axes = T[:3, :3] / spacing
    shear = float(np.abs(axes.T @ axes - np.eye(3)).max())
    if shear > SHEAR_TOLERANCE:
        kind = "singular" if abs(np.linalg.det(axes)) < SHEAR_TOLERANCE else "sheared"
        what = f"the affine is {kind}: two voxel axes are {shear:.2g} (cosine) from being perpendicular"
        refuse(what, where, f"axes perpendicular within {SHEAR_TOLERANCE}", "sheared")
    if np.abs(T[:3, 3]).max() > MAX_ORIGIN_MM:
        refuse(f"origin at {T[:3, 3]} mm", where, f"within {MAX_ORIGIN_MM:.0f} mm", "too_far")
    T.setflags(write=False)
    return T


def corner_deviation_mm(T_a: NDArray[np.float64], T_b: NDArray[np.float64], shape: tuple[int, int, int]) -> float:
    """Largest distance between where two affines place a corner of the volume, mm."""
    return float(np.linalg.norm(apply(T_a - T_b, _corners(shape)), axis=1).max())


def _corners(shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """The corners of a volume, shape (8, 3), mm."""
    return np.array(list(itertools.product(*((0, n - 1) for n in shape))), dtype=np.float64)


def refuse_lost_grid(labels: VolumeGrid, image: VolumeGrid, *, where: Path) -> None:
    """Refuse labels with an image's voxels that begin at 0, elsewhere: a program kept them, and not where they lie."""
    boxes = np.array([apply(one.T_ct_index, _corners(one.shape)) for one in (labels, image)])
    apart = max(float(np.abs(np.subtract(*ends)).max()) for ends in (boxes.min(axis=1), boxes.max(axis=1)))
    if sorted(labels.shape) == sorted(image.shape) and not labels.T_ct_index[:3, 3].any() and apart > ONE_PLACE_MM:
        sizes, steps = (" x ".join(f"{one:.4g}" for one in some) for some in (labels.shape, labels.spacing_mm))
        what = (
            f"has the CT's {sizes} voxels, but starts at 0, 0, 0 in steps of {steps} mm, up to {apart:.0f} mm away: "
            "the position of its voxels was lost"
        )
        refuse(what, where, "labels on the grid of their CT: copy the CT's origin, spacing and direction", "grid_lost")


def check_exact_size(actual: int, promised: int, *, where: Path) -> None:
    """Refuses a file that is shorter or longer than its header says."""
    if actual != promised:
        kind = "cut short" if actual < promised else "longer than its header states"
        what = f"the file is {kind}: {actual} bytes, but the header states {promised}"
        refuse(what, where, "a complete file", "size_mismatch")


DEFLATE_RATIO = 1033
"""Deflate cannot shrink by more than 1032:1 (zlib's technical notes), so a tiny file cannot hold a large volume."""
GZIP_WINDOW = 16 + zlib.MAX_WBITS
"""Tells zlib to expect gzip's header and check sum."""
PART_BYTES = 1 << 20
"""Bytes that are read, and made, at a time."""


def inflated(content: memoryview, promised: int, *, where: Path) -> NDArray[np.uint8]:
    """Inflate gzip data of one or several members, padded with zeros, to the ``promised`` bytes, shape (promised,).

    Stops one byte after them, so what a bomb would inflate to is never made. Raises InputError: damaged, truncated, or
    of another length.
    """
    if promised > len(content) * DEFLATE_RATIO:
        what = f"{len(content)} compressed bytes cannot hold the {promised} bytes that the header states"
        refuse(what, where, "a complete file", "size_mismatch")
    cells = np.empty(promised, np.uint8)
    count = 0
    try:
        for part in _parts(content, promised + 1):
            if count + len(part) <= promised:
                cells[count : count + len(part)] = np.frombuffer(part, np.uint8)
            count += len(part)
    except (EOFError, zlib.error) as error:
        what = f"the compressed data are damaged or cut short after {count} of {promised} bytes ({error})"
        raise InputError(what, where=where, allowed="a complete gzip file", code="file_damaged") from error
    check_exact_size(count, promised, where=where)
    return cells


def first_bytes(content: memoryview, count: int, *, where: Path, allowed: str) -> bytes:
    """The first bytes that gzip data inflate to; fewer where there are no more. Raises InputError: damaged there."""
    with refusing((EOFError, zlib.error), "not a readable gzip file", where, allowed, "file_damaged"):
        return b"".join(_parts(content, count))


def _parts(content: memoryview, most: int) -> Iterator[bytes]:
    """Parts of what gzip data inflate to: at most so many bytes, and the check sums of all members that end there."""
    at, member = 0, zlib.decompressobj(GZIP_WINDOW)
    while most > 0:
        waiting: bytes | memoryview = member.unconsumed_tail
        if not waiting:
            waiting = content[at : at + PART_BYTES]
            at += len(waiting)
        part = member.decompress(waiting, min(most, PART_BYTES))
        if member.eof:
            at, member = at - len(member.unused_data), zlib.decompressobj(GZIP_WINDOW)
            if at == len(content) or (content[at] == 0 and not any(content[at:])):
                most = len(part)
        elif not part and not waiting:
            raise EOFError("the data end before their end marker")
        most -= len(part)
        if part:
            yield part


def decoded(content: memoryview, header: VolumeHeader) -> NDArray[Any]:
    """The voxels as stored, in this machine's byte order. Raises InputError: damaged, or not as long as it states.

    Returns:
        Shape (ni, nj, nk), axis i running fastest in memory; (layers, ni, nj, nk) where there are several layers.
    """
    cells, where = header.cells, header.data_path
    data, count = content[cells.start :], header.count * header.layers
    promised = cells.offset + count * cells.dtype.itemsize
    if cells.encoding == "raw":
        check_exact_size(len(data), promised, where=where)
    whole = data if cells.encoding == "raw" else inflated(data, promised, where=where)
    flat = np.frombuffer(whole, cells.dtype, count, cells.offset)
    shape = header.shape if header.layers == 1 else (header.layers, *header.shape)
    return flat.astype(cells.dtype.newbyteorder("="), copy=False).reshape(shape, order="F")
