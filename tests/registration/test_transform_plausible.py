"""A stated transform is held against markers, against the boxes about the robot, and against the vertical."""

import numpy as np
import pytest
from case_world import CASE, changed, points_file, registration_section, write_case
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import load_skin
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.tables import other_readings
from puncture_twin.planning.formats.itk_transform import transform_text
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, inverse, pose
from puncture_twin.planning.registration.checks.checked_placement import (
    check_transform,
    marker_registration,
    placement_findings,
)
from puncture_twin.planning.registration.checks.markers import Surroundings
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.jobs.patient.answers import registration_report

UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""R_base_ct of an arm on the floor beside a patient on the back: x to their left, y to the head, z to the front."""
T_BASE_CT = pose(UPRIGHT, [330.0, 60.0, 150.0])
"""The base on the patient's right, 150 mm below the target."""
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
MARKERS = np.array([[0.0, 0.0, 80.0], [50.0, 0.0, 75.0], [0.0, 60.0, 70.0], [-40.0, -30.0, 72.0]])
"""Of the usual patient."""
UNMEASURED = (
    "registration: stated transform t.tfm: no residuals, expected error unknown (markers_ct and markers_base with it "
    "would check it)",
)
"""All that is left to say of a transform that boxes agree with."""
KEYS = [("ct_to_base", "LPS"), ("ct_to_base", "RAS"), ("base_to_ct", "LPS"), ("base_to_ct", "RAS")]


def saved_as(T_base_ct, maps, axes):
    T = FLIP @ T_base_ct if axes == "RAS" else T_base_ct
    return inverse(T) if maps == "base_to_ct" else T


def stating(folder, T_base_ct=T_BASE_CT, saved=KEYS[0], keys=KEYS[0], more="", boxes=()):
    """The usual patient's case with a transform that was saved under some keys and is stated under others."""
    section = f'[registration]\ntransform = "t.tfm"\ntransform_maps = "{keys[0]}"\nbase_axes = "{keys[1]}"\n{more}\n'
    text = changed(CASE, (registration_section(), section))
    for name, center, size in boxes:
        middle = [float(x) for x in center]
        text += f'[[obstacle]]\nname = "{name}"\nframe = "base"\ncenter_mm = {middle}\nsize_mm = {list(size)}\n'
    path = write_case(folder, text=text)
    (folder / "t.tfm").write_text(transform_text(saved_as(T_base_ct, *saved)))
    return path


def touched(folder, T_base_ct, off_mm=0.0, names="ABCD"):
    """Touches of the markers by an arm at this place, moved by so much; returns the keys that name both lists."""
    points = apply(T_base_ct, MARKERS) + np.array([off_mm, 0.0, 0.0])
    (folder / "touched.csv").write_text(points_file(points, names))
    return 'markers_ct = "markers_ct.csv"\nmarkers_base = "touched.csv"\n'


def table(top_mm, thick_mm=40.0):
    """A table in the robot's frame, on the side where the patient lies; its top at this height."""
    return ("table", (330.0, 60.0, top_mm - thick_mm / 2), (400.0, 900.0, thick_mm))


BELOW_MM = 60.0
"""The height of the patient's lowest point above the base: the ball of 90 mm about 150 mm."""


def warnings_of(path):
    """Those of the registration, of the case as a search reads it without its arm."""
    return [line for line in prepare(path, arm=False).anatomy.warnings if line.startswith("registration: ")]


def compared(path):
    """Of these the line that compares the transform with markers."""
    return [line for line in warnings_of(path) if "from its position by the stated transform" in line]


@pytest.mark.parametrize("keys", KEYS[2:])
def test_an_inverse_that_is_stated_the_wrong_way_is_named(tmp_path, keys):
    """It said only that there are no residuals. The robot's z axis would not point up."""
    said = warnings_of(stating(tmp_path, keys=keys))
    (line,) = [one for one in said if "would be more usual than the stated keys" in one]
    assert "(the patient lies on no obstacle of frame base and the robot's z axis" in line and "another image" in line
    assert 'transform_maps = "ct_to_base"' in line


def test_what_nothing_tells_apart_is_said(tmp_path):
    """Other axes at the robot turn the patient about the base: without a box of its frame, they are as plausible."""
    said = warnings_of(stating(tmp_path))
    away = 2 * np.hypot(330.0, 60.0)
    (line,) = said
    assert "no residuals" in line and "the stated transform cannot be distinguished" in line
    assert f'base_axes = "RAS" ({away:.0f} mm away)' in line and "transform_maps" not in line
    assert "markers_ct and markers_base with it would check it" in line and "an obstacle of frame base" in line


def test_a_table_tells_the_axes(tmp_path):
    """As stated the patient lies on the table, and only its error is not known; turned, on nothing."""
    (line,) = warnings_of(stating(tmp_path, boxes=[table(BELOW_MM - 5.0)]))
    assert line.endswith("no residuals, expected error unknown (markers_ct and markers_base with it would check it)")
    (_, line) = warnings_of(stating(tmp_path, keys=("ct_to_base", "RAS"), boxes=[table(BELOW_MM - 5.0)]))
    assert (
        "would be more usual than the stated keys" in line
        and "base_axes = \"LPS\" (the patient lies on 'table'" in line
    )


@pytest.mark.parametrize(
    ("top_mm", "says"),
    [
        (BELOW_MM - 150.0, "the patient would float 150 mm above obstacle 'table'"),
        (BELOW_MM + 180.0 + 40.0 + 75.0, "the patient would lie 75 mm under obstacle 'table'"),
        (BELOW_MM - 90.0, ""),
        (BELOW_MM - 600.0, ""),
    ],
)
def test_a_patient_off_the_table_is_told(tmp_path, top_mm, says):
    """Floating above it or lying under it, as a transform of another image has it; a floor is no table."""
    (said,) = [one for one in warnings_of(stating(tmp_path, boxes=[table(top_mm)])) if "no residuals" not in one] or [
        ""
    ]
    assert says in said and ("by the stated transform" in said) == bool(says)


@pytest.mark.parametrize(
    ("box", "wrong"),
    [
        (table(BELOW_MM - 50.0), False),
        (table(BELOW_MM + 18.0), False),
        (table(BELOW_MM + 22.0), True),
        (table(BELOW_MM + 28.0, 100.0), False),
        (table(BELOW_MM + 33.0, 100.0), True),
        (table(BELOW_MM + 70.0), True),
        (("pedestal", (330.0, 60.0, 150.0), (20.0, 20.0, 20.0)), True),
        (("room", (330.0, 60.0, 150.0), (500.0, 500.0, 500.0)), True),
        (("rail", (330.0, 200.0, 150.0), (400.0, 40.0, 40.0)), False),
    ],
)
def test_a_patient_in_a_box_of_the_robots_frame_is_refused(tmp_path, box, wrong):
    """Deeper than 30 mm, or beyond its middle; and a box wholly within the patient. A mattress may give way."""
    path = stating(tmp_path, boxes=[box])
    if not wrong:
        assert prepare(path, arm=False)
        return
    with refused("transform_implausible", "30", box[0]) as told:
        prepare(path, arm=False)
    assert "transform_maps (the" not in told.value.what and "base_axes" in told.value.what


def test_a_base_in_the_patient_is_refused_with_its_causes(tmp_path):
    inside = pose(UPRIGHT, [20.0, 0.0, 30.0])
    with refused("transform_implausible"):
        prepare(stating(tmp_path, inside), arm=False)


def test_markers_that_agree_are_named_with_their_distance(tmp_path):
    """By `register`, and no result is doubted: it was a warning like one of a contradiction."""
    path = stating(tmp_path, more=touched(tmp_path, T_BASE_CT, 0.2) + "fle_mm = 0.5\n")
    assert warnings_of(path) == []
    case = load_case(path)
    assert {"transform", "markers_ct", "markers_base"} <= {one.role for one in case.inputs}
    found = placement_findings(case, Surroundings(load_skin(case), None), load_placement(case))
    (line, *_) = [one.sentence for one in found if one.severity == "note"]
    assert "no residuals" not in line and "0.2 mm from its position by the stated transform" in line
    assert line.endswith("own expected error is unknown") and "more than" not in line
    with refused("no_markers", "t.tfm", "0.2"):
        registration_report(tmp_path)


def test_markers_that_agree_do_not_silence_what_physics_doubts(tmp_path):
    """Lists and transform may be of the same other image: the patient floats all the same."""
    more = touched(tmp_path, T_BASE_CT) + "fle_mm = 0.5\n"
    said = warnings_of(stating(tmp_path, more=more, boxes=[table(BELOW_MM - 150.0)]))
    assert any("the patient would float 150 mm above obstacle 'table'" in line for line in said)


def test_markers_beside_a_transform_are_checked_as_those_that_place_the_robot(tmp_path):
    beside = MARKERS * np.array([[1.1], [1.4], [1.2], [1.7]])
    more = touched(tmp_path, T_BASE_CT) + "fle_mm = 0.5\n"
    path = stating(tmp_path, more=more)
    (tmp_path / "markers_ct.csv").write_text(points_file(beside, "ABCD"))
    (tmp_path / "touched.csv").write_text(points_file(apply(T_BASE_CT, beside), "ABCD"))
    assert any("skin" in line for line in prepare(path, arm=False).anatomy.warnings)


@pytest.mark.parametrize("keys", KEYS[1:])
def test_markers_refuse_another_reading_and_name_the_one_that_fits(tmp_path, keys):
    more = touched(tmp_path, T_BASE_CT, 0.1) + "fle_mm = 0.5\n"
    right = " and ".join(
        f'{name} = "{value}"'
        for name, value, stated in zip(("transform_maps", "base_axes"), KEYS[0], keys, strict=True)
        if value != stated
    )
    with refused("transform_implausible", right):
        prepare(stating(tmp_path, keys=keys, more=more), arm=False)


def test_a_transform_of_another_image_is_refused_by_markers(tmp_path):
    """Moved by 12 mm: no reading of the keys fits, and none is named."""
    with refused("transform_implausible", "12.0") as told:
        prepare(stating(tmp_path, more=touched(tmp_path, T_BASE_CT, 12.0) + "fle_mm = 0.5\n"), arm=False)
    assert "they agree" not in told.value.what


@pytest.mark.parametrize(
    ("declared", "off_mm", "doubted"),
    [
        ("fle_mm = 0.5\n", 3.0, True),
        ("fle_mm = 4.0\n", 3.0, False),
        ("accept_symmetry = true\n[errors]\nct_pixel_mm = 0.3\nct_spacing_mm = 1.0\ntouch_mm = 0.3\n", 4.0, True),
        ("accept_symmetry = true\n[errors]\nct_pixel_mm = 4.0\nct_spacing_mm = 1.0\ntouch_mm = 4.0\n", 4.0, False),
    ],
)
def test_markers_that_are_off_by_more_than_the_declared_errors_are_doubted(tmp_path, declared, off_mm, doubted):
    lines = compared(stating(tmp_path, more=touched(tmp_path, T_BASE_CT, off_mm) + declared))
    assert len(lines) == doubted
    said = f"{off_mm} mm from its position by the stated transform"
    assert all(said in line and "more than their errors explain" in line for line in lines)


@pytest.mark.parametrize("keys", KEYS)
def test_the_readings_are_what_other_keys_say(tmp_path, keys):
    """Each of the three is what the same file gives under its keys, whichever way it was saved."""
    path = stating(tmp_path, saved=keys, keys=keys)
    case = load_case(path)
    found = {"": case.robot.T_base_ct_mount, **other_readings(case.robot.stated, case.robot.T_base_ct_mount)}
    assert found[""] == pytest.approx(T_BASE_CT)
    assert len(found) == 4
    for other in KEYS:
        texts = (f'transform_maps = "{other[0]}"', f'base_axes = "{other[1]}"')
        name = " and ".join(text for text, a, b in zip(texts, other, keys, strict=True) if a != b)
        again = load_case(stating(tmp_path, saved=keys, keys=other)).robot.T_base_ct_mount
        assert found[name] == pytest.approx(again)


def test_honest_markers_hardly_ever_doubt_an_honest_transform(tmp_path, ball):
    """Touches with the declared error, and a transform that other touches with that error gave; one exact: none."""
    rng, skin = np.random.default_rng(20261125), ball(90.0)
    fle_mm, base, doubted = 4.0, apply(T_BASE_CT, MARKERS), 0
    for row in range(60):
        first, second = base + rng.normal(0.0, fle_mm / np.sqrt(3.0), (2, *base.shape))
        (tmp_path / "touched.csv").write_text(points_file(first))
        T = T_BASE_CT if row % 2 else fit_rigid(MARKERS, second)
        lists = f'markers_ct = "markers_ct.csv"\nmarkers_base = "touched.csv"\nfle_mm = {fle_mm}\n'
        case = load_case(stating(tmp_path, T, more=lists))
        registration = marker_registration(case, case.robot.stated)
        found = check_transform(case, skin, case.robot.T_base_ct_mount, registration)
        unexplained = any(one.code == "transform_and_markers" and one.severity == "warning" for one in found)
        assert row % 2 == 0 or not unexplained
        doubted += unexplained
    assert doubted <= 3


def sentences(case, skin):
    return tuple(one.sentence for one in check_transform(case, skin, case.robot.T_base_ct_mount))


def test_honest_placements_are_never_refused_and_their_slips_are_told(tmp_path, ball):
    """Arms that stand beside a patient on a table of the robot's frame, turned and tilted a little."""
    rng, skin = np.random.default_rng(20261124), ball(90.0)
    told = 0
    for _ in range(20):
        height = rng.uniform(100.0, 250.0)
        turn = exp_rotation([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        lean = exp_rotation(rng.uniform(-0.1, 0.1, 3))
        angle = rng.uniform(-np.pi, np.pi)
        at = rng.uniform(250.0, 400.0) * np.array([np.cos(angle), np.sin(angle), 0.0])
        T = pose(lean @ turn @ UPRIGHT, at + [0.0, 0.0, height])
        box = ("table", (at[0], at[1], height - 95.0 - 20.0), (300.0, 300.0, 40.0))
        case = load_case(stating(tmp_path, T, boxes=[box]))
        assert sentences(case, skin) == UNMEASURED
        for saved in KEYS[1:]:
            slipped = load_case(stating(tmp_path, T, saved=saved, boxes=[box]))
            try:
                told += sentences(slipped, skin) != UNMEASURED
            except InputError:
                told += 1
    assert told == 60
