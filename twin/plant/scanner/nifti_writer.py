"""A volume as NIfTI-1 (nifti1.h, DFWG 2003): one file, its place as sform in RAS, gzip without a time."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.volumes.nifti_header import FIRST_VOXEL_BYTE, LPS_FROM_RAS, TYPES

CODE_OF_TYPE = {name: code for code, name in TYPES.items()}
MM = 2
"""``xyzt_units``."""
SCANNER = 1
"""``sform_code``: the scanner's own coordinates."""
FAST = 1
"""Of gzip: noise does not get smaller by trying harder."""


def write_nifti(path: Path, values: NDArray[Any], T_ct_index: Floats) -> Path:
    """Write a ``.nii.gz``.

    Args:
        path: The file.
        values: Shape (ni, nj, nk), whole numbers or floats.
        T_ct_index: Shape (4, 4), voxel index to LPS mm; kept in single precision, as the format does.
    """
    code = CODE_OF_TYPE[values.dtype.str[1:]]
    header = bytearray(FIRST_VOXEL_BYTE)
    struct.pack_into("<i", header, 0, 348)
    struct.pack_into("<8h", header, 40, 3, *values.shape, 1, 1, 1, 1)
    struct.pack_into("<2h", header, 70, code, 8 * values.dtype.itemsize)
    spacing = np.linalg.norm(T_ct_index[:3, :3], axis=0)
    struct.pack_into("<8f", header, 76, 1.0, *spacing, 0.0, 0.0, 0.0, 0.0)
    struct.pack_into("<f", header, 108, FIRST_VOXEL_BYTE)
    struct.pack_into("<2f", header, 112, 1.0, 0.0)
    header[123] = MM
    struct.pack_into("<2h", header, 252, 0, SCANNER)
    struct.pack_into("<12f", header, 280, *(LPS_FROM_RAS * T_ct_index)[:3].ravel())
    header[344:348] = b"n+1\0"
    with path.open("wb") as raw, gzip.GzipFile("", "wb", FAST, raw, mtime=0) as packed:
        packed.write(bytes(header))
        packed.write(np.ascontiguousarray(values.T).astype(values.dtype.newbyteorder("<"), copy=False).data)
    return path
