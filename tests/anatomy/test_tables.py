"""Which sides of a body in a CT count as those of a table that touches it, and which side shows what it lies on."""

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from places import REAL_CT

from puncture_twin.planning.anatomy.body.body_mask import BODY_HU, CtImage, body_mask
from puncture_twin.planning.anatomy.body.tables import (
    Shown,
    drawn_sides,
    find_support,
    support_warnings,
    surface_ends,
    touching_tables,
)
from puncture_twin.planning.anatomy.scan import OutsideImage, outside_mask
from puncture_twin.planning.geometry.parts import largest_part

CT = REAL_CT / "ct.nii.gz"
SPACING = np.array([4.0, 4.0, 5.0])
SHAPE = (100, 80, 32)
X, Y, Z = np.indices(SHAPE) * SPACING.reshape(3, 1, 1, 1)
"""mm from the first voxel."""


def trunk(wave_mm=8.0, lean=0.0):
    """A trunk of 280 x 180 mm whose section changes along the bed by waves, Hounsfield units above the threshold."""
    radius = np.hypot((X - 198.0) / 140.0, (Y - lean * (Z - 80.0) - 150.0) / 90.0)
    return 500.0 * np.clip((1.0 - radius) * 90.0 + wave_mm * np.sin(Z / 14.0), -4.0, 4.0) / 4.0


def cradle(radius_mm=250.0, thick_mm=24.0, half_mm=150.0, slope=(0.0, 0.0)):
    """A shell below the trunk, drawn along a bed that runs at slopes to the slices' axis."""
    x, y = X - 198.0 - slope[0] * (Z - 80.0), Y - slope[1] * (Z - 80.0) - (232.0 - radius_mm)
    shell = thick_mm / 2.0 - np.abs(np.hypot(x, y) - radius_mm - thick_mm / 2.0)
    return 500.0 * np.clip(np.minimum.reduce([shell, half_mm - np.abs(x), y]), -4.0, 4.0) / 4.0


def noisy(field, hu=20.0):
    return field + np.random.default_rng(5).normal(0.0, hu, SHAPE)


def drawn(field, body, spacing=SPACING):
    return drawn_sides(surface_ends(field, body), body, spacing)


def test_a_body_in_air_and_a_short_image_have_no_drawn_side():
    """What changes along the bed is no table; over 40 mm every body is nearly one section."""
    assert drawn(noisy(trunk()), trunk() > 0.0) == ()
    scene = np.maximum(trunk(), cradle())[:, :, :8]
    assert drawn(scene, scene > 0.0) == ()


@pytest.mark.parametrize(
    ("slope", "lean"),
    [((0.0, 0.0), 0.0), ((0.03, 0.0), 0.0), ((0.0, 0.06), 0.0), ((-0.02, 0.05), 0.0), ((0.0, 0.36), 0.36)],
)
def test_a_cradle_that_holds_together_with_the_body_is_drawn(slope, lean):
    """Its far side is found to a part of a voxel, at any angle between bed and slices, as after a tilted gantry."""
    scene = np.maximum(trunk(lean=lean), cradle(slope=slope))
    (back,) = drawn(noisy(scene), scene > 0.0)
    across_mm = np.arange(100.0)[:, None] * 4.0 - 198.0 - slope[0] * (np.arange(32) * 5.0 - 80.0)
    truth = 232.0 - 250.0 + np.sqrt(274.0**2 - across_mm**2) + slope[1] * (np.arange(32) * 5.0 - 80.0)
    flat = np.abs(across_mm) < 110.0
    assert back.face == (1, -1)
    assert np.abs(back.line * 4.0 - truth)[flat].max() < 2.5
    beyond = np.argwhere(back.beyond(SHAPE) & flat[:, None])
    assert np.all(beyond[:, 1] * 4.0 > truth[beyond[:, 0], beyond[:, 2]] - 2.5)


@pytest.mark.parametrize(("bulge_mm", "edge_mm"), [(0.0, 30.0), (0.9, 0.0)])
def test_a_back_that_is_nearly_one_section_has_no_table_s_edge(bulge_mm, edge_mm):
    """Nothing behind it is free; beside a table its edge is not free either, beside a back that bulges the flank is."""
    bulge = bulge_mm * np.sin((Z - 78.0) / 25.0) * np.cos((X - 198.0) / 30.0)
    support = cradle(radius_mm=150.0, thick_mm=60.0, half_mm=110.0) + 125.0 * bulge
    scene = np.maximum(np.where(Y < 150.0, trunk(), -500.0), support)
    (back,) = drawn(noisy(scene, 5.0), scene > 0.0)
    last = np.flatnonzero(back.lines)[-1]
    assert back.line[last, 16] - back.line[last + 8, 16] == pytest.approx(edge_mm / 4.0, abs=2.5)


@pytest.mark.parametrize(("last", "slope"), [(19, (0.0, 0.0)), (24, (0.0, 0.05)), (13, (0.0, 0.0))])
def test_a_cradle_that_ends_in_the_image_is_drawn_as_far_as_it_goes(last, slope):
    """However it is bent; nothing of what lies above its far side is beyond it."""
    shell = np.where(np.arange(32) <= last, cradle(slope=slope), -500.0)
    scene = noisy(np.maximum(trunk(), shell))
    (back,) = drawn(scene, scene > 0.0)
    across_mm = np.abs(np.arange(100) * 4.0 - 198.0)
    truth = 232.0 - 250.0 + np.sqrt(274.0**2 - across_mm[:, None] ** 2) + slope[1] * (np.arange(32) * 5.0 - 80.0)
    seen = np.ix_(across_mm < 110.0, np.arange(32) <= last)
    assert back.face == (1, -1)
    assert np.abs(back.line * 4.0 - truth)[seen].max() < 2.5


@pytest.mark.parametrize(
    ("stated", "in_shell", "sides"), [(None, False, []), (None, True, [(1, 0)]), ("present", True, [])]
)
def test_a_table_that_only_a_head_touches_is_cut_off_and_may_be_all_that_the_body_lies_on(stated, in_shell, sides):
    """Its thickness is seen below the body too; a shell in front counts beside it, unless a person states one table."""
    head_mm = np.minimum.reduce([60.0 - np.abs(X - 198.0), Y - 150.0, 20.0 - Z])
    shell_mm = np.minimum.reduce([Y - 50.0, 150.0 - Y, 140.0 - np.abs(X - 198.0)])
    table_mm = np.minimum(Y - 258.0, 282.0 - Y)
    solids_mm = [np.minimum(head_mm, 270.0 - Y), table_mm, *([shell_mm] if in_shell else [])]
    scene = np.maximum(trunk(), 125.0 * np.clip(np.maximum.reduce(solids_mm), -4.0, 4.0))
    found = touching_tables(noisy(scene), largest_part(scene > 0.0), SPACING, Shown(table=stated))
    assert (found.cut_off != (table_mm > 0.0)).mean() < 0.01
    assert [side.face for side in found.sides] == sides


@pytest.mark.parametrize("phantom", [False, True])
def test_a_table_apart_from_a_body_of_one_section_is_not_stated(phantom):
    """No side is one without the key; with it all four are, since one of them may be, and each says to leave it out."""
    inside = np.minimum(140.0 - np.abs(X - 198.0), 90.0 - np.abs(Y - 130.0)) > 0.0
    scene = noisy(np.where(inside | ((Y > 250.0) & (Y < 280.0)), 500.0, -500.0))
    stated, left_out = (touching_tables(scene, inside, SPACING, Shown(phantom, table=one)) for one in ("present", None))
    assert left_out.sides == () and not left_out.cut_off.any() and len(left_out.warnings) == (not phantom)
    assert len(stated.sides) == len(stated.warnings) == 4
    assert all("leave the key out if none does" in said for said in stated.warnings)


def test_the_top_of_a_table_beside_the_body_is_no_support():
    """Seen from the front a table's top lies behind the body's middle; the side it is on is the back."""
    inside = trunk() > 0.0
    table = (Y > 250.0) & (Y < 275.0) & (X > 20.0) & (X < 380.0)
    (side,) = find_support(table & ~inside, inside, SPACING).drawn
    assert side.face == (1, -1)


@pytest.mark.parametrize(("rows", "faces"), [(slice(8, 68), ((1, 0), (1, -1))), (slice(8, None), ((1, 0),))])
def test_faces_near_a_body_that_nothing_supports_are_open(rows, faces):
    """Within 60 mm of the body nothing is known beyond a face that does not cut it, and one sentence names it."""
    inside = (trunk() > 0.0)[:, rows]
    nothing = np.zeros_like(inside)
    support = find_support(nothing, inside, SPACING)
    assert not support.seen
    assert set(support.open_faces) - {(0, 0), (0, -1)} == set(faces)
    (said,) = support_warnings(support.seen, support.open_faces)
    assert 'table = "none"' in said
    assert find_support(nothing, inside, SPACING, shown=Shown(table="none")).open_faces == ()


def test_the_arms_of_a_body_that_ends_in_the_image_lie_there_too():
    """A ball in air, nothing below it: front and back are unknown, for it lies on something; its sides are air."""
    inside = (X - 198.0) ** 2 + (Y - 140.0) ** 2 + (Z - 78.0) ** 2 < 60.0**2
    assert not inside[:, :, [0, -1]].any()
    near = inside[25:75, 8:60]
    for body, faces in ((near, {(1, 0), (1, -1)}), (near[:, :, 15:], {(0, 0), (0, -1), (1, 0), (1, -1)})):
        assert set(find_support(np.zeros_like(body), body, SPACING).open_faces) == faces


def test_a_support_that_ends_in_the_image_leaves_the_faces_free():
    """Table seen, ending before the faces at its sides: they count as air. Cut by them, they do not."""
    inside = trunk() > 0.0
    for low, expected in ((20.0, ()), (-1.0, ((0, 0), (0, -1)))):
        table = (Y > 250.0) & (Y < 275.0) & (np.abs(X - 198.0) < 198.0 - low)
        support = find_support(table & ~inside, inside, SPACING)
        assert support.seen
        assert support.open_faces == expected


@pytest.mark.skipif(not CT.is_file(), reason="the real CT (totalseg_abdomen_3mm) is not on this machine")
@pytest.mark.parametrize(
    "slices", [slice(None), slice(0, 33), slice(16, 49), slice(40, 73), slice(79, 112), slice(60, 80)]
)
def test_of_a_real_patient_only_the_back_lies_on_something(slices):
    """Of the whole abdomen and of 60 to 100 mm of it: front and flanks are no table's, and what it lies on is seen."""
    image = sitk.ReadImage(str(CT))
    hu = sitk.GetArrayFromImage(image).transpose(2, 1, 0).astype(np.float32)[:, :, slices]
    directions = np.array(image.GetDirection()).reshape(3, 3)
    hu = hu[tuple(slice(None, None, int(step)) for step in np.sign(np.diag(directions)))]
    spacing = np.array(image.GetSpacing())
    found = body_mask(hu, spacing, where=CT)
    sides = drawn(hu - BODY_HU, found.body, spacing)
    outside = outside_mask(OutsideImage(hu, found.body, found.unscanned, np.eye(4), spacing), -900.0)
    support = find_support(outside, found.body, spacing, sides)

    assert {side.face for side in sides} <= {(1, -1)}
    assert support.drawn[0].face == (1, -1)
    assert (1, 0) not in support.open_faces


def block(kind):
    """A phantom that ends within the image, and one as long as the image, Hounsfield units above the threshold."""
    round_mm = 80.0 - np.hypot(X - 198.0, Y - 150.0)
    edges_mm = np.minimum(90.0 - np.abs(X - 198.0), 70.0 - np.abs(Y - 150.0))
    half_mm = np.minimum(110.0 - np.hypot(X - 198.0, Y - 200.0), 200.0 - Y)
    inside_mm = {"cylinder": round_mm, "box": edges_mm, "half cylinder": half_mm}[kind]
    return 500.0 * np.clip(inside_mm, -4.0, 4.0) / 4.0


BOTTOM_MM = {"cylinder": 230.0, "box": 220.0, "half cylinder": 200.0}
SHORT = np.abs(Z - 78.0) < 60.0


@pytest.mark.parametrize("kind", BOTTOM_MM)
@pytest.mark.parametrize("short", [False, True], ids=["long", "ends in the image"])
def test_a_table_that_touches_a_phantom_is_cut_off_and_the_phantom_is_whole(kind, short):
    """To a voxel; no other side of it is a table, and in air none is."""
    phantom = np.where(SHORT | (not short), block(kind), -500.0)
    table_mm = np.minimum(12.0 - np.abs(Y - BOTTOM_MM[kind] - 12.0), 150.0 - np.abs(X - 198.0))
    scene = noisy(np.maximum(phantom, 500.0 * np.clip(table_mm, -4.0, 4.0) / 4.0))
    found = touching_tables(scene, scene > 0.0, SPACING, Shown(phantom=True))
    left = largest_part((scene > 0.0) & ~found.cut_off)
    wrong = left ^ (noisy(phantom) > 0.0)
    assert found.sides == ()
    assert wrong.sum() <= 0.02 * left.sum()
    assert wrong[:, : int(BOTTOM_MM[kind] / SPACING[1]) - 1].sum() <= 3  # single voxels of noise

    alone = touching_tables(noisy(phantom), phantom > 0.0, SPACING, Shown(phantom=True))
    assert not alone.cut_off.any()
    assert alone.sides == ()


@pytest.mark.parametrize("kind", ["cylinder", "box"])
def test_a_body_with_one_section_at_all_four_sides_is_no_table(kind):
    """Also where nobody says that it is a phantom; where a person says that it lies on one, nothing there is free."""
    scene = noisy(block(kind))
    found = touching_tables(scene, scene > 0.0, SPACING)
    assert found.sides == ()
    assert "phantom" in found.warnings[0]
    stated = touching_tables(scene, scene > 0.0, SPACING, Shown(table="present"))
    assert (1, -1) in {side.face for side in stated.sides}


def test_a_prism_on_a_table_beside_which_it_ends_is_no_table():
    """Seen from the front the table's top beside it is no end of its own; its front is drawn as its flanks are."""
    phantom = np.where(SHORT, block("cylinder"), -500.0)
    table_mm = np.minimum(12.0 - np.abs(Y - 242.0), 190.0 - np.abs(X - 198.0))
    scene = noisy(np.maximum(phantom, 500.0 * np.clip(table_mm, -4.0, 4.0) / 4.0))
    found = touching_tables(scene, scene > 0.0, SPACING, Shown(arms="none"))
    assert found.cut_off[table_mm > 4.0].mean() > 0.8
    assert found.sides == ()


def test_arms_that_are_said_to_be_in_the_image_leave_the_faces_beside_them_free():
    inside = (trunk() > 0.0)[5:95]
    table = (Y[5:95] > 250.0) & (Y[5:95] < 275.0)
    assert find_support(table & ~inside, inside, SPACING).open_faces == ((0, 0), (0, -1))
    assert find_support(table & ~inside, inside, SPACING, shown=Shown(arms="present")).open_faces == ()
    nothing = np.zeros_like(inside)
    cut = find_support(nothing[20:], inside[20:], SPACING, shown=Shown(arms="present", table="present"))
    assert (0, 0) in cut.open_faces and (0, -1) not in cut.open_faces


def test_of_two_phantoms_the_one_about_the_target_is_the_body():
    """Though it is the smaller one; where none holds it, the larger is."""
    small, large = (np.hypot(X - x, Y - 150.0) < radius for x, radius in ((80.0, 50.0), (270.0, 90.0)))
    hu = noisy(np.where((small | large) & SHORT, 40.0, -1000.0)).astype(np.float32)
    for about, body in (((80.0, 150.0, 80.0), small), ((350.0, 20.0, 80.0), large), (None, large)):
        image = CtImage(hu, np.diag([*SPACING, 1.0]), CT, Shown(phantom=True, whole=True, about=about))
        assert (image.found.body != (body & SHORT)).mean() < 0.001


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.0, 0.06)])
def test_of_a_body_on_a_cradle_that_is_wider_the_cradle_is_cut_off(slope):
    """All of what lies behind the body's back; of the body no more than a few millimetres."""
    body = np.where(np.abs(X - 198.0) < 110.0, trunk(), -500.0)
    scene = np.maximum(body, cradle(slope=slope))
    found = touching_tables(noisy(scene), scene > 0.0, SPACING)
    beyond = (cradle(slope=slope) > 0.0) & (body < 0.0)
    assert found.cut_off[beyond].mean() > 0.85
    assert found.cut_off[(body > 0.0) & (Y < 200.0)].sum() == 0
    assert found.warnings


def test_a_shell_in_front_counts_beside_a_table_that_was_cut_off():
    """A board that is wider than the trunk is cut off; the shell that lies upon the belly is still no skin."""
    x, y = np.abs(X - 198.0), Y - 150.0
    board = np.minimum.reduce([190.0 - x, Y - 232.0, 256.0 - Y])
    outer, inner = np.hypot(x / 165.0, y / 112.0), np.hypot(x / 140.0, y / 86.0)
    shell = np.minimum.reduce([(1.0 - outer) * 112.0, (inner - 1.0) * 86.0, -y - 40.0])
    scene = np.maximum.reduce([trunk(), *(125.0 * np.clip(one, -4.0, 4.0) for one in (board, shell))])
    found = touching_tables(noisy(scene), scene > 0.0, SPACING)
    assert found.cut_off[(board > 4.0) & (x > 150.0)].mean() > 0.85
    assert (1, 0) in {side.face for side in found.sides}
    assert (1, -1) not in {side.face for side in found.sides}


@pytest.mark.parametrize(
    ("core_hu", "cover_hu", "bone_hu"), [(20, 20, 20), (-120, 400, -120), (20, 20, 600), (120, 120, 120)]
)
def test_a_board_of_one_section_is_a_limb_only_with_a_bone_within(core_hu, cover_hu, bone_hu):
    """A gel mat in noise, and foam in a hard cover, hold voxels as dense as bone; a limb holds a bone."""
    off, height = np.abs(X - 198.0), np.abs(Y - 283.0)
    scene, board = np.where(trunk() > 0.0, 20.0, -1000.0), (height < 21.0) & (off < 190.0)
    scene[board] = cover_hu
    scene[(height < 18.0) & (off < 187.0)] = core_hu
    scene[np.hypot(off, height) < 9.0] = bone_hu
    found = body_mask(noisy(scene, 60.0).astype(np.float32), SPACING, where="ct", shown=Shown(table="none"))
    assert found.body[board].any() == (bone_hu == 600)
    assert found.body[trunk() > 0.0].mean() > 0.98
