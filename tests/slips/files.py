"""Entries of folders that vanish, slices that lack, values that are none, and caches that others may write."""

import os
import tempfile
from functools import cache, partial
from pathlib import Path

import dicom_world
import numpy as np
import pydicom
import trimesh
from case_world import case_text, structure

from puncture_twin.planning.base.cache import entry_file
from puncture_twin.planning.base.cache.array_cache import NO_CACHE
from puncture_twin.planning.base.progress import unnamed
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.dicom.ct_series import read_series
from puncture_twin.planning.geometry.spaces import Space, Unit
from puncture_twin.planning.init.finder import Wanted, find
from puncture_twin.planning.init.segmentation import Place
from puncture_twin.planning.init.start import Request, start_case
from puncture_twin.twin.plant.scanner.writers import write_nifti
from slips.kinds import RIGHT, SILENT, WARNED, Answer, Kind, answer

ORGANS = ("liver", "colon", "portal_vein", "kidney_left", "aorta")
HARMLESS = ("statistics.json", ".DS_Store", "preview_total.png", "README.md", "notes.txt", "liver.json", "SHA256SUMS")
OTHER_ENDINGS = (".npz", ".nii.zst", ".nii.gz.part", ".mha", ".mgz", ".nii.bz2", ".stl", ".nii.gz~", ".h5", "", ".dcm")
OTHER_MESHES = (".3mf", ".wrl", ".step", ".stl.part", ".stl.gz", ".vtu", ".off", ".x3d", ".dae", "")


def _renamed(endings, rng, path):
    stem = path.name.partition(".")[0]
    path.rename(path.with_name(stem + str(rng.choice(endings))))


def _dangling(rng, path):
    path.unlink()
    path.symlink_to(f"../.git/annex/objects/{rng.integers(1 << 30):x}")


def _link_to_itself(rng, path):
    path.unlink()
    path.symlink_to(path.name)


def _folder_of_its_name(rng, path):
    content = path.read_bytes()
    path.unlink()
    path.mkdir()
    if rng.random() < 0.5:
        (path / path.name).write_bytes(content)


def _moved_into_a_folder(rng, path):
    below = path.parent / str(rng.choice(["more", "vessels", "old", "v2"]))
    below.mkdir()
    path.rename(below / path.name)


def _pipe(rng, path):
    path.unlink()
    os.mkfifo(path)


def _lacks(rng, path):
    path.unlink()


def _hidden(rng, path):
    path.rename(path.with_name(f".{path.name}"))


def _closed(rng, path):
    path.chmod(0)


CASE = case_text(
    structure("skin", "skin"),
    '[[structures]]\nmasks = "masks"\ntarget = ["liver"]\navoid = { "*" = 2.0 }\n',
    target='position_mm = [0.0, 0.0, 0.0]\nstructure = "liver"',
    listed=5,
)


def _masks(slip_of, rng, folder, slip):
    """One of five masks vanishes in a way that leaves an entry, or nothing does."""
    (folder / "masks").mkdir()
    voxels = np.zeros((6, 6, 6), np.uint8)
    voxels[2:4, 2:4, 2:4] = 1
    for name in ORGANS:
        write_nifti(folder / "masks" / f"{name}.nii.gz", voxels, np.eye(4))
    trimesh.creation.box((60, 60, 60)).export(folder / "skin.stl")
    (folder / "case.toml").write_text(CASE)
    for name in rng.choice(HARMLESS, 2, replace=False):
        (folder / "masks" / name).write_bytes(b"{}")
    if slip:
        slip_of(rng, folder / "masks" / f"{rng.choice(ORGANS[1:])}.nii.gz")

    def call():
        case = load_case(folder)
        read = {Path(one.path).name for one in case.inputs if one.role.startswith("mask ")}
        return None if len(read) == len(ORGANS) else Answer(SILENT)

    return answer(call)


def _meshes(slip_of, rng, folder, slip):
    """One of five meshes vanishes so in a folder that `init` looks through."""
    for number, name in enumerate(ORGANS):
        mesh = trimesh.creation.icosphere(subdivisions=1, radius=12)
        mesh.apply_translation((30.0 * number - 60, 5, 0))
        mesh.export(folder / f"{name}.stl")
    trimesh.creation.box((220, 160, 200)).export(folder / "skin.stl")
    (folder / str(rng.choice(HARMLESS))).write_bytes(b"{}")
    if slip:
        slip_of(rng, folder / f"{rng.choice(ORGANS[1:])}.stl")

    def call():
        found = find(Place(folder, NO_CACHE, unnamed), Wanted(Space.LPS, unit=Unit.MM))
        if found.problems:
            raise found.problems[0]
        names = {name for one in found.segmentations for name in one.names.values()}
        return None if set(ORGANS) <= names else Answer(SILENT)

    return answer(call)


def _slice_cut(rng, path):
    path.write_bytes(path.read_bytes()[: int(rng.integers(200, path.stat().st_size - 2))])


def _slice_moved(rng, path):
    data = pydicom.dcmread(path)
    data.ImagePositionPatient[2] += 2.5 * rng.choice([-2, -1, -0.5, 0.5, 1, 2])
    dicom_world.write(data, path)


def _slices(slip_of, rng, folder, slip):
    """A series of ten slices in any order, of which one inside is not as it was."""
    values = dicom_world.phantom((7, 5, 10))
    names = [f"IM{number:04d}.dcm" for number in rng.permutation(10)]
    dicom_world.write_series(folder / "ct", dicom_world.series(values, dicom_world.affine()), names)
    if slip:
        slip_of(rng, folder / "ct" / names[int(rng.integers(1, 9))])

    def call():
        read = read_series(folder / "ct")
        same = read.values.shape == values.shape and np.array_equal(read.values, values - 1024)
        return None if same else Answer(SILENT)

    return answer(call)


@cache
def _ball_and_organs():
    """A body of 70 mm with three balls in it, HU and labels, voxels of 4 mm."""
    at = np.arange(40) * 4.0 - 78.0
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    hu = np.where(x**2 + y**2 + z**2 < 70.0**2, 40.0, -1000.0) + np.random.default_rng(5).normal(0, 12, x.shape)
    labels = np.zeros(x.shape, np.uint8)
    for number, (a, b, c) in enumerate(((0, 0, 0), (36, 10, 0), (0, -40, 20)), start=1):
        labels[(x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < 12.0**2] = number
    return hu, labels


def _offset(rng, hu, labels):
    return np.clip(hu + rng.choice([1000, 1024]), 0, None), labels


def _windowed(rng, hu, labels):
    low, high = rng.choice([(-160, 240), (-1000, 400), (-200, 300)])
    return np.clip((hu - low) / (high - low) * 255, 0, 255), labels


def _nearly_whole(rng, hu, labels):
    return hu, labels.astype(np.float32) * np.float32(1 + rng.choice([-1, 1]) * 10 ** rng.uniform(-6, -2.4))


def _blended(rng, hu, labels):
    part = np.float32(rng.uniform(0.2, 0.8))
    mixed = labels.astype(np.float32)
    return hu, part * mixed + (1 - part) * np.roll(mixed, 1, axis=int(rng.integers(3)))


def _in_hundreds(rng, hu, labels):
    return hu, labels.astype(np.float32) / np.float32(rng.choice([10, 100, 255]))


def _values(slip_of, rng, folder, slip):
    """A CT with a label map, of which one has other values; `init` must write the same case, or refuse."""
    hu, labels = _ball_and_organs()
    T = np.diag([4.0, 4.0, 4.0, 1.0])
    T[:3, 3] = -78.0 + rng.uniform(-1, 1, 3)
    (folder / "labels.csv").write_text("id,name\n1,liver\n2,aorta\n3,colon\n")
    other, mixed = slip_of(rng, hu, labels) if slip else (hu, labels)
    write_nifti(folder / "ct.nii.gz", other.astype(np.int16), T)
    write_nifti(folder / "labels.nii.gz", mixed, T)

    def call():
        start = start_case(Request(folder, None, "liver", "abdomen", Wanted(Space.LPS)), NO_CACHE, unnamed)
        rounded = [one for one in start.notes if "whole" in one]
        if rounded:
            return Answer(WARNED, "labels_rounded")
        fits = np.abs(start.parts.target_ct - (T[:3, 3] + 78.0)).max() < 4.0
        return Answer(RIGHT if not slip or (fits and len(start.parts.rows) == 3) else SILENT)

    return answer(call)


def _open_file(rng, file, mode):
    file.chmod(mode | int(rng.choice([0o002, 0o006])))


def _open_folder(rng, file, mode):
    file.parent.chmod(0o757 if rng.random() < 0.5 else 0o777)


def _given_away(rng, file, mode):
    os.chown(file if rng.random() < 0.5 else file.parent, int(rng.integers(20_000, 60_000)), -1)


def _cache(slip_of, rng, _, slip):
    """An entry of a cache that another user owns, or others may write, in a place to which they can come."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        folder = Path(name) / "cache"
        folder.mkdir(mode=0o755)
        file, mode = folder / "entry", int(rng.choice([0o644, 0o600, 0o444]))
        file.write_bytes(b"content")
        file.chmod(mode)
        if slip:
            slip_of(rng, file, mode)
        entry_file._known_in_reach.cache_clear()
        try:
            return answer(lambda: entry_file.check_own(file) or Answer(SILENT if slip else RIGHT))
        finally:
            entry_file._known_in_reach.cache_clear()


ROOT = hasattr(os, "geteuid") and os.geteuid() == 0
VANISH = (
    ("renamed", partial(_renamed, OTHER_ENDINGS), partial(_renamed, OTHER_MESHES), 32),
    ("a link to nothing", _dangling, _dangling, 20),
    ("a link to itself", _link_to_itself, _link_to_itself, 4),
    ("a folder", _folder_of_its_name, _folder_of_its_name, 12),
    ("in a folder below", _moved_into_a_folder, _moved_into_a_folder, 12),
    ("a pipe", _pipe, _pipe, 4),
    ("hidden", _hidden, _hidden, 4),
    *(() if ROOT else (("closed", _closed, _closed, 6),)),
)
KINDS = (
    *(Kind(f"a mask is {name}", share, partial(_masks, of)) for name, of, _, share in VANISH),
    *(Kind(f"a mesh is {name}", share // 2, partial(_meshes, of)) for name, _, of, share in VANISH),
    Kind("a slice lacks", 16, partial(_slices, _lacks)),
    Kind("a slice is cut", 16, partial(_slices, _slice_cut)),
    Kind("a slice is a link to nothing", 10, partial(_slices, _dangling)),
    Kind("a slice lies at another's place", 10, partial(_slices, _slice_moved)),
    Kind("HU with an offset", 16, partial(_values, _offset)),
    Kind("HU through a window", 16, partial(_values, _windowed)),
    Kind("labels nearly whole", 16, partial(_values, _nearly_whole)),
    Kind("labels blended", 16, partial(_values, _blended)),
    Kind("labels as fractions", 10, partial(_values, _in_hundreds)),
    Kind("a cache's file open to others", 13, partial(_cache, _open_file)),
    Kind("a cache's folder open to others", 10, partial(_cache, _open_folder)),
    *((Kind("a cache of another user", 10, partial(_cache, _given_away)),) if ROOT else ()),
)
