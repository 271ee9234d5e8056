"""Three starts of a new user: masks and a label map of a real CT, and meshes; `init`, then `search`, as typed."""

import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import changed
from places import REAL_CT, ROOT

from puncture_twin.meshes import folder as meshes_folder
from puncture_twin.planning.formats.labels.naming import V1
from puncture_twin.run_twin import main

needs_ct = pytest.mark.skipif(not REAL_CT.is_dir(), reason=f"the real CT is not at {REAL_CT}")
LIVER = ["--target", "85,200,372", "--space", "RAS"]
COARSE = ("step_deg = 2.0", "step_deg = 6.0")
COLUMNS = ["verdict", "reason", "reason_structure", "min_clearance_mm", "path_length_mm"]


def searched(folder, out):
    """The table of a search of the folder's case, on a grid of 6 degrees."""
    case = folder / "case.toml"
    case.write_text(changed(case.read_text(), COARSE))
    assert main(["search", str(folder), "--no-pictures", "--out", str(out)]) in (0, 1)
    return pq.read_table(out / "candidates.parquet")


def same_verdicts(table, other):
    return all(table.column(name).equals(other.column(name)) for name in COLUMNS)


def hand_written(source, masks, count):
    """The case of the real CT, with its rules for a label map or the masks of it."""
    text = (ROOT / "tests" / "real" / source).read_text()
    head, rest = text.split("[registration]")
    del rest  # no arm, as `init` leaves it
    naming = head[head.index("labelmap =") : head.index("target = [")]
    source = f'masks = "{masks}"\n' if masks else naming
    text = changed(head, ("length_mm = 210.0", "length_mm = 200.0"), COARSE, (naming, source))
    return f"{text}[end]\nstructures = {count}\n"


def coarse(name, crop=np.s_[:, :, :]):
    """One of the real images, on voxels twice as large."""
    return sitk.ReadImage(str(REAL_CT / f"{name}.nii.gz"))[crop][::2, ::2, ::2]


def patient_of(tmp_path, name="patient"):
    folder = tmp_path / name
    folder.mkdir()
    sitk.WriteImage(coarse("ct"), str(folder / "ct.nii.gz"))
    return folder


def write_masks(folder):
    """TotalSegmentator's default output of version 1: a mask for each of its 104 classes; how many are empty."""
    folder.mkdir()
    image = coarse("labels_v1_normal")
    labels = sitk.GetArrayFromImage(image)
    for number, name in V1.items():
        mask = sitk.GetImageFromArray((labels == number).astype(np.uint8))
        mask.CopyInformation(image)
        sitk.WriteImage(mask, str(folder / f"{name}.nii.gz"))
    return len(V1.keys() - set(np.unique(labels).tolist()))


@needs_ct
def test_from_a_folder_of_masks(tmp_path, capfd):
    """One `init`, one `search`; candidates; the same verdicts as of the case that was written by hand."""
    folder = patient_of(tmp_path)
    empty = write_masks(folder / "segmentations")
    assert main(["init", str(folder), *LIVER]) == 0
    told = capfd.readouterr().err
    assert f"segmentations: {empty} empty masks" in told and 40 < empty < 60
    assert 'region = "abdomen" was inferred' in told
    table = searched(folder, tmp_path / "out")
    assert 0 < table.column("verdict").to_pylist().count("safe") < len(table)
    (folder / "case.toml").write_text(hand_written("case_v1.toml", "segmentations", 105 - empty).replace(*COARSE))
    assert main(["search", str(folder), "--no-pictures", "--out", str(tmp_path / "hand")]) == 0
    assert same_verdicts(table, pq.read_table(tmp_path / "hand" / "candidates.parquet"))


@needs_ct
def test_from_a_label_map(tmp_path, capfd):
    """Without a table of names: numbered by a version that is told by where organs lie."""
    folder = patient_of(tmp_path)
    sitk.WriteImage(coarse("labels_v2_fast"), str(folder / "labels_v2_fast.nii.gz"))
    assert main(["init", str(folder), *LIVER, "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["structures"] == {"target": 1, "traverse": 10, "avoid": 50}
    assert any("numbered as totalsegmentator-v2" in line for line in told["warnings"])
    table = searched(folder, tmp_path / "out")
    (folder / "case.toml").write_text(hand_written("case_v2.toml", "", 62).replace(*COARSE))
    assert main(["search", str(folder), "--no-pictures", "--out", str(tmp_path / "hand")]) == 0
    assert same_verdicts(table, pq.read_table(tmp_path / "hand" / "candidates.parquet"))


@needs_ct
def test_a_cropped_segmentation_is_searched_with_what_is_beyond_unknown(tmp_path):
    """The map of the liver's surroundings alone: nothing becomes safe that was not."""
    tables = []
    for name, crop in (("whole", np.s_[:, :, :]), ("cropped", np.s_[10:112, 6:96, 10:110])):
        folder = patient_of(tmp_path, name)
        sitk.WriteImage(coarse("labels_v2_fast", crop), str(folder / "map.nii.gz"))
        assert main(["init", str(folder), *LIVER, "--naming", "totalsegmentator-v2"]) == 0
        tables.append(searched(folder, tmp_path / f"out-{name}"))
    safe, still = (np.array(table.column("verdict").to_pylist()) == "safe" for table in tables)
    assert not (still & ~safe).any()
    assert 0 < still.sum() <= safe.sum()
    assert "clearance_beyond_labels_mm" in tables[1].column_names


def test_from_a_folder_of_meshes(tmp_path, capfd):
    """The embedded abdomen's meshes without its case: the same verdicts as of its own roles and margins."""
    folder = tmp_path / "patient"
    folder.mkdir()
    for mesh in (meshes_folder() / "abdomen").glob("*.ply"):
        shutil.copy(mesh, folder)
    assert main(["init", str(folder), "--target=-90,-10,60"]) == 0
    assert "27 meshes in mm (inferred" in capfd.readouterr().err
    table = searched(folder, tmp_path / "out")
    assert 0 < table.column("verdict").to_pylist().count("safe") < len(table)
    text = (meshes_folder() / "abdomen" / "case.toml").read_text()
    start, end = text.index("[registration]"), text.index("[[structure]]")
    own = text[:start] + text[end:]
    own = changed(own, ("length_mm = 210.0", "length_mm = 200.0"), COARSE)
    own = own.replace('name = "liver"\nmesh = "liver.ply"\nunit = "mm"\nrole = "target"', LIVER_CROSSED)
    (folder / "case.toml").write_text(own)
    assert main(["search", str(folder), "--no-pictures", "--out", str(tmp_path / "hand")]) == 0
    assert same_verdicts(table, pq.read_table(tmp_path / "hand" / "candidates.parquet"))


LIVER_CROSSED = 'name = "liver"\nmesh = "liver.ply"\nunit = "mm"\nrole = "traverse"'
