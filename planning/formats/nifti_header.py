"""NIfTI-1 headers, read by ourselves before any library opens the file.

Layout and meaning of the fields: NIfTI-1 standard, nifti1.h (DFWG, 2003), "methods" 2 (qform) and 3 (sform).
A NIfTI affine maps to RAS; everything here leaves in LPS.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planning.errors import InputError
from planning.formats.volume_header import (
    CHUNK_BYTES,
    VolumeHeader,
    check_affine,
    check_exact_size,
    check_inflated_size,
    check_shape,
    corner_deviation_mm,
)

HEADER_BYTES = 348
FIRST_VOXEL_BYTE = 352
FLOAT_TYPES = {16: "f4", 64: "f8"}
"""Datatype codes of floats. The NIfTI library inside SimpleITK turns NaN and infinity into 0, that is HU of water
and label of background, and says nothing: so they are looked for before."""
BITS_OF_DATATYPE = {2: 8, 4: 16, 8: 32, 16: 32, 64: 64, 256: 8, 512: 16, 768: 32, 1024: 64, 1280: 64}
"""Datatype code to bits per voxel: signed and unsigned integers and floats; no colour, no complex numbers."""
MM_PER_UNIT = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}
"""``xyzt_units`` to mm: unknown (taken as mm, and the spacing must then be plausible), metre, mm, micrometre."""
QFORM_TOLERANCE_MM = 0.2
"""How far the two affines may part at a corner: a float32 quaternion near a half turn errs by 4e-4 rad at worst."""
PIXDIM_TOLERANCE = 1e-3
"""Relative difference between pixdim and the sform's column lengths; SimpleITK takes its spacing from pixdim."""
LPS_FROM_RAS = np.array([[-1.0], [-1.0], [1.0], [1.0]])
"""Factors of the rows of an affine."""
PLAIN = "a single-file NIfTI-1 (.nii, .nii.gz) with 3 axes"


@dataclass(frozen=True)
class _Fields:
    """The header's fields that matter, as stored; ``order`` is the byte order, "<" or ">"."""

    order: str
    dim: tuple[int, ...]
    datatype: int
    bitpix: int
    pixdim: tuple[float, ...]
    vox_offset: float
    scaling: tuple[float, float]
    units: int
    qform_code: int
    sform_code: int
    quaternion: tuple[float, ...]
    qoffset: tuple[float, ...]
    srow: tuple[float, ...]


def read_nifti_header(path: Path) -> VolumeHeader:
    """What the header says, held against the real size of the file (inflated and counted if it is a .nii.gz).

    Where sform and qform are both given they must agree, so that it does not matter which one a program takes
    (SimpleITK takes the sform if its code is 1, else the qform). Trailing bytes are refused as missing ones are.

    Raises:
        InputError: Whatever is wrong with the header, or the file is shorter or longer than promised.
    """
    compressed = path.name.lower().endswith(".gz")
    fields = _parse(_first_bytes(path, compressed), path)
    shape = _shape(fields, path)
    if BITS_OF_DATATYPE.get(fields.datatype) != fields.bitpix:
        what = f"datatype {fields.datatype} with {fields.bitpix} bits"
        raise InputError(what, where=path, allowed=f"(datatype: bits) {BITS_OF_DATATYPE}")
    if not np.isfinite(fields.scaling).all():
        raise InputError("scl_slope or scl_inter is not finite", where=path, allowed="finite numbers")
    header = VolumeHeader(shape, check_affine(_affine(fields, shape, path), where=path), {})
    offset = fields.vox_offset
    if not (np.isfinite(offset) and offset >= FIRST_VOXEL_BYTE and offset == int(offset)):
        raise InputError(f"vox_offset {offset}", where=path, allowed=f"a whole number >= {FIRST_VOXEL_BYTE}")
    promised = int(offset) + shape[0] * shape[1] * shape[2] * fields.bitpix // 8
    size = path.stat().st_size
    if compressed:
        with path.open("rb") as stream:
            check_inflated_size(stream, size, promised, where=path)
    else:
        check_exact_size(size, promised, where=path)
    if fields.datatype in FLOAT_TYPES:
        _check_finite(path, compressed, int(offset), np.dtype(fields.order + FLOAT_TYPES[fields.datatype]))
    return header


def _check_finite(path: Path, compressed: bool, offset: int, dtype: np.dtype[np.floating]) -> None:
    """Looks at every voxel of a file whose size has been checked."""
    with path.open("rb") as raw:
        stream = gzip.GzipFile(fileobj=raw, mode="rb") if compressed else raw
        stream.seek(offset)
        while chunk := stream.read(CHUNK_BYTES):  # a multiple of 8: whole voxels, since neither kind reads short
            if not np.isfinite(np.frombuffer(chunk, dtype=dtype)).all():
                raise InputError("a voxel is NaN or infinite", where=path, allowed="finite values")


def _first_bytes(path: Path, compressed: bool) -> bytes:
    try:
        with path.open("rb") as raw:
            return gzip.GzipFile(fileobj=raw, mode="rb").read(HEADER_BYTES) if compressed else raw.read(HEADER_BYTES)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise InputError(f"not a readable gzip file ({error})", where=path, allowed=PLAIN) from error


def _parse(data: bytes, path: Path) -> _Fields:
    if len(data) < HEADER_BYTES:
        raise InputError(f"the file ends inside the header ({len(data)} bytes)", where=path, allowed=PLAIN)
    order = {348: "<", 1543569408: ">"}.get(struct.unpack_from("<i", data, 0)[0])
    if order is None or data[344:348] != b"n+1\0":
        raise InputError("no NIfTI-1 header (header size and magic 'n+1')", where=path, allowed=PLAIN)

    def get(layout: str, offset: int) -> tuple[float, ...]:
        return struct.unpack_from(order + layout, data, offset)

    return _Fields(
        order=order,
        dim=struct.unpack_from(order + "8h", data, 40),
        datatype=struct.unpack_from(order + "h", data, 70)[0],
        bitpix=struct.unpack_from(order + "h", data, 72)[0],
        pixdim=get("8f", 76),
        vox_offset=get("f", 108)[0],
        scaling=(get("f", 112)[0], get("f", 116)[0]),
        units=data[123] & 7,
        qform_code=struct.unpack_from(order + "h", data, 252)[0],
        sform_code=struct.unpack_from(order + "h", data, 254)[0],
        quaternion=get("3f", 256),
        qoffset=get("3f", 268),
        srow=get("12f", 280),
    )


def _shape(fields: _Fields, path: Path) -> tuple[int, int, int]:
    if fields.dim[0] != 3:
        what = f"{fields.dim[0]} dimensions, sizes {fields.dim[1:]}"
        raise InputError(what, where=path, allowed="one volume with 3 dimensions, no time series, no components")
    return check_shape(fields.dim[1:4], where=path)


def _affine(fields: _Fields, shape: tuple[int, int, int], path: Path) -> NDArray[np.float64]:
    """Voxel index to LPS mm, from the sform where it is given, else from the qform. Not checked yet."""
    if fields.units not in MM_PER_UNIT:
        what = f"unit code {fields.units} in xyzt_units"
        raise InputError(what, where=path, allowed="0 unknown (taken as mm), 1 metre, 2 mm, 3 micrometre")
    scale = MM_PER_UNIT[fields.units]
    if not (np.isfinite(fields.pixdim[1:4]).all() and min(fields.pixdim[1:4]) > 0):
        raise InputError(f"pixdim {fields.pixdim[1:4]}", where=path, allowed="positive voxel sizes")
    if fields.sform_code <= 0 and fields.qform_code <= 0:
        what = "neither sform nor qform is set (both codes 0): the file does not say its space"
        raise InputError(what, where=path, allowed="sform_code or qform_code > 0")
    candidates = []
    if fields.sform_code > 0:
        candidates.append(_to_lps_mm(_sform(fields), scale))
        _check_pixdim(candidates[0], np.array(fields.pixdim[1:4]) * scale, path)
    if fields.qform_code > 0:
        candidates.append(_to_lps_mm(_qform(fields, path), scale))
    checked = [check_affine(T, where=path) for T in candidates]
    apart = corner_deviation_mm(checked[0], checked[-1], shape)
    if apart > QFORM_TOLERANCE_MM:
        what = f"sform and qform place a corner of the volume {apart:.3g} mm apart"
        raise InputError(what, where=path, allowed=f"both agree within {QFORM_TOLERANCE_MM} mm, or one is unset")
    return checked[0]


def _check_pixdim(T_ct_index: NDArray[np.float64], pixdim_mm: NDArray[np.float64], path: Path) -> None:
    with np.errstate(over="ignore", invalid="ignore"):  # a hostile affine is refused by name just after
        spacing = np.linalg.norm(T_ct_index[:3, :3], axis=0)
    plausible = np.isfinite(spacing).all() and spacing.min() > 0
    if plausible and np.abs(spacing / pixdim_mm - 1).max() > PIXDIM_TOLERANCE:
        what = f"pixdim says voxels of {pixdim_mm.round(4)} mm, the sform {spacing.round(4)} mm"
        raise InputError(what, where=path, allowed=f"both agree within {PIXDIM_TOLERANCE:.1%}")


def _to_lps_mm(T_ras_index: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    T = LPS_FROM_RAS * T_ras_index
    T[:3] *= scale
    return T


def _sform(fields: _Fields) -> NDArray[np.float64]:
    return np.vstack([np.reshape(fields.srow, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def _qform(fields: _Fields, path: Path) -> NDArray[np.float64]:
    """Quaternion (a, b, c, d) with a >= 0, column 3 times qfac (NIfTI-1 standard, method 2)."""
    b, c, d = fields.quaternion
    square = b * b + c * c + d * d
    if not square <= 1 + 1e-6:  # float32 rounding of a unit quaternion; NaN lands here too
        raise InputError(f"quaternion {(b, c, d)} of the qform", where=path, allowed="b^2 + c^2 + d^2 <= 1")
    a = max(0.0, 1.0 - square) ** 0.5
    R = np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
    qfac = -1.0 if fields.pixdim[0] < 0 else 1.0
    T = np.eye(4)
    T[:3, :3] = R * np.array(fields.pixdim[1:4]) * [1.0, 1.0, qfac]
    T[:3, 3] = fields.qoffset
    return T
