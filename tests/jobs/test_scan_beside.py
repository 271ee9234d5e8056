"""Patients with arms, bed and lines from the scanner: no direction that a search calls safe passes one of them.

Every scene is another anatomy; `init` and `search` see its CT and labels alone, and what is safe for them is held
against the true surfaces by a judge that shares no code with the product (`benchmarks/beside/judge.py`).
"""

import numpy as np
import pytest
import trimesh

from benchmarks.beside.judge import passed
from benchmarks.beside.scene import Asked, judged
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.experiment.scan_job import ScanRequest, scan_case
from puncture_twin.twin.plant.scanner.image import ScanSettings
from tools.phantoms import __main__ as phantoms
from tools.phantoms.outside_objects import OutsideObjects

THICK = ("arm_", "table", "mattress", "pad")
"""Bodies thicker than a voxel; lines are not (`docs/concepts/virtual-ct.md`)."""


def settings(seed, spacing, pixel, noise, fov=None):
    return ScanSettings(spacing, pixel, noise_hu=noise, seed=seed, length_mm=140.0, fov_mm=fov)


SCENES = {
    "arms beside, flat table": Asked(301, OutsideObjects("beside", "flat"), settings(1, 4.0, 3.0, 20.0)),
    "arms pressed, curved table": Asked(302, OutsideObjects("pressed", "curved"), settings(2, 5.0, 4.0, 30.0)),
    "arms across, no bed": Asked(17, OutsideObjects("across", "none"), settings(4, 5.0, 4.0, 15.0)),
    "arms pressed, cut": Asked(303, OutsideObjects("pressed", "pad"), settings(5, 4.0, 4.0, 20.0, 420.0)),
}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", SCENES)
def test_what_is_safe_in_a_scan_passes_no_arm_and_no_table(name, tmp_path):
    """Nor a structure's margin, within a voxel's diagonal; what knows of nothing beside the patient does pass them."""
    scene = judged(tmp_path, SCENES[name])
    deepest = max((one.deepest_mm for one in scene.passed if one.part.startswith(THICK)), default=0.0)
    assert deepest < scene.voxel_mm
    assert all(lack < scene.voxel_mm for lack in scene.lacks.values())
    missed = {one.row for one in scene.blind if one.part.startswith(THICK) and one.deepest_mm > scene.voxel_mm}
    assert len(missed) > 20
    assert scene.found.safe.sum() > 0


def test_the_judge_sees_what_a_needle_passes():
    """A ball beside a ball: needles through it and past it, from within the other; how deep and how far."""
    ball = trimesh.creation.icosphere(4, 10.0)
    skin = TriangleMesh(ball.vertices * 3.0, ball.faces)
    part = TriangleMesh(ball.vertices + [60.0, 0.0, 0.0], ball.faces)
    overlapping = TriangleMesh(ball.vertices + [32.0, 0.0, 0.0], ball.faces)
    angles = np.radians([0.4, 6.3, 12.1, 179.0])  # along no edge
    directions = np.stack([np.cos(angles), np.sin(angles), 0.013 + 0 * angles], axis=1)
    found = passed({"a": part, "b": overlapping}, skin, np.zeros(3), directions, np.array([90.0, 90.0, 90.0, 90.0]))
    a, b = ({one.row: one for one in found if one.part == name} for name in "ab")
    assert set(a) == {0, 1} and a[0].deepest_mm == pytest.approx(10.0 - 60.0 * np.sin(angles[0]), abs=0.9)
    assert a[0].long_mm == pytest.approx(20.0, abs=0.8)
    assert a[1].deepest_mm == pytest.approx(10.0 - 60.0 * np.sin(angles[1]), abs=0.9)
    assert set(b) == {0, 1, 2} and b[0].long_mm == pytest.approx(12.0, abs=0.8)
    assert b[0].deepest_mm < 6.9
    assert not passed({"a": part}, skin, np.zeros(3), directions, np.full(4, 49.0))


def test_a_drawn_trunk_is_a_case_that_can_be_scanned(tmp_path, capsys, monkeypatch):
    """`python -m tools.phantoms --seed`, then `scan` with everything about it, closed."""
    monkeypatch.setattr("sys.argv", ["phantoms", "--out", str(tmp_path / "drawn"), "--seed", "7"])
    assert phantoms.main() == 0
    wanted = OutsideObjects("across", "flat", 2).placed
    request = ScanRequest(ScanSettings(5.0, 4.0, length_mm=60.0), "none", None, wanted)
    run = scan_case(prepare(tmp_path / "drawn", arm=False), tmp_path / "ct", request)
    parts = {one.name: one.mesh for one in run.scene.outside_objects}
    assert {"mattress", "table", "arm_left", "arm_right_hand", "arm_left_ulna", "line_1", "cable_2_core"} <= set(parts)
    assert all(trimesh.Trimesh(one.vertices, one.faces).is_watertight for one in parts.values())
    target = ",".join(f"{one:.3f}" for one in run.scene.target)
    assert main(["init", str(tmp_path / "ct"), "--ct", "dicom", f"--target={target}"]) == 0
    assert "arm_left" not in capsys.readouterr().out
