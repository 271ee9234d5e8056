"""Slicer's segmentations: every segment's voxels where Slicer put them, also those of segments that overlap."""

import gzip

import numpy as np
import pytest
import SimpleITK
from case_world import ball, case_text, structure
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import load_anatomy
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.labels.label_sources import parse_segments

SHAPE = (24, 20, 16)
AFFINE = np.array([[5.0, 0, 0, -60], [0, 0, 5.0, -40], [0, -5.0, 0, 50], [0, 0, 0, 1.0]])
"""The second axis to the feet, the third to the back."""


def segments():
    i, j, k = np.indices(SHAPE)
    lung = (i - 12) ** 2 + (j - 10) ** 2 + (k - 8) ** 2 < 36
    return {"right lung": lung, "lesion 1": (i > 10) & (i < 14) & (abs(j - 10) < 2) & (abs(k - 8) < 2), "rib": i == 20}


def seg_nrrd(*changes, layers=2):
    lung, lesion, rib = segments().values()
    stack = np.zeros((layers, *SHAPE), np.uint8)
    stack[0][lung], stack[0][rib], stack[-1][lesion] = 1, 2, 1 if layers > 1 else 3
    columns = " ".join("(" + ",".join(f"{x:g}" for x in AFFINE[:3, axis]) + ")" for axis in range(3))
    four = layers > 1
    lines = [
        "NRRD0004",
        "# Complete NRRD file format specification at:",
        "# http://teem.sourceforge.net/nrrd/format.html",
        "type: unsigned char",
        f"dimension: {3 + four}",
        "space: left-posterior-superior",
        f"sizes: {f'{layers} ' * four}{' '.join(map(str, SHAPE))}",
        f"space directions: {'none ' * four}{columns}",
        f"kinds: {'list ' * four}domain domain domain",
        "encoding: gzip",
        "space origin: (-60,-40,50)",
    ]
    for number, (name, layer, label) in enumerate(
        [("right lung", 0, 1), ("lesion 1", layers - 1, 1 if four else 3), ("rib", 0, 2)]
    ):
        lines += [
            f"Segment{number}_ID:=Segment_{number + 1}",
            f"Segment{number}_LabelValue:={label}",
            f"Segment{number}_Layer:={layer}",
            f"Segment{number}_Name:={name}",
            f"Segment{number}_Extent:=0 23 0 19 0 15",
            f"Segment{number}_Tags:=TerminologyEntry:Segmentation category and type - 3D Slicer General Anatomy list|",
        ]
    lines += ["Segmentation_MasterRepresentation:=Binary labelmap", "Segmentation_ReferenceImageExtentOffset:=0 0 0"]
    text = "\n".join(lines) + "\n\n"
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return text.encode() + gzip.compress(stack.tobytes(order="F"))


def read(folder, data):
    path = folder / "body.seg.nrrd"
    path.write_bytes(data)
    return parse_segments(path, path.name, lambda name: (folder / name).read_bytes())


@pytest.mark.parametrize("layers", [2, 1])
def test_every_segment_is_where_it_was_drawn(tmp_path, layers):
    """Names with spaces; segments that overlap keep the voxels that they share where the file has layers."""
    found = read(tmp_path, seg_nrrd(layers=layers))
    truth = segments()
    if layers == 1:  # one label for each voxel: what was drawn last holds
        truth["right lung"] = truth["right lung"] & ~truth["lesion 1"]
    assert list(found.masks) == list(truth)
    for name, mask in found.masks.items():
        assert np.array_equal(mask.volume().values, truth[name])
        assert np.allclose(mask.grid.T_ct_index, AFFINE)


def test_layers_are_those_that_itk_reads(tmp_path):
    found = read(tmp_path, seg_nrrd())
    image = SimpleITK.ReadImage(str(tmp_path / "body.seg.nrrd"))
    values = SimpleITK.GetArrayFromImage(image).transpose(2, 1, 0, 3)
    for name, layer, label in (("right lung", 0, 1), ("lesion 1", 1, 1), ("rib", 0, 2)):
        assert np.array_equal(found.masks[name].volume().values, values[..., layer] == label)
    assert image.TransformIndexToPhysicalPoint((3, 5, 7)) == pytest.approx(AFFINE[:3] @ [3, 5, 7, 1])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ([("_Layer:=1", "_Layer:=0")], "duplicate_label"),
        ([("_Layer:=1", "_Layer:=2")], "out_of_range"),
        ([("Segment1_Layer:=1\n", "")], "bad_value Segment1_Layer"),
        ([("Segment2_LabelValue:=2", "Segment2_LabelValue:=two")], "bad_value Segment2_LabelValue"),
        ([("Segment2_LabelValue:=2", "Segment2_LabelValue:=0")], "out_of_range"),
        ([("Name:=rib", "Name:=lesion 1")], "duplicate_name"),
        ([("Segment2_Name:=rib\n", "")], "bad_name"),
        ([("Segment", "Part")], "no_structure"),
        ([("kinds: list", "kinds: time")], "wrong_dimension"),
        ([("directions: none", "directions: (0,0,0)")], "wrong_dimension"),
        ([("sizes: 2", "sizes: 3")], "size_mismatch"),
        ([("sizes: 2", "sizes: 2000")], "out_of_range 2000"),
        ([("dimension: 4", "dimension: 5")], "wrong_dimension"),
        ([("unsigned char", "float"), ("encoding", "endian: little\nencoding")], "wrong_type float32"),
    ],
)
def test_a_segmentation_that_is_not_clear_is_refused(tmp_path, changes, says):
    """A lost or mistaken segment would make a path free."""
    with refused(*says.split()):
        _ = [mask.volume() for mask in read(tmp_path, seg_nrrd(*changes)).masks.values()]


def test_a_case_takes_segments_that_overlap_by_their_names(tmp_path):
    """A target in "lesion 1", inside of "right lung": both are whole, each with its role."""
    ball(tmp_path / "skin.stl", 150.0)
    (tmp_path / "body.seg.nrrd").write_bytes(seg_nrrd())
    rules = (
        '[[structures]]\nseg = "body.seg.nrrd"\ntarget = ["lesion 1"]\ntraverse = ["right lung"]\navoid = { rib = 2 }\n'
    )
    target = 'position_mm = [0.0, 0.0, 0.0]\nstructure = "lesion 1"'
    (tmp_path / "case.toml").write_text(case_text(structure("skin", "skin"), rules, target=target, listed=3))
    case = load_case(tmp_path)
    assert ("seg", "body.seg.nrrd") in [(one.role, one.path) for one in case.inputs]
    found = {one.name: one for one in load_anatomy(case).structures}
    assert {name: str(one.role) for name, one in found.items() if name in segments()} == {
        "right lung": "traverse", "lesion 1": "target", "rib": "avoid",
    }  # fmt: skip
    middle = found["right lung"].mesh.vertices.mean(axis=0)
    assert middle == pytest.approx((AFFINE @ [12, 10, 8, 1])[:3], abs=0.5)


@pytest.mark.parametrize("layers", [1, 2])
def test_voxels_of_a_segment_that_is_not_listed_are_not_lost(tmp_path, layers):
    """The rib's remarks are gone, its voxels are there: it would count as free."""
    data = seg_nrrd(layers=layers)
    head, _, voxels = data.partition(b"\n\n")
    lines = [line for line in head.split(b"\n") if not line.startswith(b"Segment2_")]
    found = read(tmp_path, b"\n".join(lines) + b"\n\n" + voxels)
    with refused("label_without_segment", "[2]"):
        found.masks["right lung"].volume()
