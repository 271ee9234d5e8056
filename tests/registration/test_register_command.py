"""What ``register`` prints: of two lists alone; of declared errors, which marker to drop and where one more helps."""

import hashlib
import json

import numpy as np
import pytest
from places import ROOT
from refusals import refused_command
from scipy.stats import chi2, f

from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK

ABDOMEN = ROOT / "meshes" / "abdomen"
LISTS = [str(ABDOMEN / "markers_ct.csv"), str(ABDOMEN / "touch.csv")]
TARGET = "--target=-90,-10,60"


def printed(capfd, *words):
    assert main(["register", *words, "--json"]) == OK
    return json.loads(capfd.readouterr().out)


def test_two_lists_register_without_a_case(capfd):
    found = printed(capfd, *LISTS, TARGET)
    assert found["fre_mm"] == pytest.approx(0.295, abs=0.001)
    assert [one["sha256"] for one in found["inputs"]] == [
        hashlib.sha256((ABDOMEN / name).read_bytes()).hexdigest() for name in ("markers_ct.csv", "touch.csv")
    ]
    ras = printed(capfd, *LISTS, "--target=90,10,60", "--space", "RAS")
    assert not np.allclose(ras["T_base_ct"], found["T_base_ct"])  # the CT's list is in the stated space too
    assert main(["register", *LISTS, TARGET]) == OK
    said = capfd.readouterr().out
    assert (
        "FRE" in said and "()" not in said and "error budget" not in said
    )  # no row of empty brackets, no heading alone


@pytest.mark.parametrize("fle", [None, 0.5])
def test_two_lists_say_how_sure_they_are_and_what_would_help(fle, capfd):
    """The isotropic formulas' own error (Fitzpatrick 1998); the ellipsoid holds 95 %; dropping costs, adding helps."""
    found = printed(capfd, *LISTS, TARGET, *([] if fle is None else ["--fle", str(fle)]))
    expected, markers = found["expected_tre_target_mm"], len(found["residual_mm"])
    assert found["fle_mm"] == pytest.approx(fle or found["fre_mm"] * np.sqrt(markers / (markers - 2)))
    assert expected == pytest.approx(found["fle_mm"] * found["leverage"], rel=1e-6)
    axes = np.array(found["half_axes_95_mm"])
    factor = np.linalg.norm(axes) / expected
    assert factor == pytest.approx(np.sqrt(chi2.ppf(0.95, 3) if fle else 3 * f.ppf(0.95, 3, 3 * markers - 6)))
    assert min(one["rms_mm"] for one in found["without"].values()) > expected > found["one_more"]["rms_mm"]
    assert "[errors]" not in found["fle_source"] and "declared" not in found["declaration"]["text"]


@pytest.mark.parametrize(
    ("target", "code"),
    [([], "missing_option"), (["1,2"], "wrong_count"), (["1,2,nan"], "not_finite"), (["a,b,c"], "not_a_number")],
)
def test_a_target_that_is_none_is_refused_in_one_line(target, code, capfd):
    refused_command(["register", *LISTS, *(f"--target={one}" for one in target)], capfd, code)


def test_declared_errors_say_what_would_help(capfd):
    """Shares add up; every marker's absence costs; one more marker helps, is outside and can be touched."""
    found = printed(capfd, str(ABDOMEN))
    assert found["declaration"]["holds"]
    assert sum(found["share"].values()) == pytest.approx(1)
    assert min(one["rms_mm"] for one in found["without"].values()) > found["expected_tre_target_mm"]
    assert found["one_more"]["rms_mm"] < found["expected_tre_target_mm"]
    assert found["one_more"]["point_ct_mm"][1] < 80  # not at the back, on the table
    assert not [warning for warning in found["warnings"] if "branch" in warning]


def test_a_touch_in_another_branch_is_warned_of(tmp_path, capfd):
    for path in ABDOMEN.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    lines = (tmp_path / "touch.csv").read_text().split()
    name, x, y, z, *joints = lines[2].split(",")
    q = np.radians(np.array(joints, dtype=float))
    others = inverse(ur_model("ur3"), flange_pose(ur_model("ur3"), q))[0]
    turned = max((one for one in others if not np.isnan(one).any()), key=lambda one: abs(np.sin((one - q) / 2)).max())
    lines[2] = ",".join([name, x, y, z, *(f"{angle:.6f}" for angle in np.degrees(turned))])
    (tmp_path / "touch.csv").write_text("\n".join(lines) + "\n")
    found = printed(capfd, str(tmp_path))
    assert any("M2 touched in another branch" in warning for warning in found["warnings"])


def test_joints_that_put_the_tip_elsewhere_are_refused(tmp_path, capfd):
    for path in ABDOMEN.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    text = (tmp_path / "case.toml").read_text().replace("length_mm = 210.0", "length_mm = 190.0")
    (tmp_path / "case.toml").write_text(text)
    refused_command(["register", tmp_path], capfd, "joints_of_another_arm", "ur3 20.0 mm")
