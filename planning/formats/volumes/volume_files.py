"""Volumes from NIfTI and NRRD files: voxels, and where they lie in LPS mm.

General readers fill a truncated file with zeros, turn NaN into 0, load a NaN affine and follow a header to any file of
the machine. So headers and voxels are read here, from the bytes that were hashed: what a header promises is held
against what is there, and nothing is inflated beyond it. The tests hold every value against SimpleITK.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.brief import brief
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import is_plain_file
from puncture_twin.planning.base.input_file import absence, read_input
from puncture_twin.planning.formats.volumes import nrrd_header
from puncture_twin.planning.formats.volumes.nifti_header import parse_nifti_header
from puncture_twin.planning.formats.volumes.nrrd_header import parse_nrrd_header
from puncture_twin.planning.formats.volumes.volume_header import MAX_VOXELS, VolumeHeader, VoxelLayout
from puncture_twin.planning.formats.volumes.voxels import decoded

NIFTI_ENDINGS = (".nii", ".nii.gz")
NRRD_ENDINGS = (".nrrd", ".nhdr")
MAX_FILE_BYTES = 8 * MAX_VOXELS + 10_000_000
"""As many voxels as are taken, of the widest type, behind the longest header."""
SCALING_ROUNDING = float(np.finfo(np.float64).eps)
"""A slope this near to 1, and an intercept this near to 0, leave the stored values and their type as they are."""


@dataclass(frozen=True, eq=False)
class Volume:
    """A scalar volume in patient space.

    Attributes:
        values: Shape (ni, nj, nk), read-only; Hounsfield units for a CT.
        T_ct_index: Shape (4, 4), maps voxel index (i, j, k), at the voxel's centre, to LPS mm. Its determinant
            may have either sign: index axes can be left-handed, the patient's axes are not touched by that.
        path: Where it came from.
        fields: The file's own key/value remarks.
    """

    values: NDArray[Any]
    T_ct_index: NDArray[np.float64]
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
    """The name of the file beside this one that holds its voxels; None for a volume in one file.

    Args:
        content: The file that was named.
        path: Its name.

    Raises:
        InputError: A header that is damaged, or names data elsewhere.
    """
    return nrrd_header.data_file(content, path) if path.name.lower().endswith(NRRD_ENDINGS) else None


def parse_header(content: bytes, path: Path) -> VolumeHeader:
    """The checked header of a volume file that has been read; the voxels are not looked at.

    Raises:
        InputError: If its ending is unknown, or the header is wrong.
    """
    return _parser(path)(content, path)


def read_volume(path: Path) -> Volume:
    """A volume from .nii, .nii.gz, .nrrd, .nhdr (data beside it) or .seg.nrrd, in LPS mm.

    NIfTI is RAS and turned here; NRRD says its space. Units of metre and micrometre in NIfTI become mm.

    Raises:
        InputError: Anything wrong with the file; nothing else comes out, whatever its bytes.
    """
    if not is_plain_file(path):
        raise InputError(f"the file {absence(path)}", where=path, allowed="a volume file")
    _parser(path)  # an unknown ending is refused before anything is read
    content = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    beside = data_file(content, path)
    if beside is None:
        return parse_volume(content, path)
    data_path = path.with_name(beside)
    return parse_volume(content, path, read_input(data_path, max_bytes=MAX_FILE_BYTES, where=str(data_path)))


def parse_volume(content: bytes, path: Path, data: bytes | None = None) -> Volume:
    """The same of a file that has been read; it is not opened again.

    Args:
        content: The file that was named.
        path: Its name.
        data: The file that `data_file` names, where it names one.

    Raises:
        InputError: As `read_volume`, but for reading.
    """
    header = parse_header(content, path)
    stored = content if data is None else data
    try:
        values = _scaled(decoded(memoryview(stored), header), header.cells)
    except MemoryError as error:
        raise InputError("it does not fit this machine's memory", where=path, allowed="a smaller one") from error
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError("a voxel is NaN or infinite", where=path, allowed="finite values")
    return Volume(values, header.T_ct_index, path, header.fields)


def _parser(path: Path) -> Callable[[bytes, Path], VolumeHeader]:
    name = path.name.lower()
    if name.endswith(NIFTI_ENDINGS):
        return parse_nifti_header
    if name.endswith(NRRD_ENDINGS):
        return parse_nrrd_header
    raise InputError("unknown file ending", where=path, allowed=", ".join(NIFTI_ENDINGS + NRRD_ENDINGS))


def _scaled(stored: NDArray[Any], cells: VoxelLayout) -> NDArray[Any]:
    """Stored values times the slope plus the intercept; of integers that makes single precision, as SimpleITK does."""
    if abs(cells.slope - 1.0) <= SCALING_ROUNDING and abs(cells.intercept) <= SCALING_ROUNDING:
        return stored
    kept = np.dtype(np.float64 if stored.dtype == np.float64 else np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
        scaled = stored.astype(kept).astype(np.float64)
        scaled *= cells.slope
        scaled += cells.intercept
        return scaled.astype(kept)
