"""Volumes from NIfTI and NRRD files: voxels, where they lie in LPS mm, and one order of their axes.

General readers fill a truncated file with zeros, turn NaN into 0, load a NaN affine and follow a header to any file of
the machine. So headers and voxels are read here, from the bytes that were hashed: what a header promises is held
against what is there, and nothing is inflated beyond it. The tests hold every value against SimpleITK.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import absence, is_plain_file, read_input
from puncture_twin.planning.base.text import Shown, brief
from puncture_twin.planning.formats.volumes import nrrd_header, volume_header
from puncture_twin.planning.formats.volumes.nifti_header import parse_nifti_header
from puncture_twin.planning.formats.volumes.nrrd_header import parse_nrrd_header

NIFTI_ENDINGS = (".nii", ".nii.gz")
NRRD_ENDINGS = (".nrrd", ".nhdr")
MAX_FILE_BYTES = 8 * volume_header.MAX_VOXELS + 10_000_000
"""Most bytes of a file: the most voxels, of the widest type, behind the longest header."""
SCALING_ROUNDING = float(np.finfo(np.float64).eps)
"""A slope this near to 1, and an intercept this near to 0, leave the stored values and their type as they are."""


@dataclass(frozen=True, eq=False)
class Volume(Shown):
    """A scalar volume in patient space."""

    values: NDArray[Any]
    """Shape (ni, nj, nk), read-only; Hounsfield units for a CT."""
    T_ct_index: NDArray[np.float64]
    """Shape (4, 4), maps voxel index (i, j, k), at the voxel's centre, to LPS mm. Its determinant may have either sign:
    index axes can be left-handed, the patient's axes are not touched by that."""
    path: Path
    fields: dict[str, str] = field(default_factory=dict)

    @brief
    def __repr__(self) -> str:
        return f"{' x '.join(map(str, self.values.shape))} voxels of {self.values.dtype}, {self.path}"

    def __post_init__(self) -> None:
        for name in ("values", "T_ct_index"):
            view = getattr(self, name).view()
            view.setflags(write=False)
            object.__setattr__(self, name, view)


def data_file(content: bytes, path: Path) -> str | None:
    """The name of the file beside this one with its voxels, or None. Raises InputError: damaged, or data elsewhere."""
    return nrrd_header.data_file(content, path) if path.name.lower().endswith(NRRD_ENDINGS) else None


def parse_header(content: bytes, path: Path) -> volume_header.VolumeHeader:
    """The checked header of a volume file that has been read; the voxels are not looked at."""
    return _parser(path)(content, path)


def read_volume(path: Path) -> Volume:
    """A volume from .nii, .nii.gz, .nrrd, .nhdr (data beside it) or .seg.nrrd, in LPS mm.

    NIfTI is RAS and turned here; NRRD says its space. Units of metre and micrometre in NIfTI become mm.
    Raises InputError: anything wrong with the file; nothing else comes out, whatever its bytes.
    """
    if not is_plain_file(path):
        refuse(f"the file {absence(path)}", path, "a volume file", "no_such_file")
    _parser(path)  # an unknown ending is refused before anything is read
    content = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    adjacent = data_file(content, path)
    if adjacent is None:
        return parse_volume(content, path)
    data_path = path.with_name(adjacent)
    return parse_volume(content, path, read_input(data_path, max_bytes=MAX_FILE_BYTES, where=str(data_path)))


def parse_volume(content: bytes, path: Path, data: bytes | None = None) -> Volume:
    """Parse a volume file that was read, and ``data``, the file that `data_file` names where it names one."""
    header = parse_header(content, path)
    stored = content if data is None else data
    try:
        values = _scaled(volume_header.decoded(memoryview(stored), header), header.cells)
    except MemoryError as error:
        what = "the volume does not fit into the memory of this machine"
        raise InputError(what, where=path, allowed="a smaller one", code="out_of_memory") from error
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        refuse("a voxel is NaN or infinite", path, "finite values", "not_finite")
    return Volume(values, header.T_ct_index, path, header.fields)


def _parser(path: Path) -> Callable[[bytes, Path], volume_header.VolumeHeader]:
    name = path.name.lower()
    if not name.endswith(NIFTI_ENDINGS + NRRD_ENDINGS):
        refuse("unknown file ending", path, ", ".join(NIFTI_ENDINGS + NRRD_ENDINGS), "unknown_format")
    return parse_nifti_header if name.endswith(NIFTI_ENDINGS) else parse_nrrd_header


def _scaled(stored: NDArray[Any], cells: volume_header.VoxelLayout) -> NDArray[Any]:
    """Stored values times the slope plus the intercept; of integers that makes single precision, as SimpleITK does."""
    if abs(cells.slope - 1.0) <= SCALING_ROUNDING and abs(cells.intercept) <= SCALING_ROUNDING:
        return stored
    precision = np.dtype(np.float64 if stored.dtype == np.float64 else np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
        scaled = stored.astype(precision).astype(np.float64)
        scaled *= cells.slope
        scaled += cells.intercept
        return scaled.astype(precision)


Content = Callable[[str], bytes]
"""The bytes of a file by its name: those that were hashed, each time."""


class VolumeSource(Protocol):
    """A volume in one file, in two, or in a folder of slices.

    Attributes:
        files: Every file that decides a voxel or its place, as the content is wanted it.
        part: Which part of these files it is, where they hold several volumes.
        grid: Where the voxels lie, LPS mm.
    """

    @property
    def path(self) -> Path: ...  # noqa: D102  the class says it
    @property
    def files(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def part(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def notes(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def grid(self) -> volume_header.VolumeGrid: ...  # noqa: D102

    def volume(self) -> Volume:
        """The volume with its voxels, which are decoded at each call."""


@dataclass(frozen=True)
class VolumeFile:
    """A volume in one file, or in a header and a file of voxels beside it."""

    path: Path
    files: tuple[str, ...]  # that file, and the one beside it
    content: Content
    part: tuple[str, ...] = ()

    @cached_property
    def grid(self) -> volume_header.VolumeHeader:
        """Grid of the voxels, LPS mm, as the checked header states it."""
        return parse_header(self.content(self.files[0]), self.path)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for a person on how the header was read."""
        return self.grid.notes

    def volume(self) -> Volume:
        """The volume with its voxels."""
        header, *data = (self.content(name) for name in self.files)
        return parse_volume(header, self.path, data[0] if data else None)


@dataclass(frozen=True, eq=False)
class Oriented:
    """An array in canonical order."""

    values: NDArray[Any]  # shape (nx, ny, nz), a view of what was given
    T_ct_index: NDArray[np.float64]  # shape (4, 4), maps an index of ``values`` to LPS mm; its determinant is positive

    @property
    def spacing_mm(self) -> NDArray[np.float64]:
        """Voxel size along each axis, shape (3,), mm."""
        return np.asarray(np.linalg.norm(self.T_ct_index[:3, :3], axis=0))


TILE = (32, 64)
"""Slices and rows that are copied at a time: what they take lies in a processor's own memory."""


def in_order(values: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """A copy of values (nx, ny, nz), in any order, that lies in memory in that of its axes, the last one fastest."""
    ordered = np.empty(values.shape, dtype)
    for k in range(0, values.shape[2], TILE[0]):
        for j in range(0, values.shape[1], TILE[1]):
            tile = (slice(None), slice(j, j + TILE[1]), slice(k, k + TILE[0]))
            ordered[tile] = values[tile]
    return ordered


def canonical(values: NDArray[Any], T_ct_index: NDArray[np.float64]) -> Oriented:
    """Voxels (ni, nj, nk), index to LPS mm (4, 4), with axes permuted and flipped to run nearly along +L, +P, +S.

    What an algorithm makes of a volume may depend on the array's order (ambiguous cells of marching cubes do);
    after this step it cannot depend on how the file stored it.
    """
    axes = T_ct_index[:3, :3] / np.linalg.norm(T_ct_index[:3, :3], axis=0)
    order = max(itertools.permutations(range(3)), key=lambda p: sum(abs(axes[row, p[row]]) for row in range(3)))
    T_index_oriented = np.zeros((4, 4))
    T_index_oriented[3, 3] = 1.0
    flips = []
    for row, axis in enumerate(order):
        backward = bool(axes[row, axis] < 0)
        T_index_oriented[axis, row] = -1.0 if backward else 1.0
        T_index_oriented[axis, 3] = values.shape[axis] - 1 if backward else 0
        flips.append(slice(None, None, -1 if backward else 1))
    return Oriented(values.transpose(order)[tuple(flips)], T_ct_index @ T_index_oriented)
