"""`confirm`: a rehearsed needle in a control scan, read, checked and answered; and what it says of the errors."""

import json
from functools import cache

import numpy as np
import pytest
from refusals import refused_command

from puncture_twin.meshes import folder
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.patient.confirm_job import ScanFiles, _body, confirm_needle, learn
from puncture_twin.twin.plant.scanner.case_scene import TrueRod, VirtualScanner, case_scene
from puncture_twin.twin.plant.scanner.image import ScanSettings
from puncture_twin.twin.plant.scanner.writers import write_nifti

CASE = folder() / "abdomen"
OUTWARD = np.array([-0.89, -0.437, -0.126]) / np.linalg.norm([-0.89, -0.437, -0.126])


first_scan = cache(VirtualScanner.image)


class OneScan(VirtualScanner):
    """Each of its scans is the first."""

    def image(self):
        return first_scan(self)


@pytest.fixture(scope="module")
def context():
    return prepare(CASE, arm=False)


@pytest.fixture(scope="module")
def scanner(context):
    """Of 120 mm of a patient, rotated by 3 degrees, the tip 4 mm off the target: slices are coarse."""
    settings, rng = ScanSettings(3.0, 1.5, 15.0, length_mm=120.0, turn=np.radians(3.0)), np.random.default_rng(1)
    rod = TrueRod(context.case.target_ct + 4.0 * OUTWARD, -OUTWARD)
    return OneScan(case_scene(context.case, context.anatomy, settings, rng, needle=rod), settings, rng)


@pytest.fixture(scope="module")
def control(scanner, tmp_path_factory):
    image = scanner.image()
    return write_nifti(tmp_path_factory.mktemp("control") / "control.nii.gz", image.hu, image.grid.T_ct_index)


@pytest.fixture(scope="module")
def confirmed(control):
    """What the command says of its files, its exit code, and the names of what it wrote."""
    out = control.parent / "out"
    code = main(["confirm", str(CASE), "--scan", str(control), "--out", str(out), "--json"])
    return code, json.loads((out / "confirm.json").read_text()), {one.name for one in out.iterdir()}


def test_a_needle_is_read_in_the_cases_frame(context, confirmed):
    """Where it truly is, tied by markers over a rotation; its line safe as `check` has it; the next aim is deeper."""
    code, found, written = confirmed
    assert found["frames"]["tied_by"] == "markers"
    off = np.array(found["tip_ct_mm"]) - context.case.target_ct - 4.0 * OUTWARD
    assert np.linalg.norm(off) < 1.0
    assert off @ np.linalg.solve(found["tip_cov_mm2"], off) < 16.3
    assert found["depth_mm"] == pytest.approx(-4.0, abs=0.8) and found["lateral_mm"] < 0.9
    assert (found["bent"], found["angle_deg"], found["in_predicted_region"]) == (False, None, None)
    assert found["verdict"] == "safe" and code == (found["next_aim"]["kind"] != "accept")
    assert {"confirm.html", "confirm.png", "confirm.json"} <= written
    assert "control ct" in {one["role"] for one in found["inputs"]}


def test_a_scan_is_read_off_the_scanner_as_off_its_files(context, scanner, control, confirmed):
    """Two devices of one protocol: the needle and what is to be done are the same; files are inputs, a scanner none."""
    live, found = confirm_needle(context, scanner), confirmed[1]
    np.testing.assert_allclose(live.needle.tip_ct, found["tip_ct_mm"], atol=1e-4)
    np.testing.assert_allclose(live.needle.cov_ct[:3, :3], found["tip_cov_mm2"], rtol=1e-3)
    np.testing.assert_allclose(live.needle.cov_ct[3:, 3:], found["axis_cov_rad2"], rtol=1e-3)
    assert [one.kind for one in live.aims] == [one["kind"] for one in found["aims"]]
    assert not live.read and [one.role for one in ScanFiles(control).measured_scan().inputs] == ["control ct"]


def test_every_bone_ties_the_frames(context):
    """Ribs, sternum and pelvis too, whose names have a side or a number; organs are what is no bone."""
    known = _body(context)
    counts = [len(np.unique(one.structure)) for one in (known.sample, known.organs)]
    assert counts == [1 + 6, len(context.anatomy.structures) - 6]


def test_a_mirrored_scan_and_one_without_a_needle(tmp_path, capfd, context, scanner, control):
    """One line each, exit 2, nothing written."""
    volume, T_scan_ct = read_volume(control), scanner.scene.T_scan_ct
    mirrored = write_nifti(tmp_path / "mirrored.nii.gz", np.ascontiguousarray(volume.values[::-1]), volume.T_ct_index)
    refused_command(["confirm", CASE, "--scan", mirrored, "--out", tmp_path / "out"], capfd, "mirrored")
    values, dense = volume.values.copy(), np.argwhere(volume.values > 300)
    away = apply(volume.T_ct_index, dense.astype(float)) - apply(T_scan_ct, context.case.target_ct)
    outward = T_scan_ct[:3, :3] @ OUTWARD
    along = away @ outward
    needle = (np.linalg.norm(away - along[:, None] * outward, axis=1) < 7.0) & (along > 0)
    values[tuple(dense[needle].T)] = 40
    bare = write_nifti(tmp_path / "bare.nii.gz", values, volume.T_ct_index)
    refused_command(["confirm", CASE, "--scan", bare, "--out", tmp_path / "out"], capfd, "needle_not_seen")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ([], "missing_option"),
        ([CASE], "missing_option"),
        ([CASE, "--scan", "x.nii", "--learn", "y.json"], "conflicting_options"),
        ([CASE, "--scan", "no_such_folder/none.nii"], "no_such_file"),
    ],
)
def test_what_is_refused(arguments, code, capfd, tmp_path, monkeypatch):
    """Before anything is read."""
    monkeypatch.chdir(tmp_path)
    refused_command(["confirm", *arguments], capfd, code)


def confirmations(folder, scale, count, seed=0):
    """Reports of so many needles whose errors are so many times as large as was predicted."""
    rng = np.random.default_rng(seed)
    cov = np.diag([0.4, 0.9, 1.6])
    for number in range(count):
        off = scale * rng.multivariate_normal(np.zeros(3), cov)
        inside = bool(off @ np.linalg.solve(cov, off) < 7.815)
        stated = {"predicted": {"off_mm": off.tolist(), "cov_mm2": cov.tolist(), "inside": inside}}
        (folder / f"{number}.json").write_text(json.dumps(stated))
    return [word for number in range(count) for word in ("--learn", folder / f"{number}.json")]


def test_needles_tell_the_size_of_the_errors(tmp_path, run, capfd):
    """Twice as large as declared, in 40 needles: the interval holds 2 and not 1; in three it says that they are few."""
    code, found = run("confirm", *confirmations(tmp_path, 2.0, 40))
    assert code == 0 and found["needles"] == 40 and 1.0 < found["low"] < 2.0 < found["high"]
    assert main(["confirm", *map(str, confirmations(tmp_path, 1.0, 3))]) == 0
    assert "say little" in capfd.readouterr().out


def test_the_interval_holds_the_truth_95_times_in_a_hundred(tmp_path):
    """200 times 8 needles."""
    held = 0
    for seed in range(200):
        learned = learn([path for path in confirmations(tmp_path, 1.5, 8, seed) if path != "--learn"])
        held += learned.low < 1.5 < learned.high
    assert 180 <= held <= 198


def test_one_needle_counts_once(tmp_path, capfd):
    """Named twice, or no confirmation: one line."""
    names = confirmations(tmp_path, 1.0, 2)
    refused_command(["confirm", *names, *names[:2]], capfd, "duplicate_name")
    (tmp_path / "none.json").write_text("{}")
    refused_command(["confirm", "--learn", tmp_path / "none.json"], capfd, "missing_key")
