"""Wherever the base's pose comes from, one that cannot be is told: a mount, markers, with the arm or without."""

import pytest
from case_world import CASE, MARKERS, changed, registration_section, write_case, write_markers
from refusals import refused

from puncture_twin.planning.search.context import prepare

WAYS = ("mount", "markers")
UPRIGHT = "x_axis = [1, 0, 0]\nz_axis = [0, 0, 1]\n"
PLACES = {
    "the robot's base would be in the patient": (20.0, 0.0, 30.0),
    "the target would be out of the arm's reach": (0.0, -1500.0, 0.0),
    "": (0.0, -330.0, 0.0),
}
"""What is said of a base there (LPS, mm), with its axes as the patient's."""
TABLE = '[[obstacle]]\nname = "table"\nframe = "base"\ncenter_mm = {center}\nsize_mm = {size}\n'


def stating(folder, way, at, more=""):
    """The usual patient's case with a base at this place, its axes the patient's."""
    section = registration_section() if way == "markers" else f"[robot.mount]\nposition_mm = {list(at)}\n{UPRIGHT}"
    path = write_case(folder, text=changed(CASE, (registration_section(), section)) + more)
    rows = [line.split(",") for line in MARKERS.splitlines()]
    moved = [[name, *(str(float(x) - y) for x, y in zip(point, at, strict=True))] for name, *point in rows[1:]]
    write_markers(folder, base="\n".join(",".join(row) for row in [rows[0], *moved]) + "\n")
    return path


def said(path, *, arm=False):
    start = ("robot.mount: ", "registration: by the markers ")
    return [line for line in prepare(path, arm=arm).anatomy.warnings if line.startswith(start)]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("what", list(PLACES))
def test_a_base_that_cannot_be_there_is_told_once(tmp_path, way, what):
    """With a transform it was refused; a mount and markers said nothing in a search without the arm."""
    lines = said(stating(tmp_path, way, PLACES[what]))
    assert len(lines) == bool(what)
    assert all(what in line and "the usual causes are" in line for line in lines)


@pytest.mark.parametrize("way", WAYS)
def test_with_the_arm_a_base_in_the_patient_is_refused(tmp_path, way):
    (inside, far, _) = PLACES.values()
    key = "registration" if way == "markers" else "robot.mount"
    with refused("base_in_patient", "case.toml", key):
        prepare(stating(tmp_path, way, inside), arm=True)
    assert way == "mount" or len(said(stating(tmp_path, way, far), arm=True)) == 1


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("center", "size", "says"),
    [
        ((0.0, 330.0, 0.0), (20.0, 20.0, 20.0), "more than 30 mm deep in obstacle 'table'"),
        ((0.0, 330.0, 0.0), (500.0, 500.0, 500.0), "more than 30 mm deep in obstacle 'table'"),
        ((0.0, 330.0 + 110.0, 0.0), (300.0, 40.0, 300.0), ""),
        ((0.0, 330.0 + 90.0 + 150.0 + 20.0, 0.0), (300.0, 40.0, 300.0), "would float 150 mm above obstacle 'table'"),
    ],
)
def test_the_boxes_of_the_robots_frame_tell_it_too(tmp_path, way, center, size, says):
    """A patient in a table or floating above it; the usual patient lies on the back, so that up is -y."""
    lines = said(stating(tmp_path, way, PLACES[""], TABLE.format(center=list(center), size=list(size))))
    assert len(lines) == bool(says) and all(says in line for line in lines)


def test_a_shoulder_in_an_obstacle_of_the_ct_is_told(tmp_path):
    x, y, z = PLACES[""]
    box = TABLE.replace('"base"', '"ct"').format(center=[x, y, z + 150.0], size=[200.0] * 3)
    (line,) = said(stating(tmp_path, "mount", PLACES[""], box))
    assert "the robot's shoulder would be in obstacle 'table'" in line
