"""Volumes: where voxels lie in LPS, and that no damaged or hostile file gets through."""

import gzip
import itertools
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813 - the name that its whole documentation uses
from refusals import refused

from puncture_twin.planning.anatomy.scan import nearest
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.volumes.nifti_header import TYPES
from puncture_twin.planning.formats.volumes.nrrd_header import TYPES as NRRD_TYPES
from puncture_twin.planning.formats.volumes.volume_files import VolumeFile, data_file, read_volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, refuse_lost_grid

SHAPE = (4, 5, 6)
VALUES = np.arange(120, dtype="<i2").reshape(SHAPE)
SFORM = np.array([[2.0, 0, 0, 10], [0, 3.0, 0, 20], [0, 0, 4.0, 30]])
NRRD_LINES = (
    "NRRD0004",
    "type: short",
    "dimension: 3",
    "space: left-posterior-superior",
    "sizes: 4 5 6",
    "space directions: (2,0,0) (0,3,0) (0,0,4)",
    "kinds: domain domain domain",
    "endian: little",
    "encoding: raw",
    "space origin: (-10,-20,30)",
)


def nifti_bytes(
    *,
    dim: tuple[int, ...] = (3, *SHAPE, 1, 1, 1, 1),
    datatype: tuple[int, int] = (4, 16),
    pixdim: tuple[float, ...] = (1, 2, 3, 4, 0, 0, 0, 0),
    sform: Any = SFORM,
    codes: tuple[int, int] = (0, 1),
    quaternion: tuple[float, ...] = (0, 0, 0),
    qoffset: tuple[float, ...] = (10, 20, 30),
    units: int = 2,
    vox_offset: float = 352.0,
    slope: float = 0.0,
    magic: bytes = b"n+1\0",
    order: str = "<",
    data: bytes | None = None,
) -> bytes:
    head = bytearray(352)
    struct.pack_into(order + "i", head, 0, 348)
    struct.pack_into(order + "8h", head, 40, *dim)
    struct.pack_into(order + "2h", head, 70, *datatype)
    struct.pack_into(order + "8f", head, 76, *pixdim)
    struct.pack_into(order + "2f", head, 108, vox_offset, slope)
    head[123] = units
    struct.pack_into(order + "2h", head, 252, *codes)
    struct.pack_into(order + "6f", head, 256, *quaternion, *qoffset)
    struct.pack_into(order + "12f", head, 280, *np.ravel(sform))
    head[344:348] = magic
    return bytes(head) + (VALUES.astype(order + "i2").tobytes(order="F") if data is None else data)


def nrrd_bytes(*changes: tuple[str, str | None], data: bytes | None = None) -> bytes:
    lines = list(NRRD_LINES)
    for start, line in changes:
        found = next((i for i, old in enumerate(lines) if old.startswith(start)), len(lines))
        lines[found : found + 1] = [] if line is None else [line]
    return ("\n".join(lines) + "\n\n").encode() + (VALUES.tobytes(order="F") if data is None else data)


GZIP = ("encoding", "encoding: gzip")


def axes(first_two: str) -> tuple[str, str]:
    return "space directions", f"space directions: {first_two} (0,0,4)"


def all_of(value: float) -> bytes:
    return np.full(120, value, dtype="<f4").tobytes()


def write(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def place(T: np.ndarray, *index: float) -> list[float]:
    return list((T @ [*index, 1.0])[:3])


def test_nifti_qform_with_a_quarter_turn_and_a_flip(tmp_path: Path) -> None:
    """A quarter turn about z takes i to RAS +y and j to -x; qfac -1 takes k to -z."""
    half = 0.5**0.5
    content = nifti_bytes(codes=(1, 0), quaternion=(0, 0, half), pixdim=(-1, 2, 3, 4, 0, 0, 0, 0))
    volume = read_volume(write(tmp_path, "a.nii", content))
    assert np.allclose(place(volume.T_ct_index, 1, 1, 1), [-(10 - 3), -(20 + 2), 30 - 4], atol=1e-5)
    assert np.linalg.det(volume.T_ct_index) < 0


def test_units_of_a_nifti_become_mm(tmp_path: Path) -> None:
    """Metre and micrometre are converted, an unknown unit is taken as mm."""
    for units, scale in ((0, 1.0), (1, 0.001), (2, 1.0), (3, 1000.0)):
        pixdim = (1, 2 * scale, 3 * scale, 4 * scale, 0, 0, 0, 0)
        volume = read_volume(write(tmp_path, "a.nii", nifti_bytes(units=units, sform=SFORM * scale, pixdim=pixdim)))
        assert np.allclose(place(volume.T_ct_index, 1, 2, 3), [-12, -26, 42], atol=1e-4)


def test_both_affines_may_be_given_if_they_agree(tmp_path: Path) -> None:
    """sform and qform that say the same are accepted, whichever SimpleITK takes."""
    for codes in ((1, 1), (1, 2), (2, 1)):
        volume = read_volume(write(tmp_path, "a.nii", nifti_bytes(codes=codes)))
        assert place(volume.T_ct_index, 1, 2, 3) == [-12.0, -26.0, 42.0]


def test_nrrd_says_its_space(tmp_path: Path) -> None:
    """Voxel (1, 2, 3) of the same numbers in each of the patient spaces, in LPS."""
    for space, x, y in (
        ("left-posterior-superior", -8.0, -14.0),
        ("right-anterior-superior", 8.0, 14.0),
        ("left-anterior-superior", -8.0, 14.0),
    ):
        volume = read_volume(write(tmp_path, "a.nrrd", nrrd_bytes(("space:", f"space: {space}"))))
        assert place(volume.T_ct_index, 1, 2, 3) == [x, y, 42.0]
        assert np.array_equal(volume.values, VALUES)


def test_data_beside_a_header_as_teem_names_them(tmp_path: Path) -> None:
    """In this folder (``./``), and from the file's end (a skip of -1), which is all of it; one file for the case."""
    write(tmp_path, "a.raw", VALUES.tobytes(order="F"))
    stated = ("byte skip: -1", "data file: .//a.raw"), ("byte skip: 0", "data file: ././a.raw")
    for skip, name in stated:
        header = nrrd_bytes(("byte skip", skip), ("data file", name), data=b"")
        path = write(tmp_path, "a.nhdr", header)
        assert np.array_equal(read_volume(path).values, VALUES)
        assert data_file(header, path) == "a.raw"
    packed = ("encoding", "encoding: gzip"), gzip.compress(VALUES.tobytes(order="F"))
    for change, data in ((("encoding", "encoding: raw"), None), packed):
        attached = write(tmp_path, "b.nrrd", nrrd_bytes(("byte skip", "byteskip: -1"), change, data=data))
        assert np.array_equal(read_volume(attached).values, VALUES)


def test_files_that_simpleitk_writes_come_back(tmp_path: Path) -> None:
    """An oblique image written by SimpleITK in either format is where SimpleITK put it."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(VALUES.transpose(2, 1, 0)))
    angle = 0.3
    c, s = np.cos(angle), np.sin(angle)
    image.SetDirection([c, -s, 0, s, c, 0, 0, 0, -1])
    image.SetSpacing([0.7, 0.8, 2.5])
    image.SetOrigin([-101.5, 33.0, 812.25])
    for name in ("a.nii", "a.nii.gz", "a.nrrd", "a.nhdr"):
        sitk.WriteImage(image, str(tmp_path / name), useCompression=name != "a.nii")
        volume = read_volume(tmp_path / name)
        assert np.array_equal(volume.values, VALUES)
        assert not volume.values.flags.writeable and not volume.T_ct_index.flags.writeable
        for index in itertools.product((0, 3), (0, 4), (0, 5)):
            expected = image.TransformIndexToPhysicalPoint(index)
            assert np.allclose(place(volume.T_ct_index, *index), expected, atol=1e-3)


def with_simpleitk(path: Path) -> np.ndarray:
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NrrdImageIO" if "nrrd" in path.name or path.suffix == ".nhdr" else "NiftiImageIO")
    reader.SetFileName(str(path))
    return sitk.GetArrayFromImage(reader.Execute()).transpose(2, 1, 0)


def stored_values(dtype: np.dtype[Any]) -> np.ndarray:
    rng = np.random.default_rng(5)
    if dtype.kind == "f":
        return (1000.0 * rng.normal(size=120)).astype(dtype)
    ends = np.iinfo(dtype)
    values = rng.integers(ends.min, ends.max, 120, dtype=dtype.newbyteorder("="), endpoint=True)
    values[:2] = ends.min, ends.max
    return values.astype(dtype)


SCALINGS = (0, 0), (1, 0), (1, -1024), (2.5, -1024), (0.1, 0.3), (-1, 0), (1 + 1e-7, 0), (1, 1e-20)
"""Slope and intercept."""


@pytest.mark.parametrize("code", sorted(TYPES))
def test_nifti_values_are_simpleitks_bit_for_bit(tmp_path: Path, code: int) -> None:
    """Every type in both byte orders, with slope and intercept, plain and compressed: the same values and type."""
    for order, scaling in itertools.product("<>", SCALINGS):
        dtype = np.dtype(order + TYPES[code])
        data = stored_values(dtype).tobytes()
        content = bytearray(nifti_bytes(order=order, datatype=(code, 8 * dtype.itemsize), data=data))
        struct.pack_into(order + "2f", content, 112, *scaling)
        plain, packed = write(tmp_path, "a.nii", content), write(tmp_path, "a.nii.gz", gzip.compress(content))
        wanted = with_simpleitk(plain)
        for values in (read_volume(plain).values, read_volume(packed).values):
            assert values.dtype == wanted.dtype
            assert np.array_equal(values, wanted)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("name", {dtype: name for name, dtype in sorted(NRRD_TYPES.items())}.values())
def test_nrrd_values_are_simpleitks_bit_for_bit(tmp_path: Path, order: str, name: str) -> None:
    """Every type in both byte orders, raw and gzipped, attached and detached."""
    dtype = np.dtype({"little": "<", "big": ">"}[order] + NRRD_TYPES[name])
    values = stored_values(dtype)
    raw = values.tobytes()
    typed = (("type", f"type: {name}"), ("endian", f"endian: {order}"))
    write(tmp_path, "a b.raw", raw)
    write(tmp_path, "a.raw.gz", gzip.compress(raw))
    contents = {
        "raw.nrrd": nrrd_bytes(*typed, data=raw),
        "gzip.nrrd": nrrd_bytes(*typed, GZIP, data=gzip.compress(raw)),
        "gzip.nhdr": nrrd_bytes(*typed, GZIP, ("data file", "data file: a.raw.gz"), data=b""),
        "raw.nhdr": nrrd_bytes(*typed, ("data file", "data file: a b.raw"), data=b""),
    }
    for file, content in contents.items():
        path = write(tmp_path, file, content)
        found, wanted = read_volume(path).values, with_simpleitk(path)
        assert found.dtype == wanted.dtype, file
        assert np.array_equal(found, wanted), file


def test_members_and_padding_of_gzip_data(tmp_path: Path) -> None:
    """Gzip data may come in members, with zeros behind; anything else behind is damage."""
    cut = [gzip.compress(WHOLE[:100]), gzip.compress(WHOLE[100:351]), gzip.compress(b""), gzip.compress(WHOLE[351:])]
    for end in (b"", bytes(1000)):
        assert np.array_equal(read_volume(write(tmp_path, "a.nii.gz", b"".join(cut) + end)).values, VALUES)
    for end in (b"x", bytes(1000) + b"x", cut[0]):
        with pytest.raises(InputError):
            read_volume(write(tmp_path, "a.nii.gz", b"".join(cut) + end))


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
def test_a_point_has_the_value_of_the_nearest_voxel(order: tuple[int, ...]) -> None:
    """However the voxels lie in memory; half way between two voxels it is the even one, outside there is none."""
    values = np.ascontiguousarray(VALUES.transpose(order), dtype=np.float32).transpose(np.argsort(order))
    quarters = np.stack(np.meshgrid(*(np.arange(-4, 4 * n + 1) / 4 for n in SHAPE), indexing="ij"), axis=-1)
    at = quarters.reshape(-1, 3)
    found = nearest(values, np.linalg.inv(np.vstack([SFORM, [0, 0, 0, 1]])), at * [2.0, 3.0, 4.0] + [10.0, 20.0, 30.0])
    for index, value in zip(at.tolist(), found.tolist(), strict=True):
        voxel = tuple(round(v) for v in index)  # Python's rounds halves to even too
        inside = all(0 <= v < n for v, n in zip(voxel, SHAPE, strict=True))
        assert value == values[voxel] if inside else np.isnan(value)
    assert np.isnan(nearest(values, np.eye(4), np.array([[np.nan, 1.0, 1.0], [np.inf, 1.0, 1.0]]))).all()


NAN = float("nan")
WHOLE = nifti_bytes()
PACKED = gzip.compress(WHOLE)
BAD_NIFTI: dict[str, tuple[str, bytes, str]] = {
    "empty": ("a.nii", b"", "file_size"),
    "cut in the header": ("a.nii", WHOLE[:200], "file_cut"),
    "cut in the data": ("a.nii", WHOLE[:-1], "size_mismatch"),
    "too long": ("a.nii", WHOLE + b"\0", "size_mismatch"),
    "gz cut": ("a.nii.gz", PACKED[:-12], "file_damaged"),
    "gz with a wrong checksum": ("a.nii.gz", PACKED[:-8] + b"\1\2\3\4" + PACKED[-4:], "file_damaged"),
    "gz bomb": ("a.nii.gz", gzip.compress(WHOLE + bytes(50_000_000)), "size_mismatch"),
    "gz that is plain": ("a.nii.gz", WHOLE, "file_damaged"),
    "wrong magic": ("a.nii", nifti_bytes(magic=b"ni1\0"), "wrong_format"),
    "terabytes": ("a.nii", nifti_bytes(dim=(3, 32767, 32767, 32767, 1, 1, 1, 1), data=b""), "too_many"),
    "negative size": ("a.nii", nifti_bytes(dim=(3, -4, 5, 6, 1, 1, 1, 1)), "wrong_dimension"),
    "4D": ("a.nii", nifti_bytes(dim=(4, 4, 5, 3, 2, 1, 1, 1)), "wrong_dimension"),
    "colour": ("a.nii", nifti_bytes(datatype=(128, 24)), "unknown_type 128"),
    "bits contradict the type": ("a.nii", nifti_bytes(datatype=(4, 32)), "unknown_type"),
    "NaN affine": ("a.nii", nifti_bytes(sform=SFORM * NAN), "not_finite"),
    "sheared affine": ("a.nii", nifti_bytes(sform=[[2, 0.03, 0, 0], [0, 3, 0, 0], [0, 0, 4, 0]]), "sheared"),
    "far origin": ("a.nii", nifti_bytes(sform=np.add(SFORM, [0, 0, 0, 1e8])), "too_far"),
    "affines disagree": ("a.nii", nifti_bytes(codes=(1, 1), qoffset=(10, 20, 31)), "geometry_contradicted"),
    "no affine": ("a.nii", nifti_bytes(codes=(0, 0)), "space_not_stated"),
    "quaternion too long": ("a.nii", nifti_bytes(codes=(1, 0), quaternion=(1, 1, 0)), "not_unit"),
    "negative pixdim": ("a.nii", nifti_bytes(pixdim=(1, -2, 3, 4, 0, 0, 0, 0), codes=(1, 0)), "not_positive"),
    "pixdim against sform": ("a.nii", nifti_bytes(pixdim=(1, 2, 3, 5, 0, 0, 0, 0)), "geometry_contradicted"),
    "metres": (
        "a.nii",
        nifti_bytes(sform=SFORM / 1000, pixdim=(1, 2e-3, 3e-3, 4e-3, 0, 0, 0, 0)),
        "implausible_spacing",
    ),
    "unknown unit": ("a.nii", nifti_bytes(units=5), "unknown_unit"),
    "NaN quaternion": ("a.nii", nifti_bytes(codes=(1, 0), quaternion=(NAN, 0, 0)), "not_unit"),
    "NaN offset": ("a.nii", nifti_bytes(vox_offset=NAN), "out_of_range"),
    "offset inside the header": ("a.nii", nifti_bytes(vox_offset=0), "out_of_range"),
    "NaN slope": ("a.nii", nifti_bytes(slope=NAN), "not_finite"),
    "slope of zero": ("a.nii", WHOLE[:116] + struct.pack("<f", 7.0) + WHOLE[120:], "scaling_ambiguous"),
    "slope next to zero": ("a.nii", nifti_bytes(slope=1e-17), "scaling_ambiguous"),
    "infinite after scaling": ("a.nii", nifti_bytes(datatype=(16, 32), slope=1e30, data=all_of(1e30)), "not_finite"),
    "NaN voxel": ("a.nii", nifti_bytes(datatype=(16, 32), data=all_of(NAN)), "not_finite"),
}


def test_axes_of_length_one_behind_the_three_of_space_are_none(tmp_path: Path) -> None:
    """As programs for time series write a single volume; the voxels are those of three axes."""
    plain = read_volume(write(tmp_path, "a.nii", nifti_bytes()))
    nrrd = nrrd_bytes(
        ("dimension", "dimension: 4"),
        ("sizes", "sizes: 4 5 6 1"),
        ("space directions", "space directions: (2,0,0) (0,3,0) (0,0,4) none"),
        ("kinds", "kinds: domain domain domain list"),
    )
    files = {"b.nii": nifti_bytes(dim=(4, *SHAPE, 1, 1, 1, 1)), "c.nii": nifti_bytes(dim=(5, *SHAPE, 1, 1, 7, 7))}
    for name, content in {**files, "d.nrrd": nrrd}.items():
        other = read_volume(write(tmp_path, name, content))
        np.testing.assert_array_equal(other.values, plain.values)
        np.testing.assert_allclose(np.abs(other.T_ct_index), np.abs(plain.T_ct_index))


def test_labels_that_lost_their_grid_are_refused() -> None:
    """They have the image's voxels and begin at 0; a grid that begins at 0 where the image lies is its own."""
    path, scale = Path("labels.nii"), [2.0, 3.0, 4.0]
    start = np.diag([*scale, 1.0])
    shifted, turned, beside = start.copy(), np.diag([-2.0, -3.0, -4.0, 1.0]), start.copy()
    shifted[:3, 3] = 5.0
    turned[:3, 3] = 5.0 + (np.array(SHAPE) - 1) * scale  # the same image, stored from its other end
    beside[0, 3] = 0.5  # another place, and not lost
    for T in (shifted, turned):
        with refused("grid_lost"):
            refuse_lost_grid(VolumeGrid(SHAPE, start, {}), VolumeGrid(SHAPE, T, {}), where=path)
        refuse_lost_grid(VolumeGrid((4, 5, 7), start, {}), VolumeGrid(SHAPE, T, {}), where=path)
        refuse_lost_grid(VolumeGrid(SHAPE, beside, {}), VolumeGrid(SHAPE, T, {}), where=path)
    refuse_lost_grid(VolumeGrid(SHAPE, start, {}), VolumeGrid(SHAPE, start, {}), where=path)


FOUR_D = (("dimension", "dimension: 4"), ("sizes", "sizes: 2 4 5 3"))
UNNAMED = nrrd_bytes(("space:", "space dimension: 3"))
BAD_NRRD: dict[str, tuple[str, bytes, str]] = {
    "empty": ("a.nrrd", b"", "file_size"),
    "wrong magic": ("a.nrrd", nrrd_bytes().replace(b"NRRD0004", b"NRRD0009"), "wrong_format"),
    "not text": ("a.nrrd", nrrd_bytes(("kinds", "kinds: \u00e9")).replace(b"\xc3\xa9", b"\xff"), "not_text"),
    "header only": ("a.nrrd", "\n".join(NRRD_LINES).encode(), "file_cut"),
    "cut data": ("a.nrrd", nrrd_bytes(data=bytes(239)), "size_mismatch"),
    "too much data": ("a.nrrd", nrrd_bytes(data=bytes(241)), "size_mismatch"),
    "terabytes": ("a.nrrd", nrrd_bytes(("sizes", "sizes: 30000 30000 30000")), "too_many"),
    "gz cut": ("a.nrrd", nrrd_bytes(GZIP, data=gzip.compress(bytes(range(240)))[:-9]), "file_damaged"),
    "gz bomb": ("a.nrrd", nrrd_bytes(GZIP, data=gzip.compress(bytes(30_000_000))), "size_mismatch"),
    "points at another folder": ("a.nhdr", nrrd_bytes(("data", "data file: ../a.raw"), data=b""), "outside_folder"),
    "points out of here": ("a.nhdr", nrrd_bytes(("data", "data file: ./../a.raw"), data=b""), "outside_folder"),
    "points at here": ("a.nhdr", nrrd_bytes(("data", "data file: ./."), data=b""), "outside_folder"),
    "points at a list here": ("a.nhdr", nrrd_bytes(("data", "data file: ./LIST"), data=b""), "outside_folder"),
    "points nowhere": ("a.nhdr", nrrd_bytes(("data", "data file: b.raw"), data=b""), "no_such_file"),
    "a list of files": ("a.nhdr", nrrd_bytes(("data", "data file: LIST"), data=b"/etc/passwd\n"), "outside_folder"),
    "a pattern of files": ("a.nhdr", nrrd_bytes(("data", "data file: a%d.raw 1 6 1"), data=b""), "outside_folder"),
    "points at two files": ("a.nhdr", nrrd_bytes(("data", "data file: a.raw\tb"), data=b""), "outside_folder"),
    "points at itself": ("a.nhdr", nrrd_bytes(("data", "datafile: a.nhdr"), data=b""), "data_elsewhere"),
    "an attached file that points": ("a.nrrd", nrrd_bytes(("data", "Data File: /etc/passwd")), "outside_folder"),
    "layers of segments": ("a.seg.nrrd", nrrd_bytes(*FOUR_D), "wrong_dimension"),
    "two spaces": ("a.nrrd", nrrd_bytes(("x", "space dimension: 3")), "stated_twice"),
    "a plane": ("a.nrrd", nrrd_bytes(("space:", "space dimension: 2")), "wrong_dimension"),
    "no space": ("a.nrrd", nrrd_bytes(("space:", None)), "missing_key"),
    "scanner space": ("a.nrrd", nrrd_bytes(("space:", "space: scanner-xyz")), "unknown_space"),
    "no origin": ("a.nrrd", nrrd_bytes(("space origin", None)), "missing_key"),
    "NaN direction": ("a.nrrd", nrrd_bytes(axes("(nan,0,0) (0,3,0)")), "not_finite"),
    "no direction": ("a.nrrd", nrrd_bytes(axes("none (0,3,0)")), "not_a_number"),
    "sheared": ("a.nrrd", nrrd_bytes(axes("(2,0,0) (1,3,0)")), "sheared"),
    "in metres": ("a.nrrd", nrrd_bytes(("space units", 'space units: "m" "m" "m"')), "unknown_unit"),
    "unknown field": ("a.nrrd", nrrd_bytes(("surprise", "surprise: 1")), "unknown_line"),
    "field twice": ("a.nrrd", nrrd_bytes(("x", "Sizes: 4 5 6")), "duplicate_key"),
    "no byte order": ("a.nrrd", nrrd_bytes(("endian", None)), "missing_key"),
    "skips": ("a.nrrd", nrrd_bytes(("byte skip", "byte skip: 8"), data=bytes(248)), "unsupported_feature"),
    "skips lines": ("a.nrrd", nrrd_bytes(("line skip", "line skip: -1")), "unsupported_feature"),
    "skips to its end": ("a.nrrd", nrrd_bytes(("byte skip", "byte skip: -1"), data=bytes(241)), "size_mismatch"),
    "skips to its end, cut": ("a.nrrd", nrrd_bytes(("byte skip", "byte skip: -1"), data=bytes(239)), "size_mismatch"),
    "bzip2": ("a.nrrd", nrrd_bytes(("encoding", "encoding: bzip2")), "unsupported_feature"),
    "ascii": ("a.nrrd", nrrd_bytes(("encoding", "encoding: ascii"), data=b"1 " * 120), "unsupported_feature"),
    "several values per voxel": ("a.nrrd", nrrd_bytes(("kinds", "kinds: vector domain domain")), "unsupported_feature"),
    "two kinds": ("a.nrrd", nrrd_bytes(("kinds", "kinds: domain domain")), "unsupported_feature"),
    "placed twice": ("a.nrrd", nrrd_bytes(("x", "axis mins: 1 2 3")), "stated_twice"),
    "block type": ("a.nrrd", nrrd_bytes(("type", "type: block")), "unknown_type"),
}


@pytest.mark.parametrize("case", [*BAD_NIFTI.values(), *BAD_NRRD.values()], ids=[*BAD_NIFTI, *BAD_NRRD])
def test_damaged_and_hostile_files_are_refused_by_name(tmp_path: Path, case: tuple[str, bytes, str]) -> None:
    name, content, match = case
    with refused(*match.split(), name):
        read_volume(write(tmp_path, name, content))


def test_paths_that_are_no_volume_files(tmp_path: Path) -> None:
    (tmp_path / "folder.nii").mkdir()
    write(tmp_path, "a.img", WHOLE)
    for name, code in (("folder.nii", "no_such_file"), ("b.nii.gz", "no_such_file"), ("a.img", "unknown_format")):
        with refused(code):
            read_volume(tmp_path / name)


def test_a_link_beside_a_nrrd_may_not_lead_away(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.raw").symlink_to(write(tmp_path, "a.raw", VALUES.tobytes(order="F")))
    with refused("outside_folder"):
        read_volume(write(tmp_path / "in", "a.nhdr", nrrd_bytes(("data", "data file: a.raw"), data=b"")))


def test_axes_without_a_named_space_are_lps_as_to_itk_and_that_is_told(tmp_path: Path) -> None:
    """``space dimension: 3`` counts the axes of a space that it does not name."""
    path = write(tmp_path, "a.nrrd", UNNAMED)
    image = sitk.ReadImage(str(path))
    volume = read_volume(path)
    assert volume.T_ct_index[:3, 3] == pytest.approx(image.GetOrigin())
    assert volume.T_ct_index[:3] @ [1, 2, 3, 1] == pytest.approx(image.TransformIndexToPhysicalPoint((1, 2, 3)))
    source = VolumeFile(path, ("a.nrrd",), lambda name: (tmp_path / name).read_bytes())
    assert source.notes == ("a.nrrd: its header states no patient space; read as LPS, as in ITK and Slicer",)
