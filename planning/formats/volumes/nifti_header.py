"""NIfTI-1 headers, checked before any voxel is looked at.

Layout and meaning of the fields: NIfTI-1 standard, nifti1.h (DFWG, 2003), "methods" 2 (qform) and 3 (sform).
A NIfTI affine maps to RAS; everything here leaves in LPS.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.volumes import volume_header

HEADER_BYTES = 348
FIRST_VOXEL_BYTE = 352
TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
"""Datatype code to type: signed and unsigned integers and floats; no colour, no complex numbers."""
BITS_OF_DATATYPE = {code: 8 * np.dtype(name).itemsize for code, name in TYPES.items()}
"""Datatype code to bits per voxel."""
LEAST_SLOPE = float(np.finfo(np.float64).eps)
"""A slope below means "none" to some programs, and is one to others."""
MM_PER_UNIT = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}
"""``xyzt_units`` to mm: unknown (taken as mm, and the spacing must then be plausible), metre, mm, micrometre."""
QFORM_TOLERANCE_MM = 0.2
"""How far the two affines may part at a corner: a float32 quaternion near a half turn errs by 4e-4 rad at worst."""
PIXDIM_TOLERANCE = 1e-3
"""Relative difference between pixdim and the sform's column lengths; SimpleITK takes its spacing from pixdim."""
LPS_FROM_RAS = np.array([[-1.0], [-1.0], [1.0], [1.0]])
"""Factors of the rows of an affine."""
PLAIN = "a single-file NIfTI-1 (.nii, .nii.gz) with 3 axes"
LAYOUT = "40x8h14x2h2x8f3f3xB128x2h6f12f20x"
"""The fields of `_Fields` among those that do not matter, by `struct`."""


class _Fields(NamedTuple):
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


def parse_nifti_header(content: bytes, path: Path) -> volume_header.VolumeHeader:
    """The header of a NIfTI file; of a .nii.gz no more is inflated. Raises InputError: whatever is wrong with it.

    Where sform and qform are both given they must agree, so that it does not matter which one a program takes
    (SimpleITK takes the sform if its code is 1, else the qform).
    """
    compressed, head = path.name.lower().endswith(".gz"), content[:HEADER_BYTES]
    if compressed:
        head = volume_header.first_bytes(memoryview(content), HEADER_BYTES, where=path, allowed=PLAIN)
    fields = _parse(head, path)
    count = fields.dim[0]
    if not 3 <= count <= 7 or set(fields.dim[4 : count + 1]) - {1}:
        allowed = "one volume with 3 dimensions (further ones of length 1), no time series, no components"
        refuse(f"{count} dimensions, sizes {fields.dim[1 : max(count, 3) + 1]}", path, allowed, "wrong_dimension")
    shape = volume_header.check_shape(fields.dim[1:4], where=path)
    if BITS_OF_DATATYPE.get(fields.datatype) != fields.bitpix:
        what = f"datatype {fields.datatype} with {fields.bitpix} bits"
        refuse(what, path, f"(datatype: bits) {BITS_OF_DATATYPE}", "unknown_type")
    slope, intercept = fields.scaling
    if not np.isfinite(fields.scaling).all():
        refuse("scl_slope or scl_inter is not finite", path, "finite numbers", "not_finite")
    if slope == 0.0 and intercept == 0.0:  # none are stated
        slope = 1.0
    elif abs(slope) <= LEAST_SLOPE:
        what = f"scl_slope {slope:g} with scl_inter {intercept:g}: some programs apply the slope, others do not"
        refuse(what, path, "both 0, or a slope other than 0", "scaling_ambiguous")
    T_ct_index = volume_header.check_affine(_affine(fields, shape, path), where=path)
    offset = fields.vox_offset
    if not (np.isfinite(offset) and offset >= FIRST_VOXEL_BYTE and offset == int(offset)):
        refuse(f"vox_offset {offset}", path, f"a whole number >= {FIRST_VOXEL_BYTE}", "out_of_range")
    dtype = np.dtype(fields.order + TYPES[fields.datatype])
    encoding = "gzip" if compressed else "raw"
    cells = volume_header.VoxelLayout(dtype, encoding, offset=int(offset), slope=slope, intercept=intercept)
    return volume_header.VolumeHeader(shape, T_ct_index, {}, cells, path)


def _parse(data: bytes, path: Path) -> _Fields:
    if len(data) < HEADER_BYTES:
        refuse(f"the file ends inside the header ({len(data)} bytes)", path, PLAIN, "file_cut")
    order = {348: "<", 1543569408: ">"}.get(struct.unpack_from("<i", data, 0)[0])
    if order is None or data[344:348] != b"n+1\0":
        refuse("not a NIfTI-1 header (header size and magic 'n+1')", path, PLAIN, "wrong_format")
    v = struct.unpack(order + LAYOUT, data)
    geometry = v[22], v[23], v[24:27], v[27:30], v[30:]
    return _Fields(order, v[:8], v[8], v[9], v[10:18], v[18], v[19:21], v[21] & 7, *geometry)


def _affine(fields: _Fields, shape: tuple[int, int, int], path: Path) -> NDArray[np.float64]:
    """Voxel index to LPS mm, from the sform where it is given, else from the qform. Not checked yet."""
    if fields.units not in MM_PER_UNIT:
        allowed = "0 unknown (taken as mm), 1 metre, 2 mm, 3 micrometre"
        refuse(f"unit code {fields.units} in xyzt_units", path, allowed, "unknown_unit")
    scale = MM_PER_UNIT[fields.units]
    if not (np.isfinite(fields.pixdim[1:4]).all() and min(fields.pixdim[1:4]) > 0):
        refuse(f"pixdim {fields.pixdim[1:4]}", path, "positive voxel sizes", "not_positive")
    if fields.sform_code <= 0 and fields.qform_code <= 0:
        what = "neither sform nor qform is set (both codes 0): the file does not state its space"
        refuse(what, path, "sform_code or qform_code > 0", "space_not_stated")

    def to_lps_mm(T_ras_index: NDArray[np.float64]) -> NDArray[np.float64]:
        return T_ras_index * LPS_FROM_RAS * [[scale], [scale], [scale], [1.0]]

    candidates = []
    if fields.sform_code > 0:
        candidates.append(to_lps_mm(np.vstack([np.reshape(fields.srow, (3, 4)), [0.0, 0.0, 0.0, 1.0]])))
        pixdim_mm = np.array(fields.pixdim[1:4]) * scale
        with np.errstate(over="ignore", invalid="ignore"):  # a hostile affine is refused by name just after
            spacing = np.linalg.norm(candidates[0][:3, :3], axis=0)
        plausible = np.isfinite(spacing).all() and spacing.min() > 0
        if plausible and np.abs(spacing / pixdim_mm - 1).max() > PIXDIM_TOLERANCE:
            what = f"pixdim states voxels of {pixdim_mm.round(4)} mm, the sform {spacing.round(4)} mm"
            refuse(what, path, f"both agree within {PIXDIM_TOLERANCE:.1%}", "geometry_contradicted")
    if fields.qform_code > 0:
        b, c, d = fields.quaternion
        square = b * b + c * c + d * d
        if not square <= 1 + 1e-6:  # float32 rounding of a unit quaternion; NaN lands here too
            refuse(f"quaternion {(b, c, d)} of the qform", path, "b^2 + c^2 + d^2 <= 1", "not_unit")
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
        candidates.append(to_lps_mm(T))
    checked = [volume_header.check_affine(T, where=path) for T in candidates]
    apart = volume_header.corner_deviation_mm(checked[0], checked[-1], shape)
    if apart > QFORM_TOLERANCE_MM:
        what = f"sform and qform place a corner of the volume {apart:.3g} mm apart"
        refuse(what, path, f"both agree within {QFORM_TOLERANCE_MM} mm, or one is unset", "geometry_contradicted")
    return checked[0]
