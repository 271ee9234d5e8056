"""``selfcal`` from the command line: simulate, calibrate, puncture, write; and read recordings back."""

import json
import shutil

import numpy as np
import pytest
from refusals import refused_command
from scipy.stats import chi2, f

from puncture_twin.run_twin import main
from puncture_twin.twin.guidance.ultrasound.recording_file import write_recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import load_selfcal_case
from puncture_twin.twin.jobs.exit_codes import ANSWER_IS_NO, OK
from puncture_twin.twin.plant.simulated_recording import PoseRanges, simulate_recording
from puncture_twin.twin.plant.ultrasound_workcell import draw_workcell

CASE = """
schema = 1
name = "small"
seed = 3
[poses]
samples = 240
count = 20
"""


def answer(capsys, *arguments):
    """What ``selfcal --json`` prints."""
    assert main(["selfcal", *map(str, arguments), "--json"]) == OK
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def case_folder(tmp_path_factory):
    here = tmp_path_factory.mktemp("selfcal")
    (here / "selfcal.toml").write_text(CASE)
    return here


@pytest.fixture(scope="module")
def done(case_folder, tmp_path_factory):
    """The folder of results, with the kept pictures in ``kept`` beside it, in a folder that no other test shares."""
    out = tmp_path_factory.mktemp("selfcal_done") / "out"
    record = out.with_name("kept")
    assert main(["selfcal", str(case_folder), "--seeds", "1", "--out", str(out), "--record", str(record)]) == OK
    return out


def test_every_file_is_written_and_the_page_says_what_matters(done):
    names = {"calibration.json", "recording.csv", "bmode.png", "room.png", "report.html"}
    assert {path.name for path in done.iterdir()} == {*names, "manifest.json", "timings.json"}
    assert all((done / name).stat().st_size > 1000 for name in names)
    page = (done / "report.html").read_text()
    for words in ("tip to target, true", "expected error of the calibration", "cannot determine", "along the shaft"):
        assert words in page
    assert page.count('<img class="wide"') == 4
    assert "{{" not in page.split("<script>")[0]
    assert 'src="http' not in page


def test_the_calibration_is_the_truth_within_what_it_claims(case_folder, done):
    """Against the truth drawn anew from the seed: X, Y and tip within 99.9 % of what their covariance lets expect."""
    found, case = json.loads((done / "calibration.json").read_text()), load_selfcal_case(case_folder)
    truth = draw_workcell(case, np.random.default_rng(3))
    names, covariance = found["parameters"], np.array(found["covariance"])
    drawn = np.concatenate([truth.X[:3, 3], truth.Y[:3, 3], truth.tip_end2])
    X, Y = (np.array(found[key])[:3, 3] for key in ("T_end1_image", "T_base1_base2"))
    assert np.linalg.norm(case.T_base1_base2[:3, 3] - truth.Y[:3, 3]) > 1.0  # the drawing was wrong
    rows = [names.index(f"{part}_{axis}_mm") for part in ("t_X", "t_Y", "t_Q") for axis in "xyz"]
    e = np.concatenate([X, Y, found["tip_end2_mm"]]) - drawn
    assert e @ np.linalg.solve(covariance[np.ix_(rows, rows)], e) < f.ppf(0.999, 9, 30) * 9
    assert chi2.ppf(0.95, len(names)) < found["region_limit_95"] < 1.5 * chi2.ppf(0.95, len(names))
    assert np.array(found["needle_direction_end2"]) @ truth.V > np.cos(np.radians(0.3))
    assert (found["version"], found["seed"], len(found["residuals_mm"])) == (2, 3, 20)
    assert [(one["role"], one["path"]) for one in found["inputs"]] == [("case", "selfcal.toml")]
    assert any("along the shaft" in line for line in found["cannot_show"])


def test_a_recording_gives_the_same_calibration(case_folder, done, tmp_path, capsys):
    """The CSV that was written, read again beside the case that declares the arms; as one JSON object."""
    summary = answer(capsys, case_folder, "--recording", done, "--out", tmp_path)
    found = json.loads((done / "calibration.json").read_text())
    assert summary["T_end1_image"] == pytest.approx(np.array(found["T_end1_image"]), abs=1e-6)
    assert summary["predicted_tre_mm"] == pytest.approx(found["predicted_tre_mm"], rel=1e-4)
    assert summary["trials"] == []
    names = {"calibration.json", "report.html", "manifest.json", "timings.json"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_the_kept_pictures_give_the_same_calibration(case_folder, done, tmp_path, capsys):
    """Read, detected and calibrated again; every picture is an input, and none is written."""
    kept, found = done.with_name("kept"), json.loads((done / "calibration.json").read_text())
    summary = answer(capsys, case_folder, "--recording", kept, "--out", tmp_path)
    for key in ("T_end1_image", "T_base1_base2", "tip_end2_mm", "predicted_tre_mm"):
        assert summary[key] == pytest.approx(np.array(found[key]), abs=1e-6)
    assert summary["without_needle"] == found["without_needle"]
    pictures = sorted(path.name for path in kept.glob("*.png"))
    assert [one["path"] for one in summary["inputs"]] == ["recording.csv", *pictures, "selfcal.toml"]
    assert len(pictures) == 20 + len(found["without_needle"])


def test_pictures_are_not_kept_of_a_recording_or_over_others(case_folder, done, tmp_path, capsys):
    kept = done.with_name("kept")
    out = ["--out", tmp_path / "out"]
    refused_command(["selfcal", case_folder, "--record", kept, *out], capsys, "output_exists")
    both = ["selfcal", "--recording", kept, "--record", tmp_path / "new", *out]
    refused_command(both, capsys, "conflicting_options")


def test_the_kept_pictures_need_no_case(case_folder, done, tmp_path, capsys):
    """They state the flanges, which are those that the case's arms turn the joints into; joints alone need the case."""
    kept, out = done.with_name("kept"), ["--out", tmp_path / "out"]
    shutil.copytree(kept, tmp_path / "joints")
    lines = [line.split(",") for line in (kept / "recording.csv").read_text().split()]
    (tmp_path / "joints" / "recording.csv").write_text("\n".join(",".join([one[0], *one[25:]]) for one in lines))
    both = [answer(capsys, case_folder, "--recording", one, *out) for one in (kept, tmp_path / "joints")]
    assert both[0]["T_base1_base2"] == pytest.approx(np.array(both[1]["T_base1_base2"]), abs=1e-9)
    alone = answer(capsys, "--recording", kept, *out)
    assert alone["tip_end2_mm"] == pytest.approx(both[0]["tip_end2_mm"], abs=1.0)
    refused_command(["selfcal", "--recording", tmp_path / "joints", *out], capsys, "missing_column", "joints")


def test_a_recording_without_joints_says_what_it_cannot_count(case_folder, done, tmp_path, capsys):
    """No joints, and a case that declares the arms: calibrated with noise alone, which a warning and a limit say."""
    lines = [line.split(",") for line in (done / "recording.csv").read_text().splitlines()]
    assert lines[0][-1] == "B_q6_deg"
    (tmp_path / "bare.csv").write_text("\n".join(",".join(line[:-12]) for line in lines) + "\n")
    summary = answer(capsys, case_folder, "--recording", tmp_path / "bare.csv", "--out", tmp_path / "out")
    assert summary["arms"] is None
    assert any("no joints" in warning for warning in summary["warnings"])
    assert any("errors of the arms" in line for line in summary["cannot_show"])
    counted = json.loads((done / "calibration.json").read_text())
    assert summary["predicted_tre_mm"] < counted["predicted_tre_mm"]
    lines[3][-12] = repr(float(lines[3][-12]) + 20.0)  # the flange is not where a ur3 with these joints has it
    (tmp_path / "other.csv").write_text("\n".join(",".join(line) for line in lines) + "\n")
    command = ["selfcal", case_folder, "--recording", tmp_path / "other.csv", "--out", tmp_path / "out"]
    refused_command(command, capsys, "joints_of_another_arm", "A in pose 3")


def test_a_declaration_that_is_too_small_is_a_warning(done, tmp_path, capsys):
    """Told a third of the noise, the residuals' chi-squared is far above its freedom."""
    noise = "[noise]\nrobot_mm = 0.0\nrobot_deg = 0.0\nimage_mm = 0.02\ndirection_deg = 0.05\noff_plane_mm = 0.05\n"
    (tmp_path / "selfcal.toml").write_text(CASE + noise)
    summary = answer(capsys, tmp_path, "--recording", done, "--out", tmp_path / "out")
    assert summary["arms"]["chi2_per_freedom"] > 1.5
    assert any("probably too small" in warning for warning in summary["warnings"])


def test_a_recording_that_ends_within_a_line_is_a_warning(done, tmp_path, capsys):
    """Cut within its last number a recording is whole CSV with another number; JSON says that its end is missing."""
    (tmp_path / "cut.csv").write_text((done / "recording.csv").read_text().rstrip("\n"))
    said = "cut.csv: its last line has no line break at its end; was the file cut?"
    assert answer(capsys, "--recording", tmp_path / "cut.csv", "--out", tmp_path / "out")["warnings"] == [said]


def test_poses_of_constant_insertion_are_refused(tmp_path, capsys):
    """What a needle guide does: one line that names the motion, exit code 2, and no calibration."""
    steep = float(np.radians(45.0))
    ranges = PoseRanges(insertion=(steep, steep))
    recording, _ = simulate_recording(np.random.default_rng(1), 30, ranges=ranges)
    write_recording(recording, tmp_path / "recording.csv")
    out = tmp_path / "out"
    refused_command(["selfcal", "--recording", tmp_path, "--out", out], capsys, "poses_too_alike", "insertion angle")
    assert not (out / "calibration.json").exists()


def test_no_pose_is_an_answer(tmp_path, capsys):
    (tmp_path / "selfcal.toml").write_text(CASE + "[needle_arm]\nposition_mm = [2500.0, 0.0, 0.0]\n")
    assert main(["selfcal", str(tmp_path), "--out", str(tmp_path / "out")]) == ANSWER_IS_NO
    assert "needle_out_of_reach" in capsys.readouterr().err
