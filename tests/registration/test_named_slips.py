"""`register` names the slip that explains a refusal: a unit on both sides, swapped names, a misspelt name."""

import numpy as np
import pytest
from case_world import SKIN, ball, case_text, structure
from refusals import refused_command

from puncture_twin.planning.geometry.rigid import apply, pose

NAMES = ("M1", "M2", "M3", "M4", "M5")
POINTS = np.array([[0.0, -90, 10], [60, -70, 40], [-50, -80, 20], [10, -85, 95], [-45, -75, 120]])
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
TOUCHED = apply(pose(TURN, np.array([300.0, 100, 50])), POINTS) + np.random.default_rng(3).normal(0, 0.1, (5, 3))


def refusal(tmp_path, capfd, code, points_base, names_base, scale=1.0, names_ct=NAMES):
    """The one line of a registration of two lists, which has a code."""
    for path, names, points in (("ct.csv", names_ct, POINTS), ("base.csv", names_base, points_base)):
        rows = "".join(
            f"{name},{x},{y},{z}\n" for name, (x, y, z) in zip(names, scale * np.asarray(points), strict=True)
        )
        (tmp_path / path).write_text("name,x_mm,y_mm,z_mm\n" + rows)
    command = ["register", tmp_path / "ct.csv", tmp_path / "base.csv", "--target", "0,0,50"]
    return refused_command(command, capfd, code)


@pytest.mark.parametrize("scale", [0.001, 0.02])
def test_both_lists_in_metres_are_refused(tmp_path, capfd, scale):
    """Under a column of mm they fit each other, and the robot's patient was as small as a grain."""
    assert "5 mm at least" in refusal(tmp_path, capfd, "wrong_unit", TOUCHED, NAMES, scale)


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
    line = refusal(tmp_path, capfd, "marker_misses", TOUCHED, [NAMES[one] for one in order])
    assert named in line and line.count("would fit") == 1


def test_swapped_names_of_near_markers_are_named_too(tmp_path, capfd):
    """Markers so near to each other that no single one misses by far: the residuals are beyond the noise."""
    refusal(tmp_path, capfd, "wrong_unit", POINTS * 0.15 + 7.0, [NAMES[one] for one in (1, 0, 2, 3, 4)], 1.0)
    small = 0.15 * TOUCHED
    for path, names, points in (("ct.csv", NAMES, 0.15 * POINTS), ("base.csv", ("M2", "M1", *NAMES[2:]), small)):
        rows = "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in zip(names, points, strict=True))
        (tmp_path / path).write_text("name,x_mm,y_mm,z_mm\n" + rows)
    words = ["register", str(tmp_path / "ct.csv"), str(tmp_path / "base.csv"), "--target", "0,0,5"]
    refused_command([*words, "--fle", "0.2"], capfd, "residuals_too_large", "M1 and M2 swapped")


def test_a_touch_that_slipped_has_no_permutation(tmp_path, capfd):
    moved = TOUCHED.copy()
    moved[2] += (0, 40, 0)
    line = refusal(tmp_path, capfd, "marker_misses", moved, NAMES)
    assert "M3" in line and "would fit" not in line


@pytest.mark.parametrize(("wrong", "near"), [("m2", "did you mean 'M2'?"), ("apex", "")])
def test_a_marker_of_another_spelling_is_told(tmp_path, capfd, wrong, near):
    """M2 and m2 are two names; which is near is said."""
    line = refusal(tmp_path, capfd, "markers_missing", TOUCHED, NAMES, names_ct=["M1", wrong, "M3", "M4", "M5"])
    assert "M2" in line
    assert ("did you mean" in line) == bool(near)


def test_a_structure_of_another_spelling_is_told(tmp_path, capfd):
    for name, radius, center in (("skin", 90.0, (0, 0, 0)), ("aorta", 8.0, (0, 0, 30)), ("lesion", 9.0, (0, 0, 0))):
        ball(tmp_path / f"{name}.stl", radius, np.array(center))
    target = 'position_mm = [0.0, 0.0, 0.0]\nstructure = "leison"'
    text = case_text(SKIN, structure("lesion", "target"), structure("aorta", "avoid", margin_mm=3.0), target=target)
    (tmp_path / "case.toml").write_text(text)
    command = ["search", tmp_path, "--no-arm", "--out", tmp_path / "out"]
    refused_command(command, capfd, "unknown_structure", "leison", "did you mean 'lesion'?")
    command = ["init", tmp_path, "--target-label", "arota", "--unit", "mm", "--force"]
    refused_command(command, capfd, "unknown_structure", "arota", "did you mean 'aorta'?")
