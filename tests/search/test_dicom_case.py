"""A case whose CT is a DICOM series gives the verdicts of the same CT in NIfTI, and lists every slice."""

import hashlib
import json
import subprocess
import sys

import dicom_world as world
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import structure, whole
from places import ROOT
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import load_anatomy
from puncture_twin.planning.base.provenance import differing_input
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.search.context import prepare
from tools.phantoms import supine
from tools.phantoms.ct_image import rendered

SPINE = structure("spine", "avoid", {"labelmap": "labels.nii.gz", "label": 2}, margin_mm=2.0)
LESION = structure("lesion", "target", {"labelmap": "labels.nii.gz", "label": 1})
HEAD = """schema = 2
region = "phantom"
name = "supine"
space = "LPS"
[target]
position_mm = [-55.0, 20.0, 0.0]
structure = "lesion"
[needle]
length_mm = 210.0
shaft_mm = 150.0
diameter_mm = 1.2
[search]
theta_deg = [0, 180]
step_deg = 30.0
max_skin_angle_deg = 75
"""


def write_scene(folder):
    grid, parts = supine.grid(), supine.trunk_parts() + supine.bed_parts()
    hu = rendered(parts, grid, noise_hu=15.0, rng=np.random.default_rng(3))
    labels = np.zeros(grid.shape, np.uint8)
    for label, name in enumerate(("lesion", "spine"), start=1):
        field = next(part.field for part in parts if part.name == name)
        labels[(field(grid.centres()) < 0).reshape(grid.shape)] = label
    for name, values in (("ct", hu.astype(np.int16)), ("labels", labels)):
        image = sitk.GetImageFromArray(values.transpose(2, 1, 0))
        image.SetSpacing(grid.spacing_mm)
        image.SetOrigin(grid.low_mm)
        sitk.WriteImage(image, str(folder / f"{name}.nii.gz"))
    volume = read_volume(folder / "ct.nii.gz")
    stored = (np.asarray(volume.values, np.int32) + 1024).astype(np.int16)
    assert np.array_equal(stored.astype(np.float32) - 1024, volume.values)
    world.write_series(folder / "series", world.series(stored, volume.T_ct_index.copy()))
    write_case(folder, "nifti", "ct.nii.gz")
    write_case(folder, "dicom", "series")


def write_case(folder, name, ct):
    text = HEAD + structure("skin", "skin", {"ct": ct}) + LESION + SPINE
    (folder / f"{name}.toml").write_text(whole(text))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder)
    return folder


def test_a_series_gives_the_verdicts_of_the_same_ct_in_nifti(scene):
    nifti, dicom = (prepare(scene / f"{name}.toml", arm=False) for name in ("nifti", "dicom"))
    one, other = nifti.search(), dicom.search()
    assert np.array_equal(one.verdict.reason, other.verdict.reason)
    assert np.allclose(one.clearance.by_structure, other.clearance.by_structure, atol=1e-3, equal_nan=True)
    assert np.allclose(one.path.length, other.path.length, atol=1e-3, equal_nan=True)
    assert one.safe.any()
    assert dicom.anatomy.warnings == tuple(line.replace("ct.nii.gz", "series") for line in nifti.anatomy.warnings)


def test_every_slice_is_an_input_and_may_name_the_series(scene):
    case = load_case(scene / "dicom.toml")
    slices = [one for one in case.inputs if one.role == "ct"]
    files = sorted((scene / "series").iterdir())
    assert [one.path for one in slices] == [f"series/{path.name}" for path in files]
    assert [one.sha256 for one in slices] == [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]
    content = files[3].read_bytes()
    files[3].write_bytes(content[:-2] + b"\0\1")
    try:
        assert differing_input(case.inputs, load_case(scene / "dicom.toml").inputs) == f"ct ({slices[3].path})"
    finally:
        files[3].write_bytes(content)
    write_case(scene, "file", f"series/{sorted(path.name for path in (scene / 'series').iterdir())[5]}")
    file, folder = (load_case(scene / f"{name}.toml").inputs for name in ("file", "dicom"))
    assert [one for one in file if one.role == "ct"] == [one for one in folder if one.role == "ct"]
    text = (scene / "dicom.toml").read_text()
    (scene / "wrong.toml").write_text(text.replace(json.dumps("labels.nii.gz"), json.dumps("series"), 1))
    with refused("no_such_file"):
        load_case(scene / "wrong.toml")


def test_a_case_without_dicom_does_not_load_its_library(scene):
    code = f"import sys; from {load_case.__module__} import load_case; load_case(sys.argv[1])"
    code += "; print('pydicom' in sys.modules)"
    for name in ("nifti", "dicom"):
        command = [sys.executable, "-c", code, str(scene / f"{name}.toml")]
        done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
        assert done.stdout.strip() == str(name == "dicom")


def boxes_of(mask, T):
    """Contours of a mask, slice by slice: the edges of each run of voxels in a column, as a rectangle."""
    contours = []
    for k, j in np.argwhere(mask.any(axis=0).T):
        edges = np.flatnonzero(np.diff(np.pad(mask[:, j, k].astype(int), 1)))
        for low, high in edges.reshape(-1, 2):
            corners = [(low - 0.5, j - 0.5), (high - 0.5, j - 0.5), (high - 0.5, j + 0.5), (low - 0.5, j + 0.5)]
            contours.append(np.array([(T @ [x, y, k, 1])[:3] for x, y in corners]))
    return contours


def write_structures(folder):
    labels = read_volume(folder / "labels.nii.gz")
    masks = {"the lesion": labels.values == 1, "spine": labels.values == 2}
    world.write(world.segmentation(masks, labels.T_ct_index), folder / "seg.dcm")
    contours = {name: boxes_of(mask, labels.T_ct_index) for name, mask in masks.items()}
    world.write(world.structure_set(contours), folder / "rt.dcm")
    head = HEAD.replace('structure = "lesion"', 'structure = "the lesion"') + structure(
        "skin", "skin", {"ct": "series"}
    )
    for kind, file in (("seg", "seg.dcm"), ("rtstruct", "rt.dcm")):
        rules = 'target = ["the lesion"]\navoid = { "spi*" = 2.0 }\n'
        text = whole(f'{head}[[structures]]\n{kind} = "{file}"\n{rules}', listed=2)
        (folder / f"{kind}.toml").write_text(text)


def test_seg_and_rtstruct_give_the_verdicts_of_a_label_map(scene):
    write_structures(scene)
    labels = prepare(scene / "dicom.toml", arm=False).search()
    for kind, file in (("seg", "seg.dcm"), ("rtstruct", "rt.dcm")):
        context = prepare(scene / f"{kind}.toml", arm=False)
        assert [one.name for one in context.anatomy.structures[:2]] == ["the lesion", "spine"]
        assert (kind, file) in [(one.role, one.path) for one in context.case.inputs]
        found = context.search()
        assert np.array_equal(found.verdict.reason, labels.verdict.reason)
        assert np.allclose(found.path.length, labels.path.length, atol=1e-3, equal_nan=True)


WRONG = {
    "rtstruct without a series": (("series", "ct.nii.gz"), "rtstruct_without_ct rt.dcm"),
    "an organ that no rule names": (('avoid = { "spi*" = 2.0 }', ""), "no_rule"),
    "a naming": (('rtstruct = "rt.dcm"', 'rtstruct = "rt.dcm"\nnaming = "x.csv"'), "key_not_of_it"),
    "two sources": (('rtstruct = "rt.dcm"', 'rtstruct = "rt.dcm"\nseg = "seg.dcm"'), "not_one_source"),
    "ct beside a label map": (('rtstruct = "rt.dcm"', 'labelmap = "labels.nii.gz"\nct = "series"'), "key_not_of_it"),
    "a file that is not there": (('rtstruct = "rt.dcm"', 'rtstruct = "none.dcm"'), "no_such_file none.dcm"),
    "the other kind": (('rtstruct = "rt.dcm"', 'seg = "rt.dcm"'), "wrong_format"),
}


@pytest.mark.parametrize("name", sorted(WRONG))
def test_what_is_wrong_with_structures_of_dicom_is_said(scene, name):
    if not (scene / "rtstruct.toml").is_file():
        write_structures(scene)
    change, message = WRONG[name]
    text = (scene / "rtstruct.toml").read_text()
    assert change[0] in text
    (scene / "wrong.toml").write_text(text.replace(*change))
    with refused(*message.split()):
        load_anatomy(load_case(scene / "wrong.toml"))
