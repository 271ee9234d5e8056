"""A label map that ends in the body: what lies beyond is unknown, never free; compared along the map's own axes."""

import json
from dataclasses import replace

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import ORGAN, SKIN, case_text, structure, write_case
from places import DATA, REAL_CT
from refusals import refused
from scipy.spatial.transform import Rotation

from puncture_twin.planning.anatomy.structure import LabelGrid
from puncture_twin.planning.anatomy.unseen import CUT_MM, cut_off, stated_cuts
from puncture_twin.planning.formats.labels.labelmaps import LabelEnds, LabelMap, label_ends, labelmap_of
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.search.context import prepare

STEP_MM = 2.0


def oblique_case(folder, half_mm, turn):
    """The usual patient, whose skin is a ball of 90 mm; its label map is a cube about it, turned."""
    path = write_case(folder)
    n = round(2 * half_mm / STEP_MM)
    T = np.eye(4)
    T[:3, :3] = turn.as_matrix() * STEP_MM
    T[:3, 3] = -T[:3, :3] @ np.full(3, (n - 1) / 2)
    points = np.moveaxis(np.indices((n, n, n)), 0, -1) @ T[:3, :3].T + T[:3, 3]
    vessel = (np.abs(points - [36.0, 36.0, 0.0]) < [4.0, 4.0, 20.0]).all(axis=-1)
    image = sitk.GetImageFromArray((3 * vessel).astype(np.uint8).transpose(2, 1, 0))
    image.SetSpacing([STEP_MM] * 3)
    image.SetOrigin(T[:3, 3].tolist())
    image.SetDirection(turn.as_matrix().ravel().tolist())
    sitk.WriteImage(image, str(folder / "labels.nrrd"))
    return path


@pytest.mark.parametrize("degrees", [(0, 0, 0), (0, 0, 45), (20, -30, 40), (90, 0, 0), (180, 0, 5)])
def test_an_oblique_map_that_holds_the_body_is_accepted(tmp_path, degrees):
    turn = Rotation.from_euler("xyz", degrees, degrees=True)
    names = [s.name for s in prepare(oblique_case(tmp_path, 92.0, turn), arm=False).anatomy.structures]
    assert "vessel" in names


@pytest.mark.parametrize("degrees", [(0, 0, 0), (20, -30, 40)])
def test_the_body_beyond_an_oblique_map_is_unknown(tmp_path, degrees):
    """The map ends six voxels of 2 mm before the skin at every face: the body there is inside one closed surface."""
    turn = Rotation.from_euler("xyz", degrees, degrees=True)
    anatomy = prepare(oblique_case(tmp_path, 78.0, turn), arm=False).anatomy
    assert any("ends 6 voxels inside" in said and "of a larger part of the body" in said for said in anatomy.warnings)
    beyond = anatomy.structure("beyond_labels")
    assert (beyond.role, beyond.mesh.closed, beyond.margin_mm) == ("unknown", True, 3.0 + STEP_MM / 2)
    for axis in turn.as_matrix().T:
        for sign in (-1, 1):
            assert side_of(beyond.mesh, sign * 84.0 * axis) is Side.INSIDE
            assert side_of(beyond.mesh, sign * 77.9 * axis) is Side.OUTSIDE
            assert side_of(beyond.mesh, sign * 96.0 * axis) is Side.OUTSIDE, "air beyond the map stays air"


@pytest.mark.parametrize(("half_mm", "ends"), [(70.0, False), (50.0, True)])
def test_only_what_the_needle_reaches_counts(tmp_path, half_mm, ends):
    """With a needle of 62 mm a map of 70 mm to each side is enough, though the body goes on."""
    path = oblique_case(tmp_path, half_mm, Rotation.from_euler("xyz", (20, -30, 40), degrees=True))
    path.write_text(
        path.read_text().replace("length_mm = 210.0\nshaft_mm = 150.0", "length_mm = 62.0\nshaft_mm = 60.0")
    )
    names = [one.name for one in prepare(path, arm=False).anatomy.structures]
    assert ("beyond_labels" in names) == ends


def vessels():
    at = np.arange(100) * STEP_MM - 99.0
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    labels = np.zeros(z.shape, np.uint8)
    for middle in ([60, 20, 10], [-60, 0, 20], [20, 60, 0], [0, -60, 20], [10, 20, 60]):
        labels[(np.abs(np.stack([x, y, z], axis=-1) - middle) < 8.0).all(axis=-1)] = 3
    return labels


def verdicts(folder, labels, first):
    folder.mkdir()
    search = "theta_deg = [0, 180]\nstep_deg = 6.0"
    path = write_case(folder, ("theta_deg = [0, 10]\nstep_deg = 10.0", search))
    image = sitk.GetImageFromArray(labels)
    image.SetSpacing([STEP_MM] * 3)
    image.SetOrigin([-99.0 + STEP_MM * one for one in reversed(first)])
    sitk.WriteImage(image, str(folder / "labels.nrrd"))
    found = prepare(path, arm=False).search()
    return found.safe, found.verdict.reason, found.verdict.structure


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    return verdicts(tmp_path_factory.mktemp("map") / "whole", vessels(), (0, 0, 0))[0]


@pytest.mark.parametrize(
    "kept",
    [
        np.s_[:, :, :68], np.s_[:, :, 32:], np.s_[:, :72, :], np.s_[:, 30:, :], np.s_[:75, :, :], np.s_[20:80, :, :],
        np.s_[25:70, 28:70, 31:88], np.s_[:, :, :78], np.s_[:, :70, 25:],
    ],
)  # fmt: skip
def test_what_was_unsafe_is_never_safe_with_a_cropped_map(tmp_path, before, kept):
    labels = vessels()
    after, reason, structure = verdicts(tmp_path / "cut", labels[kept], [one.start or 0 for one in kept])
    assert before.sum() > 1000
    assert not (after & ~before).any()
    assert 0 < after.sum() < before.sum()
    unknown = reason[before & ~after] == "unknown_region"
    assert unknown.all()
    assert set(structure[before & ~after]) == {"beyond_labels"}


def test_a_map_that_does_not_hold_the_target_is_refused(tmp_path):
    with refused("labels_end", "labels.nrrd"):
        verdicts(tmp_path / "cut", vessels()[:, :, 55:], (0, 0, 55))


ORGANS = (
    (52, 0, 24), (54, 24, -30), (-50, 8, 30), (-54, -12, -26), (4, 52, 28), (-18, 54, -12), (8, -52, 6), (14, 6, 58),
)  # fmt: skip
"""Middles of round organs, of 20 mm, in the body of 90 mm; each plane of `BLANKED` cuts two or more."""


def organs():
    """Their labels, axes z, y, x."""
    at = np.arange(100) * STEP_MM - 99.0
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    labels = np.zeros(z.shape, np.uint8)
    for number, middle in enumerate(ORGANS, start=1):
        labels[np.linalg.norm(np.stack([x, y, z], axis=-1) - middle, axis=-1) < 20.0] = number
    return labels


def organ_case(folder, labels, region="other"):
    """A case that avoids them all, by 3 mm."""
    folder.mkdir()
    image = sitk.GetImageFromArray(labels)
    image.SetSpacing([STEP_MM] * 3)
    image.SetOrigin([-99.0] * 3)
    listed = [n for n in range(1, len(ORGANS) + 1) if (labels == n).any()]
    avoided = [structure(f"o{n}", "avoid", {"labelmap": "labels.nrrd", "label": n}, margin_mm=3.0) for n in listed]
    search = "theta_deg = [0, 180]\nstep_deg = 6.0"
    write_case(folder, text=case_text(SKIN, ORGAN, *avoided, search=search, region=region))
    sitk.WriteImage(image, str(folder / "labels.nrrd"))
    return folder / "case.toml"


@pytest.fixture(scope="module")
def of_all_organs(tmp_path_factory):
    found = prepare(organ_case(tmp_path_factory.mktemp("map") / "whole", organs()), arm=False).search()
    assert "beyond_labels" not in found.verdict.structure, "round organs end round"
    return found.safe


BLANKED = [np.s_[:, :, 74:], np.s_[:, :, :26], np.s_[:, 74:], np.s_[66:], np.s_[:32]]


@pytest.mark.parametrize("lost", BLANKED)
def test_what_was_unsafe_is_never_safe_where_zeros_were_laid_over_a_part_of_the_map(tmp_path, of_all_organs, lost):
    """A map of a cropped CT, laid back on the whole grid: its labels end flat, and the body beyond them is unknown."""
    labels = organs()
    labels[lost] = 0
    context = prepare(organ_case(tmp_path / "blanked", labels), arm=False)
    assert any("flat ends in one plane" in said for said in context.anatomy.warnings)
    found = context.search()
    assert not (found.safe & ~of_all_organs).any()
    assert 0 < found.safe.sum() < of_all_organs.sum()
    newly = found.verdict.reason[of_all_organs & ~found.safe]
    assert (newly == "unknown_region").all()


def lay_out(folder, labels, layout):
    """The blanked organs as other files hold them: its own sections, and the skin's, in place of the case's."""

    def write(name, voxels):
        image = sitk.GetImageFromArray(voxels.astype(np.uint8))
        image.SetSpacing([STEP_MM] * 3)
        image.SetOrigin([-99.0] * 3)
        sitk.WriteImage(image, str(folder / name))

    listed = [n for n in range(1, len(ORGANS) + 1) if (labels == n).any()]
    at = np.arange(100) * STEP_MM - 99.0
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    far = structure("far", "avoid", {"labelmap": "far.nrrd", "label": 1}, margin_mm=3.0)
    write("far.nrrd", np.linalg.norm(np.stack([x - 72.0, y, z], axis=-1), axis=-1) < 8.0)
    skin = SKIN
    if layout == "skin of a label":
        skin = structure("skin", "skin", {"labelmap": "body.nrrd", "label": 1})
        write("body.nrrd", np.linalg.norm(np.stack([x, y, z], axis=-1), axis=-1) < 90.0)
    one_file = layout == "a file each"
    for n in listed:
        write(f"o{n}.nrrd", labels == n)
    files = {n: (f"o{n}.nrrd", 1) if one_file else ("labels.nrrd", n) for n in listed}
    avoided = [structure(f"o{n}", "avoid", {"labelmap": f, "label": k}, margin_mm=3.0) for n, (f, k) in files.items()]
    rest = [far] if layout != "skin of a label" else []
    search = "theta_deg = [0, 180]\nstep_deg = 6.0"
    (folder / "case.toml").write_text(case_text(skin, ORGAN, *avoided, *rest, search=search))


@pytest.mark.parametrize("layout", ["a file each", "beside a whole map", "skin of a label"])
def test_organs_that_were_blanked_are_known_however_their_files_are_laid_out(tmp_path, of_all_organs, layout):
    """A label map with one organ shows no cut by itself; a bone's own map, or the body's, goes on beyond it."""
    labels = organs()
    labels[:, :, 74:] = 0
    path = organ_case(tmp_path / "blanked", labels)
    lay_out(path.parent, labels, layout)
    context = prepare(path, arm=False)
    assert any("flat ends in one plane" in said for said in context.anatomy.warnings)
    found = context.search()
    assert not (found.safe & ~of_all_organs).any()
    assert found.safe.any()


def test_a_cut_that_takes_the_tips_of_large_organs_leaves_flat_ends():
    """Small beside the organs' middles."""
    at = np.arange(100) * STEP_MM - 99.0
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    voxels = np.zeros(z.shape, np.uint8)
    for number, middle in enumerate(((20, 0, 50), (24, 40, -30)), start=1):
        voxels[np.linalg.norm(np.stack([x, y, z], axis=-1) - middle, axis=-1) < 36.0] = number
    whole = LabelMap(voxels.transpose(2, 1, 0), np.diag([STEP_MM, STEP_MM, STEP_MM, 1.0]), None, "tips")
    assert not cut_off(label_ends(whole), voxels.shape)[1].any(), "round organs end round"
    kept = whole.labels.copy()
    kept[75:] = 0  # of 78 and 80
    planes, flat = cut_off(label_ends(replace(whole, labels=kept)), voxels.shape)
    assert (planes[1, 0], np.count_nonzero(flat)) == (74.5, 1)


def ends_at(last, flat_mm, *, blocks=False):
    """Labels that end in these slices, flat with these widths."""
    last = np.asarray(last)
    return LabelEnds(last, np.broadcast_to(flat_mm, last.shape).astype(float), np.broadcast_to(blocks, len(last)))


SHAPE = (99, 99, 99)


def test_a_map_that_was_cut_at_one_face_is_cut_where_one_label_alone_ends_flat():
    last = np.array([[[20, 60]] * 3, [[20, 55]] * 3, [[25, 60]] * 3])
    flat_mm = np.zeros((3, 3, 2))
    flat_mm[0, 1, 1] = 12.0  # alone at the high end of axis 1
    assert not cut_off(ends_at(last, flat_mm), SHAPE)[1].any()
    flat_mm[:2, 2, 0] = 12.0  # two at the low end of axis 2
    assert cut_off(ends_at(last, flat_mm), SHAPE)[1].tolist() == [[0, 0, 24], [0, 12, 0]]


def test_blocks_that_somebody_drew_were_not_cut():
    """Boxes with a face in one plane, however large; what a slab was cut from is flat at two sides, and no block."""
    last = np.array([[[10, 40]] * 3, [[10, 60], [20, 30], [10, 40]]])
    slab = 16.0 * np.array([0.0, 0.0, 1.0])[:, None]
    assert not cut_off(ends_at(last, 60.0, blocks=True), SHAPE)[1].any()
    assert cut_off(ends_at(last, slab), SHAPE)[1].tolist() == [[0, 0, 32], [0, 0, 32]]
    last[1, 2] = [15, 35]
    assert not cut_off(ends_at(last, slab), SHAPE)[1].any()


def test_what_is_a_block_is_seen_by_its_sections():
    """What is cut out of a ball, and a box: flat all around; and a ball, which tapers."""
    voxels = np.zeros((80, 80, 80), np.uint8)
    distance = np.linalg.norm(np.moveaxis(np.indices(voxels.shape), 0, -1) - [20.0, 40.0, 40.0], axis=-1)
    cube = np.s_[6:35, 26:55, 26:55]
    voxels[cube] = distance[cube] < 20.0
    voxels[40:70, 4:30, 4:30] = 2
    voxels[np.linalg.norm(np.moveaxis(np.indices(voxels.shape), 0, -1) - [58.0, 58.0, 58.0], axis=-1) < 12.0] = 3
    ends = label_ends(LabelMap(voxels, np.diag([STEP_MM, STEP_MM, STEP_MM, 1.0]), None, "drawn"))
    assert ends.block.tolist() == [False, True, False]
    assert [np.count_nonzero(cut_off(ends.only(np.array([n])), SHAPE)[1]) for n in range(3)] == [6, 0, 0]
    assert ends.flat_mm[0].min() > CUT_MM
    assert ends.flat_mm[1].ravel() == pytest.approx(STEP_MM * np.sqrt([26 * 26, 26 * 26, *[30 * 26] * 4]))
    assert ends.flat_mm[2].max() < CUT_MM / 4


def test_an_organ_that_fills_a_crop_counts_where_another_is_cut_with_it():
    """Of a map about a lesion: the liver is a block, ribs end at one side; then at every side where it was cut."""
    last = np.array([[[20, 60]] * 3, [[20, 35], [25, 40], [25, 45]]])
    flat_mm, block = np.full((2, 3, 2), 55.0), np.array([True, False])
    assert not cut_off(ends_at(last[:1], 55.0, blocks=True), SHAPE)[1].any()  # alone: a block that somebody drew
    flat_mm[1] = [[12.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
    flat = cut_off(ends_at(last, flat_mm, blocks=block), SHAPE)[1]
    assert flat.tolist() == [[67, 55, 55], [55, 55, 55]]


def test_of_many_maps_with_a_label_each_two_may_end_flat_in_one_slice():
    """Where more maps go on beyond it; the last three are one label each, in a plane of their own."""
    pair = [ends_at(np.full((1, 3, 2), 40), [wide_mm, 0.0]) for wide_mm in (17.3, 17.6)]
    other = ends_at([[[20, 60]] * 3], 0.0)
    assert cut_off(pair[0], SHAPE, [pair[1], other])[1][0].all()
    assert not cut_off(pair[0], SHAPE, [pair[1], other, other])[1].any()


def test_labels_that_end_flat_are_not_cut_where_another_label_lies_beyond_or_in_a_phantom(tmp_path, of_all_organs):
    labels = organs()
    labels[:, :, 74:] = 0
    labels[50, 50, 95] = len(ORGANS) + 1  # of anything
    for name, region, lost in (("beyond", "other", []), ("rods", "phantom", np.s_[:, :, 95:])):
        labels[lost] = 0
        context = prepare(organ_case(tmp_path / name, labels, region), arm=False)
        assert "beyond_labels" not in [one.name for one in context.anatomy.structures]


def test_a_target_where_the_labels_were_blanked_is_refused(tmp_path):
    labels = organs()
    labels[:, :, :60] = 0
    with refused("labels_end", "flat ends in one plane"):
        prepare(organ_case(tmp_path / "blanked", labels), arm=False)


@pytest.mark.parametrize(
    ("cut", "beyond"), [("[]", []), ('["left"]', [[82, 0, 0]]), ('["right", "head"]', [[-82, 0, 0], [0, 0, 82]])]
)
def test_the_case_states_where_a_map_was_cut(tmp_path, cut, beyond):
    """At its left, as it seems; a person says that nothing is missing there, or where else labels were lost."""
    labels = organs()
    labels[:, :, 74:] = 0
    path = organ_case(tmp_path / "blanked", labels)
    path.write_text(path.read_text().replace("labelmap =", f"cut = {cut}\nlabelmap ="))
    anatomy = prepare(path, arm=False).anatomy
    sides = json.dumps(sorted(json.loads(cut)))
    assert any(f"label map labels.nrrd: cut = {sides} is stated" in said for said in anatomy.warnings)
    assert not any("flat ends in one plane" in said for said in anatomy.warnings)
    solids = [one.mesh for one in anatomy.structures if one.name == "beyond_labels"]
    assert len(solids) == bool(beyond)
    for solid in solids:
        for at in ([82, 0, 0], [-82, 0, 0], [0, 82, 0], [0, -82, 0], [0, 0, 82], [0, 0, -82]):
            assert (side_of(solid, np.array(at, float)) is Side.INSIDE) == (at in beyond)


def test_stated_sides_are_the_patients_however_a_map_is_stored():
    """Axes permuted and flipped; nearest to the map's own where it is oblique."""
    turn = Rotation.from_euler("xyz", (10, -15, 20), degrees=True).as_matrix()
    for order, signs in (((0, 1, 2), (1, 1, 1)), ((2, 0, 1), (-1, 1, -1)), ((1, 0, 2), (1, -1, 1))):
        T = np.eye(4)
        for axis, (row, sign) in enumerate(zip(order, signs, strict=True)):
            T[:3, axis] = 2.0 * sign * turn[:, row]
        grid = LabelGrid("any", frozenset(), VolumeGrid((5, 6, 7), T, {}), ("left", "feet"))
        faces = stated_cuts(grid)
        assert faces[int(signs[order.index(0)] > 0), order.index(0)]
        assert faces[int(signs[order.index(2)] < 0), order.index(2)]
        assert np.count_nonzero(faces) == 2


def test_one_label_in_two_files_is_one():
    """An organ that the case names twice, from a label map and from a segmentation; another one beside it counts."""
    last = np.array([[[4, 30], [5, 20], [6, 9]], [[9, 25], [7, 22], [6, 40]]])
    flat_mm = np.array([[0.0, 0.0], [0.0, 0.0], [17.0, 0.0]])
    own, other = (ends_at(last[[row]], flat_mm) for row in (0, 1))
    assert not cut_off(own, (50, 50, 50), [own])[1].any()
    assert cut_off(own, (50, 50, 50), [own, other])[1].tolist() == [[0, 0, 34], [0, 0, 0]]


REAL_MAPS = [
    *(REAL_CT / f"labels_{name}.nii.gz" for name in ("v1_normal", "v2_fast")),
    DATA / "slicer_chest_ct4" / "Segmentation.seg.nrrd",
]


@pytest.mark.skipif(not DATA.is_dir(), reason="the real label maps are not on this machine")
@pytest.mark.parametrize("file", REAL_MAPS, ids=lambda file: file.name)
def test_where_real_labels_were_blanked_is_known_and_nowhere_else(file):
    """Behind planes across each axis; and of 2 to all labels of the map, drawn 500 times, as nobody cut them."""
    labels = labelmap_of(read_volume(file))
    whole, known, sides = label_ends(labels), 0, 0
    for axis, end in np.ndindex(3, 2):
        for at in range(whole.last[:, axis, 0].min() + 4, whole.last[:, axis, 1].max() - 3, 8):
            kept = labels.labels.copy()
            kept.swapaxes(0, axis)[slice(at, None) if end else slice(at)] = 0
            ends = label_ends(replace(labels, labels=kept))
            planes, flat = cut_off(ends, kept.shape)
            known, sides = known + (flat[end, axis] > 0 and planes[end, axis] == at - 0.5), sides + 1
    assert known >= 0.97 * sides > 0
    planes, flat = cut_off(whole, labels.labels.shape)
    assert not flat.any()
    last, own = whole.last.transpose(0, 2, 1), np.array([np.zeros(3), labels.labels.shape]) - [[0], [1]]
    assert (whole.flat_mm.transpose(0, 2, 1)[last != own] >= CUT_MM).mean() < 0.005  # a label alone in a file
    rng, called, sides = np.random.default_rng(1), 0, 0
    inside = np.array(labels.labels.shape) - 1.0
    for _ in range(500):
        some = rng.choice(len(whole.last), rng.integers(2, len(whole.last) + 1), replace=False)
        planes, flat = cut_off(whole.only(some), labels.labels.shape)
        within = (planes > 0.0) & (planes < inside)
        called, sides = called + np.count_nonzero(flat[within]), sides + np.count_nonzero(within)
    assert called <= 0.01 * sides
