"""Volumes from NIfTI and NRRD files: voxels, and where they lie in LPS mm.

SimpleITK reads the voxels, but it fills a truncated file with zeros, loads a NaN affine and follows a header to
any file of the machine. So our own reading of the header comes first, is held against the real size of the
file, and SimpleITK's answer must then agree with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk  # noqa: N813 - the name that its whole documentation uses
from numpy.typing import NDArray

from planning.errors import InputError
from planning.formats import nrrd_header
from planning.formats.nifti_header import read_nifti_header
from planning.formats.nrrd_header import read_nrrd_header
from planning.formats.volume_header import MAX_VOXELS, VolumeHeader, corner_deviation_mm

NIFTI_ENDINGS = (".nii", ".nii.gz")
NRRD_ENDINGS = (".nrrd", ".nhdr")
MAX_FILE_BYTES = 8 * MAX_VOXELS + 10_000_000
"""As many voxels as are taken, of the widest type, behind the longest header."""
AFFINE_TOLERANCE_MM = 0.25
"""How far SimpleITK and we may place a corner apart: its choice of qform over sform (0.2 mm), and rounding."""


@dataclass(frozen=True, eq=False)
class Volume:
    """A scalar volume in patient space.

    Attributes:
        values: Shape (ni, nj, nk), read-only; Hounsfield units for a CT.
        T_ct_index: Shape (4, 4), maps voxel index (i, j, k), at the voxel's centre, to LPS mm. Its determinant
            may have either sign: index axes can be left-handed, the patient's axes are not touched by that.
        path: Where it came from.
    """

    values: NDArray[Any]
    T_ct_index: NDArray[np.float64]
    path: Path

    def __post_init__(self) -> None:
        for name in ("values", "T_ct_index"):
            view = getattr(self, name).view()
            view.setflags(write=False)
            object.__setattr__(self, name, view)


def read_header(path: Path) -> VolumeHeader:
    """The checked header of a volume file.

    Raises:
        InputError: If there is no such file, its ending is unknown, or the header or the file's size is wrong.
    """
    name = path.name.lower()
    if not path.is_file():
        kind = "is a folder" if path.is_dir() else "does not exist"
        raise InputError(f"the file {kind}", where=path, allowed="a volume file")
    try:
        if name.endswith(NIFTI_ENDINGS):
            return read_nifti_header(path)
        if name.endswith(NRRD_ENDINGS):
            return read_nrrd_header(path)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path, allowed="a readable file") from error
    raise InputError("unknown file ending", where=path, allowed=", ".join(NIFTI_ENDINGS + NRRD_ENDINGS))


def data_file(content: bytes, path: Path) -> str | None:
    """The name of the file beside this one that holds its voxels; None for a volume in one file.

    Args:
        content: The file that was named.
        path: Its name.

    Raises:
        InputError: A header that is damaged, or names data elsewhere.
    """
    return nrrd_header.data_file(content, path) if path.name.lower().endswith(NRRD_ENDINGS) else None


def read_volume(path: Path) -> Volume:
    """A volume from .nii, .nii.gz, .nrrd, .nhdr (data beside it) or .seg.nrrd, in LPS mm.

    NIfTI is RAS and turned here; NRRD says its space. Units of metre and micrometre in NIfTI become mm.

    Raises:
        InputError: Anything wrong with the file; nothing else comes out, whatever its bytes.
    """
    header = read_header(path)
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NiftiImageIO" if path.name.lower().endswith(NIFTI_ENDINGS) else "NrrdImageIO")
    reader.SetFileName(str(path))
    try:
        image = reader.Execute()
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise InputError(f"SimpleITK cannot read it ({reason})", where=path, allowed="a sound file") from error
    except MemoryError as error:
        raise InputError("it does not fit this machine's memory", where=path, allowed="a smaller one") from error
    return Volume(_agreed_values(image, header, path), header.T_ct_index, path)


def _agreed_values(image: sitk.Image, header: VolumeHeader, path: Path) -> NDArray[Any]:
    if image.GetNumberOfComponentsPerPixel() != 1 or tuple(image.GetSize()) != header.shape:
        what = f"SimpleITK sees a volume of size {tuple(image.GetSize())}, the header says {header.shape}"
        raise InputError(what, where=path, allowed="a header that can be read in one way only")
    T = np.eye(4)
    T[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * np.array(image.GetSpacing())
    T[:3, 3] = image.GetOrigin()
    apart = corner_deviation_mm(T, header.T_ct_index, header.shape)
    if not apart <= AFFINE_TOLERANCE_MM:
        what = f"SimpleITK places a corner {apart:.3g} mm from where the header does"
        raise InputError(what, where=path, allowed=f"agreement within {AFFINE_TOLERANCE_MM} mm")
    values = sitk.GetArrayFromImage(image).transpose(2, 1, 0)
    if values.dtype.kind not in "iuf":
        raise InputError(f"values of type {values.dtype}", where=path, allowed="integers or floats")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError("the volume holds NaN or infinity", where=path, allowed="finite values")
    return np.asarray(values)
