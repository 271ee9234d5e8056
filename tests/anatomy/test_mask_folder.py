"""A folder of masks, one volume a structure, is the same to a search as the label map that they were taken from."""

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import SKIN, case_text, image_of, structure, vessel_voxels, write_balls
from refusals import refused

from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.search.context import prepare

RULES = '{source}\ntarget = ["organ"]\n[structures.avoid]\n"vessel *" = 3.0\n'


def labels():
    """The usual patient's vessel (3), and its organ (1), voxels (z, y, x)."""
    voxels = vessel_voxels()
    at = np.arange(100) * 2.0 - 99.0
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    voxels[x**2 + y**2 + z**2 < 20.0**2] = 1
    return voxels


def write_mask(path, mask, value=1, spacing=(2.0, 2.0, 2.0), dtype=np.uint8):
    path.parent.mkdir(exist_ok=True)
    sitk.WriteImage(image_of((value * mask).astype(dtype), spacing), str(path))


def write_masks(folder):
    """Two masks of different values and types, and an empty one."""
    write_mask(folder / "organ.nii.gz", labels() == 1)
    write_mask(folder / "vessel left.nii.gz", labels() == 3, value=255, dtype=np.int16)
    write_mask(folder / "gallbladder.nii.gz", labels() == 9)
    (folder / "statistics.json").write_text("{}")


def write_both(folder):
    """The masks, and the label map that they were taken from."""
    write_masks(folder / "seg")
    sitk.WriteImage(image_of(labels()), str(folder / "labels.nrrd"))
    (folder / "names.csv").write_text("id,name\n1,organ\n3,vessel left\n")


def case_of(folder, source):
    """A case of the usual skin and a source of structures."""
    write_balls(folder, "skin")
    text = case_text(SKIN, "[[structures]]\n" + RULES.format(source=source), region="phantom", listed=2)
    (folder / "case.toml").write_text(text)
    return folder / "case.toml"


def test_a_folder_of_masks_is_searched_as_its_label_map_is(tmp_path):
    """Same surfaces, same verdicts; an empty mask is no structure, and a note says so."""
    write_both(tmp_path)
    by_masks = prepare(case_of(tmp_path, 'masks = "seg"'), arm=False)
    by_map = prepare(case_of(tmp_path, 'labelmap = "labels.nrrd"\nnaming = "names.csv"'), arm=False)
    for one, other in zip(by_masks.anatomy.structures, by_map.anatomy.structures, strict=True):
        assert (one.name, one.role, one.margin_mm) == (other.name, other.role, other.margin_mm)
        assert np.array_equal(one.mesh.vertices, other.mesh.vertices)
        assert np.array_equal(one.mesh.faces, other.mesh.faces)
    found, plain = by_masks.search(), by_map.search()
    assert np.array_equal(found.verdict.reason, plain.verdict.reason)
    assert "seg: 1 empty mask: gallbladder" in by_masks.anatomy.warnings
    assert by_masks.anatomy.structure("vessel left").source == "seg/vessel left.nii.gz:255"


def test_every_mask_is_an_input_and_has_its_rule(tmp_path):
    """The empty one decided that there is nothing, and need not be named; what is no volume decided nothing."""
    write_masks(tmp_path / "seg")
    path = case_of(tmp_path, 'masks = "seg"')
    masks = {f"mask {name}": f"seg/{name}.nii.gz" for name in ("gallbladder", "organ", "vessel left")}
    files = {one.role: one.path for one in load_case(path).inputs}
    assert files == {"case": "case.toml", "mesh skin": "skin.stl", **masks}
    write_mask(tmp_path / "seg" / "rib.nii.gz", labels() == 3)
    with refused("no_rule"):
        prepare(path, arm=False)


def test_a_mask_on_another_grid_is_refused(tmp_path):
    """Of other voxels, or elsewhere: both files and the difference are named."""
    write_masks(tmp_path / "seg")
    path = case_of(tmp_path, 'masks = "seg"')
    write_mask(tmp_path / "seg" / "organ.nii.gz", (labels() == 1)[:90])
    with refused("other_grid", "seg/organ.nii.gz", "seg/gallbladder.nii.gz", "100"):
        prepare(path, arm=False)
    write_mask(tmp_path / "seg" / "organ.nii.gz", labels() == 1, spacing=(2.0, 2.0, 2.1))
    with refused("other_grid", "9.9"):
        prepare(path, arm=False)


def test_what_is_no_folder_of_masks_is_refused(tmp_path):
    """No folder, an empty one, a label map among the masks, two files of one name, both sources at once."""
    path = case_of(tmp_path, 'masks = "seg"')
    with refused("not_a_folder", "1.masks", "seg"):
        load_case(path)
    (tmp_path / "seg").mkdir()
    with refused("wrong_count", "seg"):
        load_case(path)
    write_mask(tmp_path / "seg" / "organ.nii.gz", labels())
    with refused("not_a_mask"):
        prepare(path, arm=False)
    write_mask(tmp_path / "seg" / "organ.nrrd", labels() == 1)
    with refused("masks_of_one_name", "organ.nii.gz", "organ.nrrd"):
        load_case(path)
    with refused("not_one_source"):
        load_case(case_of(tmp_path, 'masks = "seg"\nlabelmap = "labels.nrrd"'))
    with refused("key_not_of_it"):
        load_case(case_of(tmp_path, 'masks = "seg"\nnaming = "a.csv"'))


def test_what_the_case_names_may_lie_among_the_masks(tmp_path):
    """The case itself, its meshes, another folder of masks in it; not a link to nothing, nor an organ in a folder."""
    write_masks(tmp_path)
    path = case_of(tmp_path, 'masks = "."')
    write_mask(tmp_path / "more" / "rib.nii.gz", labels() == 3)
    with refused("entries_not_read"):
        load_case(path)
    more = '[[structures]]\nmasks = "more"\navoid = {"rib" = 1.0}\n'
    path.write_text(path.read_text().replace("[end]", f"{more}[end]"))
    assert {one.role for one in load_case(path).inputs} >= {"mask organ", "mask rib", "mesh skin"}
    (tmp_path / "more" / "vein.nii.gz").symlink_to("../annex/vein.nii.gz")
    with refused("entries_not_read", "2.masks", "vein.nii.gz"):
        load_case(path)


def test_a_name_belongs_to_one_structure(tmp_path):
    """Also where one is a mask and the other a mesh."""
    write_masks(tmp_path / "seg")
    path = case_of(tmp_path, 'masks = "seg"')
    write_balls(tmp_path, "organ")
    text = path.read_text().replace("structures = 3", "structures = 4")
    path.write_text(text.replace(SKIN, SKIN + structure("organ", "target")))
    with refused("duplicate_name", "organ"):
        prepare(path, arm=False)


@pytest.mark.parametrize("source", ['masks = "seg"', 'labelmap = "labels.nrrd"\nnaming = "names.csv"'])
def test_a_wrong_count_is_refused_before_a_surface_is_made(tmp_path, monkeypatch, source):
    """What the headers and the values that are there tell needs no surface of hundreds of organs, nor the body's."""
    write_both(tmp_path)
    path = case_of(tmp_path, source)
    path.write_text(path.read_text().replace("[end]\nstructures = 3", "[end]\nstructures = 4"))
    made = []
    monkeypatch.setattr(VolumeSurfaces, "label", lambda _, label: made.append(label))
    with refused("structures_miscounted"):
        prepare(path, arm=False)
    assert made == []
