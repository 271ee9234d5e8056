"""The couch that a CT shows is held against the markers, as a declared obstacle is: no needle comes through it."""

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import (
    NEEDLE,
    ORGAN,
    case_text,
    points_file,
    registration_section,
    structure,
    write_balls,
    write_markers,
)
from refusals import refused_command

from puncture_twin.planning.search.context import prepare

STEP_MM = 5.0
RADII = np.array([140.0, 90.0, 170.0])
BASE_AXES = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
IN_FRONT = np.array([-450.0, 0.0, 100.0])
DIRECTIONS = np.array([[-0.1, -1, 0.3], [0.3, -1, 0.2], [0.1, -1, -0.3], [-0.2, -1, -0.25]])
"""Of markers on the front."""
BEHIND = "lies behind the couch that the CT shows"


def scan(path, center, couch):
    """An ellipsoid in air, and below it a couch of 10 mm; LPS."""
    sizes = (84, 72, 90)
    x, y, z = (np.arange(n) * STEP_MM - (n - 1) * STEP_MM / 2 for n in sizes)
    Z, Y, X = np.meshgrid(z, y, x, indexing="ij")
    away = np.sqrt(sum(((axis - c) / r) ** 2 for axis, c, r in zip((X, Y, Z), center, RADII, strict=True)))
    hu = np.where(away < 1, 40.0, -1000.0)
    if couch:
        top = center[1] + RADII[1] + 20.0
        hu[(top < Y) & (top + 12.0 > Y) & (np.abs(X) < 200.0)] = 100.0
    hu += np.random.default_rng(5).normal(0, 10, hu.shape)
    image = sitk.GetImageFromArray(hu.astype(np.int16))
    image.SetSpacing([STEP_MM] * 3)
    image.SetOrigin([float(axis[0]) for axis in (x, y, z)])
    sitk.WriteImage(image, str(path))


def on_skin(directions, center):
    return center + directions / np.linalg.norm(directions / RADII, axis=1, keepdims=True)


@pytest.fixture
def case(tmp_path):
    """A function: a case whose skin is found in a CT, with these markers as given and as they were touched."""

    def make(given, touched, center=(0.0, 0.0, 0.0), couch=True):
        scan(tmp_path / "scan.nii.gz", center, couch)
        text = case_text(
            registration_section("accept_symmetry = true"),
            structure("skin", "skin", {"ct": "scan.nii.gz"}),
            ORGAN,
            structure("rib", "avoid"),
            "\n[end]\nstructures = 3\n",
            region="phantom",
            needle=NEEDLE.replace("150", "180"),
        )
        (tmp_path / "case.toml").write_text(text)
        write_balls(tmp_path, "organ", "rib")
        write_markers(tmp_path, points_file(given), points_file(touched @ BASE_AXES.T + IN_FRONT))
        return tmp_path

    return make


def said(here):
    return [one for one in prepare(here, arm=False).anatomy.warnings if "negated" in one or "behind" in one]


def test_markers_that_lie_on_the_couch_are_refused_with_every_reading_that_fits(case, capfd):
    """A round body: the skin tells nothing, and the list was taken with a warning. Two half turns explain it."""
    points = on_skin(DIRECTIONS, np.zeros(3))
    here = case(points * [-1, -1, 1], points)
    for command in (["register", here], ["search", here, "--no-arm", "--out", here / "out"]):
        line = refused_command(command, capfd, "other_axes")
        assert BEHIND in line and "with x and y negated" in line and "or with y and z negated" in line
        assert "x and z negated" not in line and "where no needle can touch it" in line
    assert not (here / "out").exists()


def test_of_two_half_turns_the_one_that_lies_off_the_skin_is_not_named(case, capfd):
    """The body lies higher in the image, so y and z negated is in the air: it was named where its rms was less."""
    center = np.array([0.0, 0.0, 40.0])
    points = on_skin(DIRECTIONS, center)
    command = ["register", case(points * [-1, -1, 1], points, center)]
    assert "y and z negated" not in refused_command(command, capfd, "other_axes", BEHIND, "with x and y negated")


def test_markers_on_the_front_are_not_doubted_for_readings_behind_the_couch(case):
    """Of the three half turns the one that stays on the front is left."""
    points = on_skin(DIRECTIONS, np.zeros(3))
    found = said(case(points, points))
    assert len(found) == 1 and "markers_ct with x and z negated" in found[0]


def test_markers_on_the_back_that_no_half_turn_explains_are_a_warning(case):
    """A patient who was turned over: said, not refused, since nothing is certain."""
    center = np.array([40.0, -45.0, 30.0])
    back = on_skin(DIRECTIONS * [1, -1, 1], center)
    found = said(case(back, back, center))
    assert [one[:8] for one in found if BEHIND in one] == ["marker A", "marker C", "marker D"]  # B lies at the side
    assert len(found) == 3
