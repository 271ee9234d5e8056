"""Where a case says that the base stands: axes and unit."""

import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.case.tables import MountSection
from puncture_twin.planning.geometry.spaces import Space


def mount(position, x=(1.0, 0.0, 0.0), z=(0.0, -1.0, 0.0)):
    return MountSection(position_mm=position, x_axis=x, z_axis=z)


def test_a_mount_in_millimetres_is_taken():
    for position in ((600.0, 20.0, -30.0), (0.0, 0.0, 0.0)):
        T_ct_base = np.linalg.inv(mount_pose(mount(position), Space.LPS, "case.toml"))
        assert T_ct_base[:3, 3] == pytest.approx(position)


@pytest.mark.parametrize("position", [(0.6, 0.02, -0.03), (0.0, 0.0, -1.2), (2.0, 0.0, 0.5)])
def test_a_mount_in_metres_is_noticed(position):
    with refused("wrong_unit"):
        mount_pose(mount(position), Space.LPS, "case.toml")


def test_axes_that_are_not_square_are_refused():
    with refused("axes_not_square", "60.0"):
        mount_pose(mount((600.0, 0.0, 0.0), z=(0.5, 0.75**0.5, 0.0)), Space.LPS, "case.toml")
