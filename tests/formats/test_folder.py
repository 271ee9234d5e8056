"""Every entry of a folder is read, known to be harmless, or named: what is passed over in silence is an organ lost."""

import os
import shutil
from pathlib import Path

import dicom_world as world
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from refusals import refused

from puncture_twin.planning.base.cache.array_cache import NO_CACHE
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.recognise import choose_series
from puncture_twin.planning.formats.folder import entries, unaccounted
from puncture_twin.planning.formats.labels.label_sources import MASK_ENDINGS, mask_files
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.init.finder import Wanted, find
from puncture_twin.planning.init.segmentation import Place

HARMLESS = (
    *("statistics.json", "preview_total.png", ".DS_Store", "._liver.nii.gz", "README.md", "liver.nii.gz.dvc"),
    *("liver.json", "markers.csv", "case.toml", ".gitattributes", "report.html", "view.PNG", "scene.mrml"),
    *("predict_from_raw_data_args.json", "postprocessing.pkl", "liver.npz", "colon.pkl", "liver.nii.gz.txt"),
    *(".nfs0000a1", ".~lock.notes.odt#", "SHA256SUMS"),
)
LOST = (
    *("vessel.npz", "vessel.nii.gz.part", "vessel.nii.zst", "vessel.mha", "vessel.stl", "vessel.dcm", "vessel"),
    *("vessel.nii.bz2", "vessel.nrrd.crdownload", ".vessel.nii.gz", "vessel.nii.gz.dvc", "vessel.json"),
    *("._vessel.nii.gz", "vessel.nii.gz~", ".liver.nii.gz.Xy12Za", "vessel.h5", "vessel.mat"),
    *("vessel.nii.gz.txt", "liver_vessels.nii.gz.txt", "vessel.nrrd.log", "vessel.stl.csv", "readme.mha", "vessel.pkl"),
    *("liver.nii.gz.npz", "vessel.NII.GZ.md5", "vessel.dcm.png", "vessel.nii_old.txt"),
)
"""What programs leave behind, and formats that nobody reads here."""


def nothing_else(path: Path) -> bool:
    return False


def masks(folder: Path) -> Path:
    folder.mkdir()
    for name in ("liver.nii.gz", "colon.nrrd"):
        (folder / name).write_bytes(b"x")
    return folder


def test_what_is_not_read_among_masks_is_refused_by_name(tmp_path: Path) -> None:
    """A pointer to a mask that was not fetched and its description vouch for nothing, not even for each other."""
    folder = masks(tmp_path / "seg")
    for names in (*((name,) for name in LOST), ("vessel.nii.gz.dvc", "vessel.nii.gz.json")):
        for name in names:
            (folder / name).write_bytes(b"x")
        with refused("entries_not_read", *names):
            mask_files(folder, nothing_else, where="case")
        for name in names:
            (folder / name).unlink()


def test_what_holds_no_organ_may_lie_beside_masks(tmp_path: Path) -> None:
    """Statistics, previews, what file managers and version control leave, and files about a file beside them."""
    folder = masks(tmp_path / "seg")
    for name in HARMLESS:
        (folder / name).write_bytes(b"x")
    assert mask_files(folder, nothing_else, where="case") == ("colon.nrrd", "liver.nii.gz")


@pytest.mark.parametrize("seed", range(20))
def test_no_entry_of_any_kind_is_lost(tmp_path: Path, seed: int) -> None:
    """Of files, links to nothing, links in a circle, pipes, empty folders each is a mask, harmless, or refused."""
    rng = np.random.default_rng(seed)
    folder = masks(tmp_path / "seg")
    endings = (*MASK_ENDINGS, ".part", ".npz", ".txt", "", ".json", ".nii.gz.tmp")
    for number in range(rng.integers(1, 6)):
        name = f"organ{number}{endings[rng.integers(len(endings))]}"
        kind = rng.integers(5)
        if kind == 0:
            (folder / name).write_bytes(b"x")
        elif kind == 1:
            (folder / name).symlink_to("not_fetched")
        elif kind == 2:
            (folder / name).symlink_to(name)
        elif kind == 3:
            os.mkfifo(folder / name)
        else:
            (folder / name).mkdir()
    sound = [one.name for one in folder.iterdir() if one.is_file() and one.name.endswith(MASK_ENDINGS)]
    text = [one.name for one in folder.iterdir() if one.is_file() and one.name.endswith(".txt")]
    volume_like = (".nii", ".nrrd", ".npz")
    empty = [one.name for one in folder.iterdir() if one.is_dir() and not any(end in one.name for end in volume_like)]
    rest = {one.name for one in folder.iterdir()} - {*sound, *text, *empty}
    try:
        assert set(mask_files(folder, nothing_else, where="case")) == set(sound) and not rest
    except InputError as error:
        assert error.code == "entries_not_read" and all(name in str(error) for name in rest), (rest, error)
        assert rest and not any(f" {name} (" in str(error) for name in (*sound, *text, *empty))


def test_a_folder_in_a_folder_is_known_by_what_is_in_it(tmp_path: Path) -> None:
    """One with what is known, of previews, of this program's outputs or with nothing in it is no loss."""
    folder = masks(tmp_path / "seg")
    (folder / "@eaDir" / "liver.nii.gz").mkdir(parents=True)
    (folder / ".ipynb_checkpoints").mkdir()
    (folder / "notes").mkdir()
    assert len(mask_files(folder, nothing_else, where="case")) == 2
    (folder / "vessel.nii.gz").mkdir()  # unpacked, or not fetched
    with refused("entries_not_read", "vessel.nii.gz"):
        mask_files(folder, nothing_else, where="case")
    (folder / "vessel.nii.gz").rmdir()
    (folder / "notes" / "a.txt").write_text("x")
    (folder / "out").mkdir()
    (folder / "out" / "manifest.json").write_text('{"format": "puncture-twin output set"}')
    (folder / "out" / "map.nii.gz").write_text("x")
    assert len(mask_files(folder, nothing_else, where="case")) == 2
    (folder / "notes" / "b").symlink_to("..")  # a folder that holds itself ends somewhere
    with refused("entries_not_read"):
        mask_files(folder, nothing_else, where="case")


def test_a_folder_that_cannot_be_listed_is_refused(tmp_path: Path) -> None:
    with refused("folder_not_listed"):
        entries(tmp_path / "none", most=10)
    masks(tmp_path / "seg")
    with refused("folder_too_large"):
        entries(tmp_path / "seg", most=1)
    assert [one.name for one in unaccounted(tmp_path, entries(tmp_path, most=9), nothing_else)] == ["seg"]


def test_a_slice_that_cannot_be_read_is_no_end_of_the_scan(tmp_path: Path) -> None:
    """A link to nothing beside the slices, a pointer in place of one, half a download: the scan would be shorter."""
    folder = world.write_series(tmp_path / "s", world.series(), [f"{n}.dcm" for n in range(4)])
    for beside in ("3.dcm.txt", "3.dcm.md5", "._3.dcm"):
        (folder / beside).write_text("about a slice that is there")
    assert choose_series(folder).notes == ()
    for name in ("4.dcm", "4.dcm.part", "4", ".4.dcm", "4.dcm.txt"):
        if name == "4":
            (folder / name).symlink_to("not_fetched/4")
        else:
            (folder / name).write_text("version https://git-lfs.github.com/spec/v1\n")
        with refused("slices_not_read", name):
            choose_series(folder)
        (folder / name).unlink()


def test_slices_in_a_folder_beside_the_series_are_told(tmp_path: Path) -> None:
    """They are not entered, and may be its other half; other files and folders are none of the scan's."""
    folder = world.write_series(tmp_path / "s", world.series(), [f"{n}.dcm" for n in range(4)])
    for name in ("labels.nii.gz", "VERSION", "notes.txt"):
        (folder / name).write_text("x")
    (folder / "seg").mkdir()
    assert choose_series(folder).notes == ()
    world.write_series(folder / "part 2", world.series())
    assert "DICOM in part 2" in choose_series(folder).notes[0]


def volume(path: Path, values: np.ndarray) -> None:
    sitk.WriteImage(sitk.GetImageFromArray(values), str(path))


def patient(folder: Path) -> Path:
    (folder / "seg").mkdir(parents=True)
    noise = np.random.default_rng(1).normal(0.0, 10.0, (12, 12, 12))
    ct = np.full((12, 12, 12), -1000.0) + noise
    ct[3:9, 3:9, 3:9] += 1040
    volume(folder / "ct.nii.gz", ct.astype(np.int16))
    for k, name in enumerate(("liver", "colon")):
        mask = np.zeros((12, 12, 12), np.uint8)
        mask[4 + 2 * k, 4:6, 4:6] = 1
        volume(folder / "seg" / f"{name}.nii.gz", mask)
    return folder


def found(folder: Path, **wanted: str):
    return find(Place(folder, NO_CACHE), Wanted(Space.LPS, **wanted))


def test_init_refuses_what_it_does_not_read_among_masks_and_lists_it_elsewhere(tmp_path: Path) -> None:
    """In the folder that the case will name, and above it where the name is that of a volume or mesh."""
    folder = patient(tmp_path)
    (folder / "letter.docx").write_bytes(b"x")
    (folder / "statistics.json").write_text("{}")
    seen = found(folder)
    assert not seen.problems and len(seen.segmentations) == 1
    assert seen.passed == [("letter.docx", "of an unsupported kind")]
    (folder / "seg" / "letter.docx").write_bytes(b"x")
    (folder / "vessel.nii.gz").symlink_to("annex")
    problems = {error.where: error for error in found(folder).problems}
    assert {error.code for error in problems.values()} == {"entries_not_read"}
    assert "letter.docx" in str(problems[str(folder / "seg")])
    assert "vessel.nii.gz (is a link to a missing file)" in str(problems[str(folder)])
    (folder / "seg" / "letter.docx").unlink()
    assert not found(folder, segmentation="seg").problems, "the user said which"


@pytest.mark.parametrize("name", ["vessel.nii.gz", "d/e/f/g/h/vessel.stl", "d/vessel.nrrd.txt", "d/link"])
def test_an_organ_in_a_folder_that_is_too_deep_is_no_organ_left_out(tmp_path: Path, name: str) -> None:
    """At any depth; previews and versions hold none, and the user may say which folder is meant."""
    folder = patient(tmp_path / "p")
    path = folder / "a" / "b" / "c" / name
    (path.parent).mkdir(parents=True)
    (folder / "a" / "b" / "c" / ".git" / "annex.nii.gz").mkdir(parents=True)
    (folder / "a" / "b" / "c" / "x.dat").write_text("x")
    seen = found(folder)
    assert not seen.problems and ("a/b/c", "is a folder") in seen.passed
    if name == "d/link":
        path.symlink_to(folder / "seg")
    else:
        path.write_text("x")
    (error,) = found(folder).problems
    assert error.code == "entries_not_read" and error.where == str(folder / "a" / "b")
    assert (name if name != "d/link" else "d/link/colon.nii.gz") in str(error)
    assert not found(folder, segmentation="seg").problems


def test_probabilities_lie_beside_labels_and_not_beside_a_ct(tmp_path: Path) -> None:
    """As nnU-Net writes them; what is called like the CT may be its labels."""
    folder = patient(tmp_path)
    (folder / "seg" / "liver.npz").write_text("x")
    assert not found(folder).problems
    (folder / "ct.npz").write_text("x")
    (error,) = found(folder).problems
    assert error.code == "entries_not_read" and "ct.npz" in str(error)


def test_two_masks_of_one_name_are_both_named(tmp_path: Path) -> None:
    folder = patient(tmp_path)
    volume(folder / "seg" / "liver.nii", np.eye(12, dtype=np.uint8)[None].repeat(12, axis=0))
    (error,) = found(folder).problems
    assert error.code == "masks_of_one_name" and "'seg/liver.nii'" in str(error) and "'seg/liver.nii.gz'" in str(error)


def one_label(folder: Path, *names: str) -> Path:
    patient(folder)
    for name in names:
        shutil.copy(folder / "seg" / "liver.nii.gz", folder / name)
    shutil.rmtree(folder / "seg")
    return folder


TABLES = {"labels.csv": "id,name\n1,aorta\n2,vessels\n", "own.csv": "id,name\n1,aorta\n2,colon\n"}


def test_a_map_of_one_label_is_named_by_its_table(tmp_path: Path) -> None:
    """A liver was called "labels" and unknown. A table of several masks, or one that names the file, names no file."""
    for number, (maps, table, names) in enumerate(
        (
            (["labels.nii.gz"], "labels.csv", {"aorta"}),
            (["map.nii.gz"], "own.csv", {"aorta"}),
            (["map.nii.gz"], "", {"map"}),
            (["vessels.nii.gz"], "labels.csv", {"vessels"}),
            (["labels.nii.gz", "vein.nii.gz"], "labels.csv", {"aorta", "vein"}),
            (["map.nii.gz", "vein.nii.gz"], "own.csv", {"map", "vein"}),
        )
    ):
        folder = one_label(tmp_path / str(number), *maps)
        if table:
            (folder / table).write_text(TABLES[table])
        seen = found(folder)
        assert not seen.problems
        assert {name for one in seen.segmentations for name in one.names.values()} == names


def test_a_file_named_like_another_organ_than_its_table_says_is_refused(tmp_path: Path) -> None:
    """An aorta must not become a liver because a table of another map lies beside it."""
    folder = one_label(tmp_path, "aorta.nii.gz")
    (folder / "organs.csv").write_text("id,name\n1,liver\n")
    (error,) = found(folder).problems
    assert error.code == "label_named_twice" and "organs.csv" in str(error)
    (one,) = found(folder, naming="organs.csv").segmentations
    assert list(one.names.values()) == ["liver"]


def test_among_meshes_alone_nothing_else_lies(tmp_path: Path) -> None:
    """A mesh in another format, or one that was not fetched; a material is none."""
    for name in ("liver.obj", "colon.obj"):
        (tmp_path / name).write_text("v 0 0 0\nv 900 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (tmp_path / "liver.mtl").write_text("x")
    assert not found(tmp_path).problems
    (tmp_path / "vessel.step").write_text("x")
    (tmp_path / "vein.obj").symlink_to("annex")
    (tmp_path / "artery.obj").mkdir()
    (error,) = found(tmp_path).problems
    assert error.code == "entries_not_read"
    for name in ("vessel.step", "vein.obj", "artery.obj"):
        assert name in str(error)
