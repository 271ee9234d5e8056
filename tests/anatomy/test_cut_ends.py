"""An image that was cut through the body and filled up with air: the face at which it was cut is no skin."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import case_text, skin_from_ct, structure

from puncture_twin.planning.anatomy.body.body_mask import ct_image
from puncture_twin.planning.anatomy.body.cut_ends import SIDES, content_of, cut_ends, end_warnings, stated_ends
from puncture_twin.planning.anatomy.skin import skin_from_label, skin_of_image, skin_paths
from puncture_twin.planning.formats.labels.labelmaps import LabelMap, label_mesh
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.search.context import prepare

STEP_MM = 4.0
T_CT_INDEX = np.diag([STEP_MM, STEP_MM, STEP_MM, 1.0])
RADII_MM = np.array([72.0, 60.0, 84.0])
ALL_SIDES = sorted(SIDES.values())


def lumps(radii_mm=RADII_MM, spacing=(STEP_MM,) * 3, shift=(0.0, 0.0, 0.0)):
    """A round body, shape (nx, ny, nz), in air; its middle is off the grid by a shift, voxels."""
    radii, spacing = np.array(radii_mm), np.array(spacing)
    counts = 2 * (np.ceil((radii + 12.0) / spacing).astype(int) + 1) + 1
    index = np.indices(counts) - ((counts - 1) / 2 + np.array(shift))[:, None, None, None]
    return sum((index[k] * spacing[k] / radii[k]) ** 2 for k in range(3)) < 1.0


def cut_at(array, axis, end):
    """The part of an image up to a plane that lies half way from its middle to one side."""
    n = array.shape[axis]
    part = slice(n // 4, None) if end == 0 else slice(0, n - n // 4)
    return array[tuple(part if k == axis else slice(None) for k in range(3))]


def filled_up(array, axis, end, voxels, value=0.0):
    width = [(0, 0)] * 3
    width[axis] = (voxels, 0) if end == 0 else (0, voxels)
    return np.pad(array, width, constant_values=value)


def surface_of(labels):
    """The surface of a label, mm, and its voxels' size."""
    labelmap = LabelMap(labels.astype(np.int32), T_CT_INDEX, None, Path("made.nii"))
    return label_mesh(labelmap, 1, where="test"), STEP_MM


def hu_of(body, seed=0):
    noise = np.random.default_rng(seed).normal(0.0, 12.0, body.shape)
    return np.where(body, 40.0, -1000.0) + noise


@pytest.mark.parametrize("voxels", [1, 9])
@pytest.mark.parametrize("side", ALL_SIDES)
def test_what_lies_behind_a_face_that_cuts_an_organ_is_left_out(side, voxels):
    """At each of the six sides, however wide the border is, the image is what it was before it was filled up."""
    (axis, end), organ, whole = side, lumps(RADII_MM - 16.0), lumps()
    margins = [(n - m) // 2 for n, m in zip(whole.shape, organ.shape, strict=True)]
    organ = np.pad(organ, [(k, k) for k in margins])
    body, organ = cut_at(whole, axis, end), filled_up(cut_at(organ, axis, end), axis, end, voxels)
    low = tuple(voxels if (k, 0) == side else 0 for k in range(3))
    content = content_of(filled_up(body, axis, end, voxels), T_CT_INDEX)
    cut = cut_ends(content, [surface_of(organ)], whole=True)
    assert np.argwhere(cut).tolist() == [[axis, end]]
    assert content.box(cut) == tuple((a, a + n) for a, n in zip(low, body.shape, strict=True))


@pytest.mark.parametrize("end", [0, 1])
def test_across_the_bed_a_patient_does_not_end_flat(end):
    """Without any label: a face as wide as the body is a cut. Of a phantom nothing says so, and that is said."""
    content = content_of(filled_up(cut_at(lumps(), 2, end), 2, end, 3), T_CT_INDEX)
    assert np.argwhere(cut_ends(content, (), whole=False)).tolist() == [[2, end]]
    none = cut_ends(content, (), whole=True)
    assert not none.any()
    assert len(end_warnings(content, none, whole=True)) == 1
    assert end_warnings(content, none, whole=False) == ()


def test_no_round_end_is_taken_for_a_cut():
    """60 heads and stumps of any size, on voxels of .7 to 10 mm, wherever they lie on them."""
    rng = np.random.default_rng(7)
    for _ in range(60):
        spacing = rng.uniform([2.0, 2.0, 0.7], [4.0, 4.0, 10.0])
        radii = rng.uniform(20.0, 90.0, 3)
        radii[2] = max(radii[2], radii[0] * radii[1] / 130.0)
        body = lumps(radii, spacing, rng.uniform(-0.5, 0.5, 3))
        assert not cut_ends(content_of(body, np.diag([*spacing, 1.0])), (), whole=False).any()


def test_a_phantom_that_ends_flat_is_whole_unless_it_cuts_an_insert():
    """A cylinder in air. What is all of it, or runs through it from end to end, says nothing; a shorter rod does."""
    radius = np.hypot(*(np.indices((40, 40)) - 19.5)) * STEP_MM
    body = np.pad(np.repeat((radius < 60.0)[:, :, None], 30, axis=2), ((0, 0), (0, 0), (6, 9)))
    content = content_of(body, T_CT_INDEX)
    rod = (radius < 20.0)[:, :, None] & body
    short = rod & (np.arange(body.shape[2]) > 10)

    def ends(labels, *, whole=True):
        return np.argwhere(cut_ends(content, [surface_of(labels)], whole=whole)).tolist()

    assert ends(body) == []
    assert ends(rod) == []
    assert ends(short) == [[2, 1]]
    assert ends(body, whole=False) == [[2, 0], [2, 1]]


def test_a_side_with_the_same_border_as_a_cut_one_is_cut_too():
    """The border was laid around all of the image: where the body just reaches its face, nothing else would say so."""
    body = lumps()
    touching = body[np.flatnonzero(body.any(axis=(1, 2)))[0] :]
    padded = filled_up(filled_up(cut_at(touching, 2, 1), 2, 1, 2), 0, 0, 2)
    cut = cut_ends(content_of(padded, T_CT_INDEX), (), whole=False)
    assert np.argwhere(cut).tolist() == [[0, 0], [2, 1]]


@pytest.mark.parametrize("fill", ["noise", -1000.0, -3024.0, 0.0])
@pytest.mark.parametrize(("end", "voxels"), [(0, 1), (1, 6)])
def test_no_path_enters_through_a_cut_that_was_filled_up(end, voxels, fill):
    """The skin is that of the image as it was cut: the same surface, the same marks, and no entry there."""
    body = cut_at(lumps(), 2, end)
    hu = hu_of(body)
    padded = filled_up(hu, 2, end, voxels)
    border = filled_up(np.zeros(hu.shape, bool), 2, end, voxels, value=1).astype(bool)
    padded[border] = fill if fill != "noise" else np.random.default_rng(1).normal(-1000.0, 12.0, border.sum())
    T_padded = T_CT_INDEX.copy()
    T_padded[2, 3] = -voxels * STEP_MM if end == 0 else 0.0
    known, skin = (skin_from_ct(Volume(v, T, Path("made.nii"))) for v, T in ((hu, T_CT_INDEX), (padded, T_padded)))
    assert np.array_equal(known.mesh.faces, skin.mesh.faces)
    assert np.allclose(known.mesh.vertices, skin.mesh.vertices, atol=1e-9)
    assert np.array_equal(known.cut_faces, skin.cut_faces)
    assert np.allclose(known.field_of_view.T_ct_box, skin.field_of_view.T_ct_box)
    middle = np.array(np.argwhere(body).mean(axis=0)) * STEP_MM
    through = skin_paths(skin, middle, np.array([[0.0, 0.0, 1.0 if end else -1.0]]), 200.0)
    assert np.isfinite(through.unknown_depth).all()
    assert np.isnan(through.path_length).all()


def test_a_label_of_the_body_that_was_filled_up_is_cut_as_well():
    """The skin of a label ends where the label was cut."""
    labels = filled_up(cut_at(lumps(), 2, 1), 2, 1, 4).astype(np.int32)
    labelmap = LabelMap(labels, T_CT_INDEX, None, Path("made.nii"))
    content = content_of(labels == 1, T_CT_INDEX)
    skin = skin_from_label(labelmap, 1, content.box(cut_ends(content, (), whole=False)))
    assert skin.field_of_view.cut.tolist() == [[False, False], [False, False], [False, True]]
    assert skin.cut_faces.any()
    assert not skin_from_label(labelmap, 1).cut_faces.any()


def test_what_the_case_states_is_so():
    """``cut = []`` of a phantom with inserts that end where it does: all of it is skin. ``cut = ["head"]``: one end."""
    image = ct_image(Volume(hu_of(filled_up(cut_at(lumps(), 2, 1), 2, 1, 4)), T_CT_INDEX, Path("made.nii")))
    for names, cut in (((), []), (("head",), [[2, 1]])):
        skin = skin_of_image(image.within(image.content.box(stated_ends(names))))
        assert np.argwhere(skin.field_of_view.cut).tolist() == cut


def case_of(cut):
    return case_text(
        structure("skin", "skin", {"ct": "ct.nii.gz"}) + cut,
        structure("lesion", "target", {"labelmap": "labels.nii.gz", "label": 1}),
        structure("rod", "avoid", {"labelmap": "labels.nii.gz", "label": 2}, margin_mm=2.0),
        region="phantom",
        target='position_mm = [80.0, 80.0, 80.0]\nstructure = "lesion"',
        needle="length_mm = 170.0\nshaft_mm = 120.0\ndiameter_mm = 1.2",
        search='theta_deg = [0, 80]\nstep_deg = 10.0\nmax_skin_angle_deg = 85\nframe = "bed"',
    )


def unknown_of(folder, rod, cut=""):
    """How many directions of a box in air are unknown_region, and the skin, where a rod lies in it."""
    index = np.indices((40, 40, 40)) - 20
    body = np.all(np.abs(index) < 12, axis=0)
    labels = (np.linalg.norm(index, axis=0) < 3).astype(np.uint8)
    labels[(np.hypot(index[0] - 7, index[1]) < 3) & body & rod(index[2])] = 2
    for name, array in (("ct", np.round(hu_of(body)).astype(np.int16)), ("labels", labels)):
        image = sitk.GetImageFromArray(array.T)
        image.SetSpacing([STEP_MM] * 3)
        sitk.WriteImage(image, str(folder / f"{name}.nii.gz"))
    (folder / "case.toml").write_text(case_of(cut))
    context = prepare(folder / "case.toml", arm=False)
    counts = context.search().counts()
    return counts.get("unknown_region", 0), context.anatomy.skin.field_of_view.cut


def test_a_phantom_that_cuts_an_insert_was_cut_unless_its_case_says_that_it_is_whole(tmp_path):
    """A rod that ends within: no path leaves at the end where it is cut, until ``cut = []`` stands in the case.

    Where it runs through from end to end, the four flat sides are skin, and so are the ends: in air it lies on nothing.
    """
    unknown, cut = unknown_of(tmp_path, lambda z: z < 99)
    assert unknown == 0 and not cut.any()
    unknown, cut = unknown_of(tmp_path, lambda z: z > -4)
    assert unknown > 0
    assert np.argwhere(cut).tolist() == [[2, 1]]
    assert unknown_of(tmp_path, lambda z: z > -4, "cut = []\n")[0] == 0
