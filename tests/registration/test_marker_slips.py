"""Slips that leave no residual, from outside: permuted names, half turns; refused by name, or flagged everywhere.

The couch that a CT shows is held against the markers as a declared obstacle is: no needle comes through it.
"""

import json
import shutil

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import trimesh
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
from refusals import refused, refused_command

from puncture_twin.meshes import folder as meshes_folder
from puncture_twin.planning.anatomy.anatomy import OUTSIDE_NOT_KNOWN
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.itk_transform import transform_text
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import BAD_INPUT
from puncture_twin.twin.jobs.live.mirror import Mirror

TABLE = '[[obstacle]]\nname = "table"\nframe = "ct"\ncenter_mm = [0.0, 150.0, 0.0]\nsize_mm = [600.0, 40.0, 1200.0]\n'
LOPSIDED = np.array([15.0, 30.0, 40.0])
RADII = np.array([150.0, 100.0, 180.0])
BASE_AXES = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
IN_FRONT = np.array([-450.0, 0.0, 100.0])
"""Where the target is in the base frame: the base stands 450 mm in front of the patient."""


def on_skin(directions, center=LOPSIDED, radii=RADII):
    """Where rays from the ellipsoid's centre leave it, LPS, mm."""
    directions = np.asarray(directions, float)
    return center + directions / np.linalg.norm(directions / radii, axis=1, keepdims=True)


SKIN_MESH = {"mesh": "skin.stl", "unit": "mm", "space": "LPS"}
FRONT = on_skin([[-0.9, -1, 0.3], [0.5, -1, 0.9], [0.1, -1, -0.8], [0.9, -0.7, 0.0], [-0.3, -1, 0.7]])
"""Five markers on the front, without a symmetry."""


def triangle(count=3, radius=50.0):
    """A regular polygon of markers before the target, LPS."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.column_stack([radius * np.cos(angle), np.full(count, -68.0), radius * np.sin(angle)])


def touched(points):
    return points @ BASE_AXES.T + IN_FRONT


@pytest.fixture
def case(tmp_path):
    """A function: a case with an ellipsoid for a body, or one whose skin is found in a CT, and these markers."""

    def make(points_ct, points_base, registration="", more="", center=LOPSIDED, space="LPS", ct=False):
        here = tmp_path / f"case{len(list(tmp_path.iterdir()))}"
        here.mkdir()
        text = case_text(
            registration_section(registration),
            structure("skin", "skin", {"ct": "scan.nii.gz"} if ct else SKIN_MESH),
            ORGAN,
            structure("rib", "avoid"),
            f"{more}\n[end]\nstructures = 3\n",
            name="slips",
            region="phantom",
            space=space,
            needle=NEEDLE.replace("150", "180"),
        )
        (here / "case.toml").write_text(text)
        if ct:
            write_scan(here / "scan.nii.gz", center)
        else:
            body = trimesh.creation.icosphere(subdivisions=5)
            trimesh.Trimesh(body.vertices * RADII + center, body.faces).export(here / "skin.stl")
        write_balls(here, "organ", "rib")
        write_markers(here, points_file(points_ct), points_file(points_base))
        return here

    return make


def registered(here, capfd):
    assert main(["register", str(here), "--json"]) == 0
    return json.loads(capfd.readouterr().out)


def warned(here):
    return prepare(here, arm=False).anatomy.warnings


def test_markers_in_order_raise_no_word(case, capfd):
    """Five markers without a symmetry, on the skin: no warning of them, no flag."""
    here = case(FRONT, touched(FRONT))
    report = registered(here, capfd)
    assert report["warnings"] == []
    assert report["flags"] == []
    assert warned(here) == (OUTSIDE_NOT_KNOWN,)


@pytest.mark.parametrize("name", ["abdomen", "carton/case_h.toml", "carton/case_m.toml", "carton/case_l.toml"])
def test_of_the_embedded_cases_the_carton_alone_is_beyond_its_noise(name, capfd):
    """None is ambiguous or slipped; pixels and slices do not explain the paper's touches, which the case accepts."""
    report = registered(meshes_folder() / name, capfd)
    assert report["warnings"] == []
    told = [flag for flag in report["flags"] if "do not agree with the declared errors" in flag]
    deformed = report["distortion"] is not None and report["distortion"]["doubted"]
    assert (len(report["flags"]) - deformed, len(told)) == ((0, 0) if name == "abdomen" else (1, 1))
    assert deformed == (name != "abdomen")


def beside_their_own_transform(here):
    """Place the robot by a transform that was made from the case's two lists, with their slip in it."""
    placement = load_placement(load_case(here / "case.toml"))
    assert placement is not None
    (here / "t.tfm").write_text(transform_text(placement.T_base_ct))
    stated = '[registration]\ntransform = "t.tfm"\ntransform_maps = "ct_to_base"\nbase_axes = "LPS"\n'
    path = here / "case.toml"
    path.write_text(path.read_text().replace("[registration]\n", stated))


def test_the_abdomens_markers_read_as_ras_are_refused(tmp_path, capfd):
    """x and y negated: FRE stays 0.3 mm; the skin says that they are turned by half a turn, in every command."""
    here = tmp_path / "abdomen"
    shutil.copytree(meshes_folder() / "abdomen", here)
    rows = [line.split(",") for line in (here / "markers_ct.csv").read_text().split()[1:]]
    points = np.array([[float(x) for x in row[1:]] for row in rows])
    text = points_file(points * [-1, -1, 1])
    for row, letter in zip(rows, "ABCDEF", strict=True):
        text = text.replace(f"{letter},", f"{row[0]},", 1)
    (here / "markers_ct.csv").write_text(text)
    for command in (["register", here], ["search", here, "--no-arm", "--out", tmp_path / "out"]):
        refused_command(command, capfd, "other_axes", "x and y negated")
    beside_their_own_transform(here)
    for command in (["register", here], ["search", here, "--no-arm", "--out", tmp_path / "out"]):
        refused_command(command, capfd, "other_axes", "x and y negated")
    assert not (tmp_path / "out").exists()
    with refused("other_axes"):
        Mirror.of(load_case(here))


@pytest.mark.parametrize(("count", "code"), [(3, 0), (4, BAD_INPUT), (5, BAD_INPUT)])
def test_four_of_the_abdomens_markers_show_the_slip_and_three_leave_it_open(count, code, tmp_path, capfd):
    """Where the body is nearly symmetric three markers cannot tell: a warning, with what a half turn would mean."""
    here = tmp_path / "abdomen"
    shutil.copytree(meshes_folder() / "abdomen", here)
    for name, signs in (("markers_ct.csv", [-1, -1, 1]), ("touch.csv", [1, 1, 1])):
        rows = [line.split(",") for line in (here / name).read_text().split()[1:]]
        (here / name).write_text(points_file(np.array([[float(x) for x in row[1:4]] for row in rows[:count]]) * signs))
    assert main(["register", str(here)]) == code
    captured = capfd.readouterr()
    assert "markers_ct with x and y negated" in captured.out or "with x and y negated" in captured.err


@pytest.mark.parametrize(
    ("signs", "space", "name"),
    [
        ([-1, -1, 1], "LPS", "x and y negated"),
        ([1, -1, -1], "LPS", "y and z negated"),
        ([-1, 1, -1], "LPS", "x and z negated"),
        ([1, 1, 1], "RAS", "x and y negated"),
    ],
)
def test_every_half_turn_is_refused_by_name(case, signs, space, name, capfd):
    """Markers off the skin that lie on it after a half turn, or in the space of the case: that slip is named."""
    refused_command(["register", case(FRONT * signs, touched(FRONT), space=space)], capfd, "other_axes", name)


def test_a_round_body_leaves_the_half_turns_open(case, capfd):
    """An ellipsoid about the origin is its own half turn: nothing tells, so each is a warning."""
    points = on_skin(FRONT - LOPSIDED, center=np.zeros(3))
    here = case(points, touched(points), center=np.zeros(3))
    said = registered(here, capfd)["warnings"]
    assert len(said) == 3
    assert all("too similar to decide, and the target would be" in one and "check the axes" in one for one in said)
    assert [one for one in warned(here) if "too similar to decide" in one] == said


def test_the_couch_tells_what_a_round_body_does_not(case, capfd):
    """Given with x and y negated, the markers lie between body and table, where no needle touches them."""
    points = on_skin([[-0.1, -1, 0.3], [0.3, -1, 0.2], [0.1, -1, -0.3]], center=np.zeros(3))
    command = ["register", case(points * [-1, -1, 1], touched(points), more=TABLE, center=np.zeros(3))]
    refused_command(command, capfd, "other_axes", "behind obstacle 'table'")
    said = registered(case(points, touched(points), more=TABLE, center=np.zeros(3)), capfd)["warnings"]
    assert not any("x and y negated" in one or "y and z negated" in one for one in said)


def test_markers_far_from_the_skin_are_a_warning_where_no_slip_explains_them(case):
    """On a frame 60 mm off the skin: said, not refused."""
    points = LOPSIDED + (FRONT - LOPSIDED) * 1.5
    said = warned(case(points, touched(points)))
    assert any("far from the skin" in one for one in said)


@pytest.mark.parametrize("count", [3, 4])
def test_a_symmetric_set_is_refused_unless_accepted(case, count, capfd):
    """Equilateral triangle, square: any slip of names fits with FRE 0; the line names one and what follows."""
    points = triangle(count)
    for names in (slice(None), np.roll(np.arange(count), 1)):
        command = ["register", case(points, touched(points)[names])]
        refused_command(command, capfd, "markers_ambiguous", "FRE 0.00 mm", "registration.accept_symmetry = true")


def test_an_accepted_symmetry_is_flagged_everywhere(case, tmp_path, capfd):
    """`register`, `check`, `search`, their --json and the page say what a slip would do; the error is not 0."""
    here = case(triangle(), touched(triangle()), registration="accept_symmetry = true")
    report = registered(here, capfd)
    assert report["expected_tre_target_mm"] > 0.1
    assert report["expected_tre_target_interval_mm"][1] > 3 * report["expected_tre_target_mm"]
    (said,) = [one for one in report["warnings"] if "accepted by accept_symmetry" in one]
    assert main(["register", str(here)]) == 0
    assert f"warning: {said}" in capfd.readouterr().out
    direction = ["--theta", "5", "--beta", "0", "--no-arm"]
    assert main(["check", str(here), *direction, "--json"]) == 0
    assert said in json.loads(capfd.readouterr().out)["warnings"]
    assert main(["check", str(here), *direction]) == 0
    assert f"warning: {said}" in capfd.readouterr().out
    out = tmp_path / "out"
    assert main(["search", str(here), "--no-arm", "--json", "--out", str(out)]) == 0
    assert said in json.loads(capfd.readouterr().out)["warnings"]
    assert "accepted by accept_symmetry" in (out / "report.html").read_text(encoding="utf-8")


def test_names_that_fit_better_permuted_are_refused_even_if_symmetry_is_accepted(case, capfd):
    """A triangle with one side 12 mm longer, two names swapped: a declared noise says which naming is right."""
    points = triangle() * [1.0, 1.0, 1.12]
    points[0] += [0.0, 0.0, 4.0]
    swapped = touched(points)[[1, 0, 2]]
    keys = "accept_symmetry = true\naccept_residuals = true\nfle_mm = 0.5"
    command = ["register", case(points, swapped, registration=keys)]
    refused_command(command, capfd, "markers_permuted", "A and B", "FRE 0.00 mm")


def test_a_permutation_that_puts_the_robot_elsewhere_is_a_warning(case, capfd):
    """The base stands close before the patient; with two names swapped it would stand in them: said, not refused."""
    points = np.array([[-60.0, -68.0, 0.0], [60.0, -68.0, 0.0], [0.0, -69.0, -110.0]])
    shifted = touched(points) + [200.0, 0.0, 0.0]
    said = registered(case(points, shifted), capfd)["warnings"]
    (swapped,) = [one for one in said if "A and B swapped" in one]
    assert "excluded only because then the robot's base would be in the patient" in swapped


def test_residuals_that_the_case_accepts_are_flagged_everywhere(case, capfd):
    """Declared 0.3 mm against residuals of 2: refused; accepted, the noise is scaled, and every command says so."""
    base = touched(FRONT)
    base[:2] += [[2.0, -2.5, 0.0], [-2.0, 2.5, 1.0]]
    command = ["register", case(FRONT, base, registration="fle_mm = 0.3")]
    refused_command(command, capfd, "residuals_too_large", "fle_mm = 0.3")
    here = case(FRONT, base, registration="fle_mm = 0.3\naccept_residuals = true")
    report = registered(here, capfd)
    assert report["noise_scale"] > 3
    assert report["fle_mm"] == pytest.approx(0.3 * report["noise_scale"])
    assert any("accepted by the case" in flag for flag in report["flags"])
    assert any("does not explain" in one for one in warned(here))


COUCHED = np.array([140.0, 90.0, 170.0])
"""Radii of a body in a CT that shows the couch below it."""
ON_FRONT = np.array([[-0.1, -1, 0.3], [0.3, -1, 0.2], [0.1, -1, -0.3], [-0.2, -1, -0.25]])
BEHIND = "lies behind the couch that the CT shows"


def write_scan(path, center, step_mm=5.0):
    """An ellipsoid in air, and below it a couch of 10 mm; LPS."""
    x, y, z = (np.arange(n) * step_mm - (n - 1) * step_mm / 2 for n in (84, 72, 90))
    Z, Y, X = np.meshgrid(z, y, x, indexing="ij")
    away = np.sqrt(sum(((axis - c) / r) ** 2 for axis, c, r in zip((X, Y, Z), center, COUCHED, strict=True)))
    hu, top = np.where(away < 1, 40.0, -1000.0), center[1] + COUCHED[1] + 20.0
    hu[(top < Y) & (top + 12.0 > Y) & (np.abs(X) < 200.0)] = 100.0
    hu += np.random.default_rng(5).normal(0, 10, hu.shape)
    image = sitk.GetImageFromArray(hu.astype(np.int16))
    image.SetSpacing([step_mm] * 3)
    image.SetOrigin([float(axis[0]) for axis in (x, y, z)])
    sitk.WriteImage(image, str(path))


def on_couch(case, directions, center=(0.0, 0.0, 0.0), signs=(1, 1, 1)):
    """A case of markers on a body on a couch, whose list in the CT has these signs."""
    points = on_skin(directions, np.array(center), COUCHED)
    return case(points * signs, touched(points), "accept_symmetry = true", center=center, ct=True)


def of_readings(here):
    return [one for one in warned(here) if "negated" in one or "behind" in one]


def test_markers_that_lie_on_the_couch_are_refused_with_every_reading_that_fits(case, capfd):
    """A round body: the skin tells nothing, and the list was taken with a warning. Two half turns explain it."""
    here = on_couch(case, ON_FRONT, signs=(-1, -1, 1))
    for command in (["register", here], ["search", here, "--no-arm", "--out", here / "out"]):
        line = refused_command(command, capfd, "other_axes")
        assert BEHIND in line and "with x and y negated" in line and "or with y and z negated" in line
        assert "x and z negated" not in line and "where no needle can touch it" in line
    assert not (here / "out").exists()


def test_of_two_half_turns_the_one_that_lies_off_the_skin_is_not_named(case, capfd):
    """The body lies higher in the image, so y and z negated is in the air: it was named where its rms was less."""
    command = ["register", on_couch(case, ON_FRONT, (0.0, 0.0, 40.0), (-1, -1, 1))]
    assert "y and z negated" not in refused_command(command, capfd, "other_axes", BEHIND, "with x and y negated")


def test_markers_on_the_front_are_not_doubted_for_readings_behind_the_couch(case):
    """Of the three half turns the one that stays on the front is left."""
    found = of_readings(on_couch(case, ON_FRONT))
    assert len(found) == 1 and "markers_ct with x and z negated" in found[0]


def test_markers_on_the_back_that_no_half_turn_explains_are_a_warning(case):
    """A patient who was turned over: said, not refused, since nothing is certain."""
    found = of_readings(on_couch(case, ON_FRONT * [1, -1, 1], (40.0, -45.0, 30.0)))
    assert [one[:8] for one in found if BEHIND in one] == ["marker A", "marker C", "marker D"]  # B lies at the side
    assert len(found) == 3


NAMES = ("M1", "M2", "M3", "M4", "M5")
POINTS = np.array([[0.0, -90, 10], [60, -70, 40], [-50, -80, 20], [10, -85, 95], [-45, -75, 120]])
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
TOUCHED = apply(pose(TURN, np.array([300.0, 100, 50])), POINTS) + np.random.default_rng(3).normal(0, 0.1, (5, 3))


SWAPPED = ("M2", "M1", *NAMES[2:])


@pytest.mark.parametrize(
    ("code", "lists", "says", "silent"),
    [
        ("wrong_unit", {"scale": 0.001}, "5 mm at least", "fit"),
        ("wrong_unit", {"scale": 0.02}, "5 mm at least", "fit"),
        ("marker_misses", {"base": SWAPPED}, "with M1 and M2 swapped they would fit (FRE 0.", "touched as"),
        ("marker_misses", {"base": (*NAMES[:2], "M5", "M4", "M3")}, "with M3 and M5 swapped they would fit", "M2"),
        ("marker_misses", {"base": ("M2", "M3", "M1", "M4", "M5")}, "with M1, M2, M3 touched as ", "M4"),
        ("residuals_too_large", {"base": SWAPPED, "scale": 0.15, "fle": "0.2"}, "M1 and M2 swapped", "M3"),
        ("marker_misses", {"slip": 40.0}, "M3", "would fit"),
        ("markers_missing", {"ct": ("M1", "m2", *NAMES[2:])}, "did you mean 'm2'?", "would fit"),
        ("markers_missing", {"ct": ("M1", "apex", *NAMES[2:])}, "M2", "did you mean"),
    ],
)
def test_two_lists_that_do_not_go_together_are_refused_with_what_explains_it(
    tmp_path, capfd, code, lists, says, silent
):
    """Metres, which fit each other; swapped names, also of near markers; a touch that slipped; other spellings."""
    touched_at = TOUCHED + [[0, lists.get("slip", 0.0) * (row == 2), 0] for row in range(5)]
    for path, names, points in (("ct", lists.get("ct", NAMES), POINTS), ("base", lists.get("base", NAMES), touched_at)):
        (tmp_path / f"{path}.csv").write_text(points_file(lists.get("scale", 1.0) * points, names))
    command = ["register", tmp_path / "ct.csv", tmp_path / "base.csv", "--target", "0,0,5"]
    line = refused_command([*command, *(["--fle", lists["fle"]] if "fle" in lists else [])], capfd, code, says)
    assert silent not in line
