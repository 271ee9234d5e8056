"""Bones with air on many sides: of an arm across the belly, and none of a trunk or head."""

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from places import REAL_CT

from puncture_twin.planning.anatomy.body.attached_limbs import attached_limbs
from puncture_twin.planning.anatomy.body.body_mask import body_mask
from puncture_twin.planning.anatomy.body.exposed_bones import exposed_bones

CT = REAL_CT / "ct.nii.gz"
SPACING = np.array([4.0, 4.0, 5.0])
SHAPE = (80, 70, 36)
POINTS = np.moveaxis(np.indices(SHAPE), 0, -1) * SPACING
TRUNK = np.hypot((POINTS[..., 0] - 160.0) / 130.0, (POINTS[..., 1] - 165.0) / 90.0) < 1.0
SPINE = np.hypot(POINTS[..., 0] - 160.0, POINTS[..., 1] - 215.0) < 19.0
TARGET = np.array([160.0, 160.0, 90.0]) / SPACING


def about(start, end):
    """Distance of every voxel from a line."""
    a, b = np.array(start), np.array(end)
    t = np.clip((POINTS - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(POINTS - a - t[..., None] * (b - a), axis=-1)


def image(*lines, radius=28.0, bone=8.0, air=()):
    """A trunk with a spine, and limbs along lines."""
    body, bones = TRUNK.copy(), SPINE.copy()
    for start, end in lines:
        off = about(start, end)
        body |= off < radius
        bones |= off < bone
    hu = np.where(body, 30.0, -1000.0)
    hu[bones] = 600.0
    return hu.astype(np.float32), body


ACROSS = ((70.0, 65.0, 60.0), (250.0, 65.0, 120.0))
ALONG = ((120.0, 65.0, 10.0), (170.0, 60.0, 170.0))


@pytest.mark.parametrize("line", [ACROSS, ALONG], ids=["across", "along"])
@pytest.mark.parametrize(("radius", "bone"), [(28.0, 8.0), (20.0, 5.0)], ids=["thick", "thin"])
def test_an_arm_upon_the_belly_is_found_and_holds_its_soft_tissue(line, radius, bone):
    """Nine tenths of it; the spine's surroundings and the middle of the trunk are not part of it."""
    hu, body = image(line, radius=radius, bone=bone)
    limbs = attached_limbs(hu, body, SPACING, TARGET)
    arm = (about(*line) < radius) & ~TRUNK
    assert limbs[arm].mean() > 0.9
    assert not limbs[SPINE].any()
    assert limbs[TRUNK].mean() < 0.3


def test_an_elbow_is_one_limb():
    """Bones that meet at an angle, with a gap between them."""
    lower, upper = ((70.0, 66.0, 60.0), (215.0, 66.0, 70.0)), ((236.0, 66.0, 76.0), (250.0, 75.0, 170.0))
    hu, body = image(lower, upper, bone=7.0)
    (limb,) = exposed_bones(hu > 200.0, body, SPACING)
    reach = np.ptp(limb.voxels, axis=0) * SPACING
    assert reach[0] > 130.0
    assert reach[2] > 70.0


def test_an_arm_that_holds_the_target_is_not_forbidden():
    """It is then the arm that is to be punctured."""
    hu, body = image(ACROSS)
    middle = (np.array(ACROSS[0]) + ACROSS[1]) / 2.0 / SPACING
    assert not attached_limbs(hu, body, SPACING, middle).any()


def test_a_limb_alone_is_no_limb_of_a_trunk():
    """An image of an arm only: its bone is as deep as half of the body is thick."""
    off = about(*ACROSS)
    assert exposed_bones(off < 8.0, off < 35.0, SPACING) == []


def test_a_rib_a_speck_and_no_bone_are_none():
    """A rib follows the skin; a piece of metal on the skin is small."""
    ring = np.abs(np.hypot((POINTS[..., 0] - 160.0) / 112.0, (POINTS[..., 1] - 165.0) / 72.0) - 1.0) < 0.05
    rib = ring & (np.abs(POINTS[..., 2] - 90.0 + 0.3 * (POINTS[..., 1] - 165.0)) < 6.0)
    assert rib.sum() > 100
    assert exposed_bones(rib | SPINE, TRUNK, SPACING) == []
    assert exposed_bones(np.zeros_like(TRUNK), TRUNK, SPACING) == []
    short = about((150.0, 68.0, 90.0), (170.0, 68.0, 90.0))
    assert exposed_bones(short < 6.0, TRUNK | (short < 16.0), SPACING) == []


@pytest.mark.skipif(not CT.is_file(), reason="the real CT (totalseg_abdomen_3mm) is not on this machine")
@pytest.mark.parametrize("part", [slice(None), slice(0, 50), slice(30, 70), slice(60, None)])
def test_no_bone_of_a_real_trunk_is_exposed(part):
    """Ribs, pelvis and spine, in the whole image and in parts of it."""
    scan = sitk.ReadImage(str(CT))
    hu = sitk.GetArrayFromImage(scan).transpose(2, 1, 0).astype(np.float32)[:, :, part]
    spacing = np.array(scan.GetSpacing())
    body = body_mask(hu, spacing, where=CT).body
    assert exposed_bones(body & (hu > 200.0), body, spacing) == []
