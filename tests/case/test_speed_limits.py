"""Where a case says that the base stands, and how fast it lets plans move: keys, defaults, and what is refused."""

import shutil

import numpy as np
import pytest
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS, SpeedLimits
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.case.tables import MountSection
from puncture_twin.planning.geometry.spaces import Space


@pytest.fixture
def carton(tmp_path):
    shutil.copytree(folder() / "carton", tmp_path, dirs_exist_ok=True)
    path = tmp_path / "case_m.toml"
    text = path.read_text(encoding="utf-8")

    def read(*lines):
        path.write_text(text.replace("[robot]\n", "\n".join(["[robot]", *lines, ""])), encoding="utf-8")
        return load_case(path)

    return read


def test_speeds_are_read_and_reduced_by_default(carton):
    """250 mm/s on the way, 10 mm/s in, half of the joints' speed."""
    assert carton().robot.speeds == DEFAULT_SPEEDS == SpeedLimits(250.0, 10.0, 0.5, 1.0)
    lines = ["tip_speed_mm_s = 100", "insertion_speed_mm_s = 5", "joint_speed_fraction = 0.2"]
    assert carton(*lines, "joint_acceleration_fraction = 0.3").robot.speeds == SpeedLimits(100.0, 5.0, 0.2, 0.3)


@pytest.mark.parametrize(
    "line",
    ["tip_speed_mm_s = 1001", "tip_speed_mm_s = 0", "insertion_speed_mm_s = 101", "joint_speed_fraction = 1.1"]
    + ["joint_acceleration_fraction = 0", "insertion_speed_mm_s = 50\ntip_speed_mm_s = 20"],
)
def test_what_is_no_limit_is_refused(carton, line):
    with refused("out_of_range" if "\n" in line else "bad_value", line.split()[0]):
        carton(line)


@pytest.mark.parametrize(
    ("position", "z", "told"),
    [
        ((600.0, 20.0, -30.0), (0.0, -1.0, 0.0), None),
        ((0.0, 0.0, 0.0), (0.0, -1.0, 0.0), None),
        *(
            (metres, (0.0, -1.0, 0.0), "wrong_unit")
            for metres in ((0.6, 0.02, -0.03), (0.0, 0.0, -1.2), (2.0, 0.0, 0.5))
        ),
        ((600.0, 0.0, 0.0), (0.5, 0.75**0.5, 0.0), "axes_not_square 60.0"),
    ],
)
def test_a_mount_is_in_millimetres_and_square(position, z, told):
    mount = MountSection(position_mm=position, x_axis=(1.0, 0.0, 0.0), z_axis=z)
    if told is None:
        T_ct_base = np.linalg.inv(mount_pose(mount, Space.LPS, "case.toml"))
        assert T_ct_base[:3, 3] == pytest.approx(position)
        return
    with refused(*told.split()):
        mount_pose(mount, Space.LPS, "case.toml")
