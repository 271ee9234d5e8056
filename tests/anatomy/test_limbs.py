"""Limbs pressed against a trunk: found by neck and by air about their bones; none in a trunk or head."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from places import DATA, REAL_CT

from puncture_twin.planning.anatomy.anatomy import ball
from puncture_twin.planning.anatomy.body.body_mask import BONE_HU, CtImage, ct_image
from puncture_twin.planning.anatomy.body.limbs import limb_search
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.geometry.rigid import pose

CT = REAL_CT / "ct.nii.gz"
CHEST = DATA / "slicer_chest_ct4" / "CTChest4.nrrd"
SPACING = np.array([4.0, 4.0, 5.0])
SHAPE = (80, 70, 36)
POINTS = np.moveaxis(np.indices(SHAPE), 0, -1) * SPACING
TRUNK = np.hypot((POINTS[..., 0] - 160.0) / 130.0, (POINTS[..., 1] - 165.0) / 90.0) < 1.0
SPINE = np.hypot(POINTS[..., 0] - 160.0, POINTS[..., 1] - 215.0) < 19.0
TARGET = np.array([160.0, 160.0, 90.0])
ACROSS = ((70.0, 65.0, 60.0), (250.0, 65.0, 120.0))
ALONG = ((120.0, 65.0, 10.0), (170.0, 60.0, 170.0))


def about(start, end):
    a, b = np.array(start), np.array(end)
    t = np.clip((POINTS - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(POINTS - a - t[..., None] * (b - a), axis=-1)


def image(*lines, radius=28.0, bone=8.0, trunk=TRUNK):
    body, bones = trunk.copy(), SPINE & trunk
    for start, end in lines:
        off = about(start, end)
        body |= off < radius
        bones |= off < bone
    hu = np.where(body, 30.0, -1000.0)
    hu[bones] = 600.0
    return hu.astype(np.float32), body


def search(hu, body, structures=()):
    """What may be a limb in an image from its first voxel on."""
    T = np.diag([*SPACING, 1.0])
    return limb_search(CtImage(hu, T, Path("ct.nii.gz")), body, structures)


def named(name, mesh):
    return Structure(name, Role.AVOID, 0.0, mesh, "")


def limbs_of(hu, body, target=TARGET, structures=()):
    found = search(hu, body, structures)
    return found.limbs(found.chosen(target))


@pytest.mark.parametrize("line", [ACROSS, ALONG], ids=["across", "along"])
@pytest.mark.parametrize(("radius", "bone"), [(28.0, 8.0), (20.0, 5.0)], ids=["thick", "thin"])
def test_an_arm_upon_the_belly_is_found_and_holds_its_soft_tissue(line, radius, bone):
    """Nine tenths of it; the spine's surroundings and the middle of the trunk are not part of it."""
    limbs = limbs_of(*image(line, radius=radius, bone=bone))
    arm = (about(*line) < radius) & ~TRUNK
    assert limbs[arm].mean() > 0.9
    assert not limbs[SPINE].any()
    assert limbs[TRUNK].mean() < 0.3


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_the_bone_of_an_arm_beside_the_trunk_is_found(slope):
    """A tube along the bed, pressed in by more than half of the arm; the spine is none."""
    line = (36.0, 165.0 - 90.0 * slope, 0.0), (36.0, 165.0 + 90.0 * slope, 180.0)
    hu, body = image(line, radius=32.0, bone=10.0)
    hu[about(*line) < 4.0] = 30.0
    assert limbs_of(hu, body)[(about(*line) < 32.0) & ~TRUNK].mean() > 0.9


@pytest.mark.parametrize("line", [ACROSS, ((36.0, 165.0, 0.0), (36.0, 165.0, 180.0))])
def test_a_bone_that_a_structure_names_is_no_evidence(line):
    """Unless its name is an arm's; and a label of all that is soft explains no bone in it."""
    (hu, body), axis = image(line), np.subtract(*line[::-1])
    along = np.outer(axis, axis) / (axis @ axis)
    stretch = 12.0 * (np.eye(3) - along) + 0.6 * np.linalg.norm(axis) * along
    bone = ball(np.zeros(3), 1.0).transformed(pose(stretch, np.mean(line, axis=0)))
    assert not limbs_of(hu, body, structures=[named("rib_left_7", bone)]).any()
    assert limbs_of(hu, body, structures=[named("tissue", ball(TARGET, 400.0))]).any()
    for name in ("humerus_left", "bone", "Skeleton", "Segment_1", "LeftArmBones", "Elle"):  # may be, or hold, an arm's
        assert limbs_of(hu, body, structures=[named(name, bone)]).any(), name


def test_a_thigh_pressed_against_the_one_that_holds_the_target_is_found_though_its_bone_is_named():
    """Two thighs of 75 mm side by side: beyond a neck no bone is asked for."""
    right, left = (np.hypot(POINTS[..., 0] - x, POINTS[..., 1] - 140.0) < 75.0 for x in (87.0, 233.0))
    hu, body = image(trunk=left | right)
    hu[body & (hu > 200.0)], hu[about((87.0, 140.0, 0.0), (87.0, 140.0, 180.0)) < 14.0] = 30.0, 600.0
    femur = ball(np.zeros(3), 1.0).transformed(pose(np.diag([14.0, 14.0, 120.0]), [87.0, 140.0, 90.0]))
    found = limbs_of(hu, body, np.array([200.0, 140.0, 90.0]), [named("femur_right", femur)])
    assert found[right & ~left].mean() > 0.98


def test_one_search_serves_every_target_as_one_of_its_own_does():
    """Targets in the trunk, near the arm, in it, in a piece that lies apart and in the air, in either order.

    Of a target near the arm only what is nearer to the bone than the air is the arm's; an arm that holds the target is
    the one that is to be punctured.
    """
    hu, body = image(ACROSS)
    apart = np.hypot(POINTS[..., 0] - 12.0, POINTS[..., 2] - 20.0) < 12.0
    hu[apart], body = 30.0, body | apart
    targets = [TARGET, [160.0, 108.0, 90.0], np.mean(ACROSS, axis=0), [12.0, 100.0, 20.0], [310.0, 10.0, 90.0]]
    shared, alone = search(hu, body), [limbs_of(hu, body, np.array(target)) for target in targets]
    assert alone[0].sum() > alone[1].sum() > 0
    assert not alone[1][tuple(np.rint(targets[1] / SPACING).astype(int))]
    assert not alone[2].any()
    for target, expected in [*zip(targets, alone, strict=True)][::-1] * 2:
        np.testing.assert_array_equal(shared.limbs(shared.chosen(np.array(target))), expected)


def test_a_limb_alone_is_no_limb_of_a_trunk():
    """An image of an arm only: its bone is as deep as half of the body is thick."""
    hu, body = image(ACROSS, radius=35.0, trunk=np.zeros(SHAPE, bool))
    assert not limbs_of(hu, body, np.array([160.0, 85.0, 90.0])).any()


def test_of_two_large_parts_neither_is_a_limb():
    """Two trunks of more than 9 l that touch at a neck, each with bone: no limb is as large."""
    trunk = np.abs(POINTS[..., 0] - 160.0) > 12.0
    trunk |= np.hypot(POINTS[..., 1] - 140.0, POINTS[..., 2] - 90.0) < 20.0
    trunk &= (POINTS[..., 1] > 20.0) & (POINTS[..., 1] < 260.0)
    hu, body = image(((60.0, 140.0, 20.0), (60.0, 140.0, 160.0)), trunk=trunk)
    wide = np.repeat(hu, 4, axis=0), np.repeat(body, 4, axis=0)
    target = np.array([4.0 * 260.0, 140.0, 90.0])
    assert not limbs_of(*wide, target).any()
    assert limbs_of(hu, body, np.array([260.0, 140.0, 90.0])).any()


def test_a_rib_a_speck_and_no_bone_are_none():
    """A rib follows the skin; a piece of metal on the skin is small; a bone deep in the trunk is its own."""
    ring = np.abs(np.hypot((POINTS[..., 0] - 160.0) / 112.0, (POINTS[..., 1] - 165.0) / 72.0) - 1.0) < 0.05
    rib = ring & (np.abs(POINTS[..., 2] - 90.0 + 0.3 * (POINTS[..., 1] - 165.0)) < 6.0)
    assert rib.sum() > 100
    hu, body = image()
    hu[rib] = 600.0
    hu[np.hypot(POINTS[..., 0] - 140.0, POINTS[..., 1] - 165.0) < 10.0] = 800.0
    assert not limbs_of(hu, body).any()
    short = about((150.0, 68.0, 90.0), (170.0, 68.0, 90.0))
    hu, body = image()
    hu[short < 16.0], hu[short < 6.0] = 30.0, 600.0
    assert not limbs_of(hu, body | (short < 16.0)).any()
    assert not limbs_of(np.where(body, 30.0, -1000.0).astype(np.float32), body).any()


@pytest.mark.skipif(not CT.is_file(), reason="the real CT (totalseg_abdomen_3mm) is not on this machine")
@pytest.mark.parametrize("part", [slice(None), slice(0, 50), slice(30, 70), slice(60, None)])
def test_no_bone_of_a_real_abdomen_is_a_limbs(part):
    """Ribs, pelvis and spine without a label, in the whole image and in parts of it."""
    scan = sitk.ReadImage(str(CT))
    hu = sitk.GetArrayFromImage(scan).transpose(2, 1, 0).astype(np.float32)[:, :, part]
    ct = CtImage(hu, np.diag([*scan.GetSpacing(), 1.0]), CT)
    found = limb_search(ct, ct.found.body, ())
    assert (ct.hu[ct.found.body] > BONE_HU).sum() > 100
    assert not found.limbs(found.chosen(np.array(hu.shape) * scan.GetSpacing() / 2.0)).any()


@pytest.mark.skipif(not CHEST.is_file(), reason="the real chest (slicer_chest_ct4) is not on this machine")
def test_no_bone_of_a_real_chest_is_a_limbs():
    """Shoulder blades, collar bones and ribs without a label, arms raised, slices of 10 mm."""
    ct = ct_image(read_volume(CHEST))
    found = limb_search(ct, ct.found.body, ())
    assert (ct.hu[ct.found.body] > BONE_HU).sum() > 1000
    assert not found.limbs(found.chosen(np.array([-85.5, 8.2, -138.1]))).any()
