"""The command ``scan``: a set of files that `init` and `search` take, and what it says of the truth."""

import json

import numpy as np
import pytest
from refusals import refused_command

from puncture_twin.meshes import folder
from puncture_twin.planning.formats.points import read_points
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.experiment.scan_job import Control, _needle_rows, control_summary
from puncture_twin.twin.plant.scanner.case_scene import TrueRod

CARTON = folder() / "carton" / "case_m.toml"
COARSE = ("--spacing", "5", "--pixel", "0.9")


@pytest.fixture(scope="module")
def carton(tmp_path_factory):
    out = tmp_path_factory.mktemp("scan")
    assert main(["scan", str(CARTON), "--out", str(out), *COARSE]) == 0
    return out, json.loads((out / "scan.json").read_text())


def test_the_set_is_whole(carton):
    """Series, NIfTI, labels with names, markers, report and picture; all listed in the manifest."""
    out, report = carton
    listed = json.loads((out / "manifest.json").read_text())["entries"]["scan"]["files"]
    for name in ("ct.nii.gz", "labels.nii.gz", "labels.csv", "markers_ct.csv", "scan.json", "scan.png"):
        assert name in listed
    assert sum(name.startswith("dicom/") for name in listed) == report["voxels"][2]
    assert (out / "labels.csv").read_text().splitlines() == ["label,name", "1,bolt_l", "2,bolt_m", "3,bolt_h"]


def test_the_markers_are_those_of_the_detector_and_near_the_truth(carton):
    """In the case's format, in the scan's LPS: each within the detector's error, and so is the end of the bolt."""
    out, report = carton
    found = read_points(out / "markers_ct.csv", default_space=Space.LPS)
    for name, point, one in zip(found.names, found.points, report["markers"], strict=True):
        assert name == one["name"]
        assert np.allclose(point - one["true_mm"], one["error_mm"])
        assert np.abs(one["error_mm"]).max() < 1.2
        assert abs(one["rule_error_mm"][2]) <= 3.0
    assert np.abs(report["lesion"]["error_mm"]).max() < 0.5


def test_true_places_are_drawn_in_their_cells(carton):
    """Whole slices apart they would all err alike; as drawn they differ, each within its cell."""
    _, report = carton
    T = np.array(report["T_scan_case"])
    listed = read_points(CARTON.parent / "markers_ct.csv", default_space=Space.LOCAL).points @ T[:3, :3].T + T[:3, 3]
    moved = np.array([one["true_mm"] for one in report["markers"]]) - listed
    assert np.ptp(moved[:, 2]) > 0.5
    assert np.all(np.abs(moved) <= [0.5, 0.5, 2.5])


def test_the_labels_lie_where_the_series_lies(carton):
    out, _ = carton
    ct, labels = read_volume(out / "ct.nii.gz"), read_volume(out / "labels.nii.gz")
    assert np.array_equal(ct.T_ct_index, labels.T_ct_index)
    assert np.median(ct.values[labels.values == 2]) > 2000


def of_wood(folder):
    for path in CARTON.parent.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    case = folder / "case_m.toml"
    text = case.read_text()
    for name in ("bolt_l", "bolt_m", "bolt_h"):
        text = text.replace(f'name = "{name}"\n', f'name = "{name}"\nhu = -400.0\n')
    case.write_text(text)
    return case


def test_a_needle_is_read_in_a_control_ct(tmp_path, run):
    """The tip that `scan` reads is where the rehearsal left it, and so are its errors along and across."""
    forward = np.array([0.2, -0.6, -0.75])
    forward /= np.linalg.norm(forward)
    target = np.array([50.0, 130.0, 63.0])
    tip = target + [0.5, 1.0, 2.0]
    end = {"tip_ct_mm": tip.tolist(), "direction_ct": forward.tolist(), "target_ct_mm": target.tolist()}
    (tmp_path / "rehearsal.json").write_text(json.dumps({"needle_end": end}))
    words = ["--spacing", 2, "--pixel", 1, "--rehearsal", tmp_path / "rehearsal.json"]
    code, found = run("scan", of_wood(tmp_path), "--out", tmp_path / "ct", *words)
    needle = found["needle"]
    assert code == 0
    assert needle["true"]["tip_to_target_mm"] == pytest.approx(np.linalg.norm(tip - target))
    assert needle["true"]["depth_mm"] == pytest.approx((tip - target) @ forward)
    assert needle["found"]["tip_to_target_mm"] == pytest.approx(needle["true"]["tip_to_target_mm"], abs=0.5)
    assert needle["tip_reading_error_mm"] < 0.5
    assert needle["angle_reading_error_deg"] < 1.0
    ct, labels = read_volume(tmp_path / "ct" / "ct.nii.gz"), read_volume(tmp_path / "ct" / "labels.nii.gz")
    assert -430 < np.median(ct.values[labels.values == 3]) < -250  # a bolt of wood, as `hu` states it


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--marker", "cross"), "unknown_choice cross"),
        (("--fov", "30"), "marker_not_seen"),
        (("--fov", "30", "--marker", "none", "--length", "6", "--spacing", "10"), "out_of_range"),
        (("--spacing", "0.3", "--pixel", "0.2"), "out_of_range 200,000,000"),
        (("--rehearsal", "nowhere.json"), "no_such_file nowhere.json"),
    ],
)
def test_what_cannot_be_scanned_is_refused_and_leaves_nothing(arguments, said, tmp_path, capsys):
    out = tmp_path / "out"
    refused_command(["scan", CARTON, "--out", out, *COARSE, *arguments], capsys, *said.split())
    assert not out.exists()


def test_a_needle_that_cannot_be_read_is_no_reason_for_no_scan():
    """Its summary and the text have the reason, and the truth beside it."""
    true = TrueRod(np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, -1.0]))
    why = "other metal hides the needle's tip; the needle's axis passes the target by 0.0 mm"
    summary = control_summary(Control(true, None, np.zeros(3), why))
    assert summary["found"] is None and summary["why_not"] == why
    assert summary["true"]["depth_mm"] == pytest.approx(-2.0)
    assert _needle_rows(summary) == [("needle", f"not read: {why}")]
