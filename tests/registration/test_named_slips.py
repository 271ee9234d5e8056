"""`register` names the slip that explains a refusal: a unit on both sides, swapped names, a misspelt name."""

import numpy as np
import pytest
from case_world import SKIN, ball, case_text, structure

from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.run_twin import main

NAMES = ("M1", "M2", "M3", "M4", "M5")
POINTS = np.array([[0.0, -90, 10], [60, -70, 40], [-50, -80, 20], [10, -85, 95], [-45, -75, 120]])
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
TOUCHED = apply(pose(TURN, np.array([300.0, 100, 50])), POINTS) + np.random.default_rng(3).normal(0, 0.1, (5, 3))


def refusal(tmp_path, capfd, points_base, names_base, scale=1.0, names_ct=NAMES):
    """The one line of a registration of two lists."""
    for path, names, points in (("ct.csv", names_ct, POINTS), ("base.csv", names_base, points_base)):
        rows = "".join(
            f"{name},{x},{y},{z}\n" for name, (x, y, z) in zip(names, scale * np.asarray(points), strict=True)
        )
        (tmp_path / path).write_text("name,x_mm,y_mm,z_mm\n" + rows)
    assert main(["register", str(tmp_path / "ct.csv"), str(tmp_path / "base.csv"), "--target", "0,0,50"]) == 2
    (line,) = capfd.readouterr().err.strip().splitlines()
    return line


@pytest.mark.parametrize("scale", [0.001, 0.02])
def test_both_lists_in_metres_are_refused(tmp_path, capfd, scale):
    """Under a column of mm they fit each other, and the robot's patient was as small as a grain."""
    line = refusal(tmp_path, capfd, TOUCHED, NAMES, scale)
    assert "span " in line and "slip of unit (m or cm as mm) on both sides" in line and "5 mm at least" in line


@pytest.mark.parametrize(
    ("order", "named"),
    [
        ((1, 0, 2, 3, 4), "with M1 and M2 swapped they would fit (FRE 0."),
        ((0, 1, 4, 3, 2), "with M3 and M5 swapped they would fit (FRE 0."),
        ((1, 2, 0, 3, 4), "with M1, M2, M3 touched as "),
    ],
)
def test_swapped_names_are_named(tmp_path, capfd, order, named):
    """The marker that misses most was named, not the two that were swapped."""
    line = refusal(tmp_path, capfd, TOUCHED, [NAMES[one] for one in order])
    assert named in line and line.count("would fit") == 1


def test_swapped_names_of_near_markers_are_named_too(tmp_path, capfd):
    """Markers so near to each other that no single one misses by far: the residuals are beyond the noise."""
    line = refusal(tmp_path, capfd, POINTS * 0.15 + 7.0, [NAMES[one] for one in (1, 0, 2, 3, 4)], 1.0)
    assert "likely mm/cm/m slip" in line
    small = 0.15 * TOUCHED
    for path, names, points in (("ct.csv", NAMES, 0.15 * POINTS), ("base.csv", ("M2", "M1", *NAMES[2:]), small)):
        rows = "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in zip(names, points, strict=True))
        (tmp_path / path).write_text("name,x_mm,y_mm,z_mm\n" + rows)
    words = ["register", str(tmp_path / "ct.csv"), str(tmp_path / "base.csv"), "--target", "0,0,5"]
    assert main([*words, "--fle", "0.2"]) == 2
    line = capfd.readouterr().err
    assert "with M1 and M2 swapped they would fit" in line


def test_a_touch_that_slipped_has_no_permutation(tmp_path, capfd):
    """Only what would fit is named."""
    moved = TOUCHED.copy()
    moved[2] += (0, 40, 0)
    line = refusal(tmp_path, capfd, moved, NAMES)
    assert "M3 misses by" in line and "would fit" not in line


@pytest.mark.parametrize(("wrong", "near"), [("m2", "did you mean 'M2'?"), ("apex", "")])
def test_a_marker_of_another_spelling_is_told(tmp_path, capfd, wrong, near):
    """M2 and m2 are two names; which is near is said."""
    line = refusal(tmp_path, capfd, TOUCHED, ["M1", "M2", "M3", "M4", "M5"], names_ct=["M1", wrong, "M3", "M4", "M5"])
    assert "M2 missing on the CT side" in line or f"{wrong} missing on the base side" in line
    assert ("did you mean" in line) == bool(near)


def test_a_structure_of_another_spelling_is_told(tmp_path, capfd):
    """By the case and by init."""
    for name, radius, center in (("skin", 90.0, (0, 0, 0)), ("aorta", 8.0, (0, 0, 30)), ("lesion", 9.0, (0, 0, 0))):
        ball(tmp_path / f"{name}.stl", radius, np.array(center))
    target = 'position_mm = [0.0, 0.0, 0.0]\nstructure = "leison"'
    text = case_text(SKIN, structure("lesion", "target"), structure("aorta", "avoid", margin_mm=3.0), target=target)
    (tmp_path / "case.toml").write_text(text)
    assert main(["search", str(tmp_path), "--no-arm", "--out", str(tmp_path / "out")]) == 2
    assert "'leison' is no structure of the case; did you mean 'lesion'?" in capfd.readouterr().err
    assert main(["init", str(tmp_path), "--target-label", "arota", "--unit", "mm", "--force"]) == 2
    assert "no structure is named 'arota'; did you mean 'aorta'?" in capfd.readouterr().err
