"""How fast a case lets its plans move: defaults, the keys of [robot], and what is refused."""

import pytest
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS, SpeedLimits
from puncture_twin.planning.case.case import load_case


@pytest.fixture
def carton(tmp_path):
    for file in (folder() / "carton").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    path = tmp_path / "case_m.toml"
    text = path.read_text(encoding="utf-8")
    assert "[robot]\n" in text

    def read(*lines):
        path.write_text(text.replace("[robot]\n", "\n".join(["[robot]", *lines, ""])), encoding="utf-8")
        return load_case(path)

    return read


def test_the_default_is_reduced_speed(carton):
    """250 mm/s on the way, 10 mm/s in, half of the joints' speed."""
    assert carton().robot.speeds == DEFAULT_SPEEDS == SpeedLimits(250.0, 10.0, 0.5, 1.0)


def test_the_keys_are_read(carton):
    lines = ["tip_speed_mm_s = 100", "insertion_speed_mm_s = 5", "joint_speed_fraction = 0.2"]
    assert carton(*lines, "joint_acceleration_fraction = 0.3").robot.speeds == SpeedLimits(100.0, 5.0, 0.2, 0.3)


@pytest.mark.parametrize(
    "lines",
    [
        ["tip_speed_mm_s = 1001"],
        ["tip_speed_mm_s = 0"],
        ["insertion_speed_mm_s = 101"],
        ["insertion_speed_mm_s = 50", "tip_speed_mm_s = 20"],
        ["joint_speed_fraction = 1.1"],
        ["joint_acceleration_fraction = 0"],
    ],
)
def test_what_is_no_limit_is_refused(carton, lines):
    with refused("out_of_range" if len(lines) > 1 else "bad_value", lines[0].split()[0]):
        carton(*lines)
