"""Long bones beside the trunk: found where an arm is pressed against it, and nowhere in a patient without one."""

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from places import REAL_CT

from puncture_twin.planning.anatomy.body.body_mask import body_mask
from puncture_twin.planning.anatomy.body.limb_bones import limb_bones

CT = REAL_CT / "ct.nii.gz"
SPACING = np.array([4.0, 4.0, 5.0])
X, Y, Z = np.indices((90, 60, 24)) * SPACING.reshape(3, 1, 1, 1)
TRUNK = np.hypot((X - 200.0) / 140.0, (Y - 120.0) / 90.0) < 1.0


def scene(x, slope=0.0):
    """A trunk with a spine, and an arm at its right side whose bone, a tube, lies at x, mm."""
    off = np.hypot(X - x, Y - 120.0 - slope * (Z - 60.0))
    arm = off < 32.0
    hu = np.where(TRUNK | arm, 20.0, -1000.0)
    hu[np.hypot(X - 200.0, Y - 160.0) < 20.0] = 400.0
    hu[(off < 10.0) & (off > 4.0)] = 800.0
    return hu.astype(np.float32), TRUNK | arm


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_the_bone_of_an_arm_beside_the_trunk_is_found(slope):
    """Its middle to half a voxel, and how far the air is away; not the spine."""
    (bone,) = limb_bones(*scene(40.0, slope), SPACING)
    assert np.abs(bone.middle[:, 0] * 4.0 - 40.0).max() < 2.0
    assert 26.0 < bone.radius_mm < 40.0


def test_a_bone_in_the_middle_of_the_trunk_is_no_limb():
    """Deep in the body, and with nothing but trunk about it."""
    assert limb_bones(*scene(150.0), SPACING) == []


@pytest.mark.skipif(not CT.is_file(), reason="the real CT (totalseg_abdomen_3mm) is not on this machine")
def test_ribs_pelvis_and_spine_of_a_real_patient_are_no_limbs():
    """Arms up: no false alarm."""
    image = sitk.ReadImage(str(CT))
    hu = sitk.GetArrayFromImage(image).transpose(2, 1, 0).astype(np.float32)
    spacing = np.array(image.GetSpacing())
    assert limb_bones(hu, body_mask(hu, spacing, where=CT).body, spacing) == []
