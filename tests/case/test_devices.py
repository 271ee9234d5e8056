"""The devices that see needle and target, and how the target moves: defaults, keys, spaces, and what is refused."""

import tomllib

import numpy as np
import pytest
from case.test_case import unknown_keys
from case_world import changed, write_case
from refusals import refused

from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.case_file import case_schema
from puncture_twin.planning.case.tables import ControlScanSection

EVERY_KEY = """[stereo]
cameras_mm = [[-250.0, -900.0, 300.0], [250.0, -900.0, 300.0]]
balls_mm = [60.0, 120.0, 180.0]
sd_mm = 0.05
[ultrasound]
model = "ur5"
target_sd_mm = [0.6, 1.0]
tip_sd_mm = [0.3, 1.0]
calibration_sd_mm = 0.1
depth_mm = 120.0
width_mm = 60.0
[ultrasound.mount]
position_mm = [-600.0, 20.0, -30.0]
x_axis = [1.0, 0.0, 0.0]
z_axis = [0.0, -1.0, 0.0]
[control_scan]
slice_mm = 3.0
target_seen = false
dose_msv = 0.4
seconds = 90.0
[motion]
target_sd_mm = [0.2, 0.3, 1.1]
"""


@pytest.fixture
def read(tmp_path):
    """Reads the usual patient with these lines before its structures; other changes may follow."""
    return lambda lines, *changes: load_case(
        write_case(tmp_path, ("[registration]", f"{lines}\n[registration]"), *changes)
    )


def test_a_case_without_them_declares_none(read):
    case = read("")
    assert case.stereo is case.ultrasound is case.control_scan is case.motion is None


def test_the_defaults_are_those_of_the_reference(read):
    case = read("[stereo]\n[ultrasound]\n[control_scan]")
    assert case.stereo.cameras_ct is None and case.ultrasound.T_base_ct_mount is None
    assert (case.stereo.balls_mm, case.stereo.sd_mm) == ((80.0, 160.0), 0.03)
    probe = case.ultrasound
    assert (probe.model.name, probe.target_sd_mm, probe.tip_sd_mm) == ("ur3", (0.3, 0.5), (0.08, 0.5))
    assert (probe.calibration_sd_mm, probe.depth_mm, probe.width_mm) == (0.07, 150.0, 40.0)
    assert case.control_scan == ControlScanSection(slice_mm=2.0, target_seen=True, dose_msv=0.9, seconds=120.0)


@pytest.mark.parametrize(("space", "to_lps"), [("LPS", [1, 1, 1]), ("RAS", [-1, -1, 1])])
def test_every_key_is_read_with_places_in_lps(read, space, to_lps):
    case = read(EVERY_KEY, ('space = "LPS"', f'space = "{space}"'))
    assert (case.stereo.cameras_ct * to_lps).tolist() == [[-250.0, -900.0, 300.0], [250.0, -900.0, 300.0]]
    assert (case.stereo.balls_mm, case.stereo.sd_mm) == ((60.0, 120.0, 180.0), 0.05)
    probe = case.ultrasound
    assert (probe.model.name, probe.target_sd_mm, probe.tip_sd_mm) == ("ur5", (0.6, 1.0), (0.3, 1.0))
    assert (probe.calibration_sd_mm, probe.depth_mm, probe.width_mm) == (0.1, 120.0, 60.0)
    assert case.control_scan == ControlScanSection(slice_mm=3.0, target_seen=False, dose_msv=0.4, seconds=90.0)
    T_ct_base = np.linalg.inv(probe.T_base_ct_mount)
    assert T_ct_base[:3, 3] * to_lps == pytest.approx([-600.0, 20.0, -30.0])
    assert T_ct_base[:3, 2] * to_lps == pytest.approx([0.0, -1.0, 0.0], abs=1e-12)
    assert case.motion.target_cov_ct == pytest.approx(np.diag([0.04, 0.09, 1.21]))


@pytest.mark.parametrize(
    ("old", "new", "code", "named"),
    [
        ("[60.0, 120.0, 180.0]", "[60.0, 60.0]", "range_descends", "balls_mm"),
        ("[60.0, 120.0, 180.0]", "[60.0, 210.0]", "out_of_range", "210"),
        ("[60.0, 120.0, 180.0]", "[0.0, 120.0]", "bad_value", "balls_mm"),
        ("[250.0, -900.0, 300.0]", "[-250.0, -900.0, 300.0]", "out_of_range", "cameras_mm"),
        ("[250.0, -900.0, 300.0]", "[0.25, -0.9, 0.3]", "wrong_unit", "cameras_mm"),
        (", [250.0, -900.0, 300.0]", "", "missing_key", "cameras_mm"),
        ("sd_mm = 0.05", "sd = 0.05", "unknown_key", "sd_mm"),
        ('model = "ur5"', 'model = "ur7"', "unknown_robot", "ur7"),
        ("tip_sd_mm = [0.3, 1.0]", "tip_sd_mm = 0.3", "bad_value", "tip_sd_mm"),
        ("[-600.0, 20.0, -30.0]", "[-0.6, 0.02, -0.03]", "wrong_unit", "ultrasound.mount"),
        ("z_axis = [0.0, -1.0, 0.0]", "z_axis = [2.0, 0.0, 0.0]", "axes_parallel", "ultrasound.mount"),
        ("target_seen = false", "target_seen = 0", "bad_value", "target_seen"),
        ("[0.2, 0.3, 1.1]", "[0.2, 0.3, -1.1]", "bad_value", "motion"),
        ("target_sd_mm = [0.2, 0.3, 1.1]", "", "missing_key", "target_sd_mm"),
    ],
)
def test_what_cannot_be_is_refused(read, old, new, code, named):
    with refused(code, named):
        read(changed(EVERY_KEY, (old, new)))


def test_the_json_schema_knows_their_keys(read, tmp_path):
    """`run-twin schema`: what an editor completes, and what it marks."""
    read(EVERY_KEY)
    schema, data = case_schema(), tomllib.loads((tmp_path / "case.toml").read_text(encoding="utf-8"))
    assert unknown_keys(data, schema, schema["$defs"]) == []
    data["stereo"]["sd"] = 1.0
    assert unknown_keys(data, schema, schema["$defs"]) == ["sd"]
