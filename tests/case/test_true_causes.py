"""`init` and cases name the cause that is true: what lies there, and why each was passed over; cheap checks first."""

import json

import numpy as np
import pytest
from case_world import write_case
from refusals import refused
from round_body import X, body_hu, inside, write_image

from puncture_twin.planning.anatomy.default_roles import NOT_ANNOTATED, default_role
from puncture_twin.planning.base.cache.array_cache import NO_CACHE
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.progress import unnamed
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.init.finder import Wanted
from puncture_twin.planning.init.start import Request, start_case


def labels():
    voxels = np.zeros(X.shape, np.uint8)
    for number, middle in enumerate(((0, 0, 0), (36, 10, 0), (0, -40, 20)), start=1):
        voxels[inside(middle, 10.0)] = number
    return voxels


def patient(folder, image=None, labelmap=None, names=None):
    """A CT and a label map; what is given replaces what is right."""
    write_image(folder / "ct.nii.gz", body_hu().astype(np.int16) if image is None else image)
    write_image(folder / "labels.nii.gz", labels() if labelmap is None else labelmap)
    if names is not None:
        (folder / "dataset.json").write_text(json.dumps({"labels": names}))
    return folder


NAMES = {"background": 0, "liver lesion": 1, "aorta": 2, "ignore": 3}


def started(folder):
    request = Request(folder, "0,0,0", None, "abdomen", Wanted(Space.LPS))
    return start_case(request, NO_CACHE, unnamed)


def refusal(folder):
    with pytest.raises(InputError) as caught:
        started(folder)
    return caught.value


def test_an_image_without_hounsfield_units_is_no_label_map(tmp_path):
    """It was asked who numbered its labels; its air tells the offset."""
    error = refusal(patient(tmp_path, image=np.clip(body_hu() + 1024, 0, None).astype(np.uint16), names=NAMES))
    assert error.code == "no_ct"
    assert "ct.nii.gz (not in Hounsfield units, its air is 2" in error.what and "-1024 missing" in error.what


@pytest.mark.parametrize(
    ("labelmap", "code", "said"),
    [
        (lambda: np.where(labels() > 0, labels().astype(np.uint32) + 70_000, 0), "no_segmentation", "from 0 to 70003"),
        (lambda: body_hu().astype(np.float32) * 0.01 + 20, "no_segmentation", "is not whole"),
        (lambda: labels().astype(np.float32) - 2, "no_segmentation", "from -2.0 to 1.0"),
    ],
)
def test_a_segmentation_that_lies_there_is_never_none(tmp_path, labelmap, code, said):
    error = refusal(patient(tmp_path, labelmap=labelmap(), names=NAMES))
    assert error.code == code and "labels.nii.gz (" in error.what and said in error.what


def test_labels_between_labels_are_refused_as_blended(tmp_path):
    organ = 3 * inside((0, 0, 0), 30.0) + 2 * inside((50, 0, 0), 15.0)
    blended = (organ[1:] / 3 + organ[:-1] * 2 / 3).astype(np.float32)
    error = refusal(patient(tmp_path, labelmap=blended, names=NAMES))
    assert error.code == "labels_blended" and error.what.startswith("labels.nii.gz: ")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ({"background": 0, "a": 1, "b": 2}, "dataset.json lacks 3 (it names 1 to 2)"),
        ({**NAMES, "abdomen": [1, 2]}, "dataset.json: 'abdomen' is a list of labels"),
        (None, "no table of names is next to it"),
    ],
)
def test_a_table_that_lies_there_is_never_none(tmp_path, names, said):
    error = refusal(patient(tmp_path, names=names))
    assert error.code == "labels_without_names" and said in error.what


def test_what_nobody_annotated_is_unknown_and_told(tmp_path):
    start = started(patient(tmp_path, names=NAMES))
    assert '"ignore" = 2' in start.text.split("[structures.unknown]")[1]
    assert any("not annotated" in note and "ignore" in note for note in start.notes)
    assert default_role("Ignore", "brain") == NOT_ANNOTATED


def test_nothing_at_all_says_so(tmp_path):
    (tmp_path / "scan.bin").write_bytes(b"x")
    assert "scan.bin (of an unsupported kind)" in refusal(tmp_path).what


def test_a_list_that_was_cut_is_refused_before_a_volume_is_read(tmp_path):
    """A missing line break cost minutes: volumes of gigabytes were read first."""
    write_case(tmp_path)
    (tmp_path / "markers_ct.csv").write_text((tmp_path / "markers_ct.csv").read_text().rstrip("\n"))
    for volume in tmp_path.glob("*.n*"):
        volume.write_bytes(b"no volume")
    with refused("file_cut"):
        load_case(tmp_path)
