"""The case file: what it means, and every way in which it is refused with one clear line."""

import hashlib
import shutil
import tomllib

import numpy as np
import pytest
from case_world import ORGAN, SKIN, case_text, changed
from cohort_world import tiny_text, write_patient
from pydantic import ValidationError
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS, SpeedLimits
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.case_file import case_options, case_schema
from puncture_twin.planning.case.errors import Cells, error_model
from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.case.tables import ErrorsSection, MountSection
from puncture_twin.planning.geometry.spaces import Space

GOOD = case_text(
    SKIN,
    ORGAN,
    name="one",
    target='position_mm = [1.0, 2.0, 3.0]\nstructure = "organ"',
    search="theta_deg = [0, 60]\nstep_deg = 5.0",
)


@pytest.fixture
def write(tmp_path):
    """A function that writes a case, with its text changed, and returns its path."""
    for name in ("skin.stl", "organ.stl"):
        (tmp_path / name).write_bytes(name.encode())

    def make(*changes, text=GOOD):
        path = tmp_path / "case.toml"
        path.write_text(changed(text, *changes))
        return path

    return make


def test_a_good_case_is_read(write):
    case = load_case(write())
    assert (case.name, case.space, case.target_structure) == ("one", Space.LPS, "organ")
    np.testing.assert_array_equal(case.target_ct, [1, 2, 3])
    assert case.search.theta == (0, pytest.approx(np.pi / 3))
    assert case.search.max_skin_angle == pytest.approx(np.pi / 3)
    assert case.needle.radius_mm == 0.6
    inputs = {"case": "case.toml", "mesh skin": "skin.stl", "mesh organ": "organ.stl"}
    assert [(one.role, one.path) for one in case.inputs] == list(inputs.items())
    assert case.inputs[2].sha256 == hashlib.sha256(b"organ.stl").hexdigest()
    assert case.registration is None
    assert load_case(case.folder).name == "one"
    np.testing.assert_array_equal(case.T_ct_entry[:3, 2:], [[0, 1], [-1, 2], [0, 3]])  # z to the front, at the target


def test_a_ras_case_is_turned_to_lps(write):
    mount = "\n[robot.mount]\nposition_mm = [10, 20, 30]\nx_axis = [1, 0, 0]\nz_axis = [0, 0, 1]\n"
    case = load_case(write(('"LPS"', '"RAS"'), text=GOOD + mount))
    np.testing.assert_array_equal(case.target_ct, [-1, -2, 3])
    T_ct_base = np.linalg.inv(case.robot.T_base_ct_mount)
    np.testing.assert_allclose(T_ct_base[:3, 3], [-10, -20, 30])
    np.testing.assert_allclose(T_ct_base[:3, 0], [-1, 0, 0])
    assert np.linalg.det(T_ct_base[:3, :3]) == pytest.approx(1)


def test_a_target_may_come_from_a_file_of_points(write, tmp_path):
    (tmp_path / "targets.csv").write_text("name,x_mm,y_mm,z_mm\nA,4,5,6\n")
    path = write(("position_mm = [1.0, 2.0, 3.0]", 'points = "targets.csv"\nname = "A"'))
    np.testing.assert_array_equal(load_case(path).target_ct, [4, 5, 6])
    path = write(("position_mm = [1.0, 2.0, 3.0]", 'points = "targets.csv"\nname = "B"'))
    with refused("unknown_point", "targets.csv"):
        load_case(path)


BAD = {
    "unknown key": (("diameter_mm", "diamter_mm"), "unknown_key diamter_mm diameter_mm"),
    "metres under a mm key": (("length_mm = 210.0", "length_mm = 0.21"), "bad_value needle.length_mm 20"),
    "another schema": (("schema = 2", "schema = 1"), "unknown_version"),
    "no schema": (("schema = 2", ""), "unknown_version"),
    "true for a number": (("diameter_mm = 1.2", "diameter_mm = true"), "bad_value needle.diameter_mm"),
    "nan": (("diameter_mm = 1.2", "diameter_mm = nan"), "bad_value needle.diameter_mm"),
    "negative": (("diameter_mm = 1.2", "diameter_mm = -1.2"), "bad_value needle.diameter_mm 0.1"),
    "two coordinates": (("[1.0, 2.0, 3.0]", "[1.0, 2.0]"), "missing_key target.position_mm"),
    "no target": (("position_mm = [1.0, 2.0, 3.0]", ""), "not_one_source position_mm"),
    "shaft longer than the needle": (("shaft_mm = 150.0", "shaft_mm = 250.0"), "out_of_range shaft_mm 250 length_mm"),
    "descending range": (("[0, 60]", "[60, 0]"), "range_descends theta_deg"),
    "another space": (('"LPS"', '"LAS"'), "bad_value LPS RAS local"),
    "bed frame in a local space": (('space = "LPS"', 'space = "local"'), "local_space search.frame ct"),
    "unknown role": (('role = "target"', 'role = "avoidd"'), "bad_value organ avoid"),
    "two skins": (('role = "target"', 'role = "skin"'), "not_one_skin skin"),
    "no skin": (('role = "skin"', 'role = "traverse"'), "not_one_skin skin"),
    "a name twice": (('name = "skin"', 'name = "organ"'), "duplicate_name organ"),
    "two sources": (('mesh = "organ.stl"', 'mesh = "organ.stl"\nlabelmap = "a.nii"\nlabel = 3'), "not_one_source mesh"),
    "no source": (('mesh = "organ.stl"\nunit = "mm"', ""), "not_one_source"),
    "label map without a label": (('mesh = "organ.stl"\nunit = "mm"', 'labelmap = "seg.nii"'), "keys_together"),
    "mesh without a unit": (('mesh = "organ.stl"\nunit = "mm"', 'mesh = "organ.stl"'), "unit_not_stated"),
    "cut of an organ's mesh": (('role = "target"', 'role = "target"\ncut = []'), "key_not_of_it cut"),
    "margin on the wrong role": (('role = "target"', 'role = "target"\nmargin_mm = 3'), "key_not_of_it margin_mm"),
    "missing file": (('mesh = "organ.stl"', 'mesh = "gone.stl"'), "no_such_file organ gone.stl"),
    "a name with a path": (('name = "one"', 'name = "../one"'), "bad_name"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_broken_case_is_refused_in_one_line(name, write):
    change, message = BAD[name]
    text = GOOD.replace("theta_deg = [0, 60]", 'theta_deg = [0, 60]\nframe = "bed"') if "local" in name else GOOD
    with refused(*message.split(), "case.toml"):
        load_case(write(change, text=text))


@pytest.mark.parametrize(
    ("added", "message"),
    [
        ('[registration]\nmarkers_ct = "a.csv"\nmarkers_base = "b.csv"', "no_such_file registration.markers_ct a.csv"),
        ('[registration]\nmarkers_ct = "skin.stl"\nmarkers_base = "skin.stl"\n[robot.mount]\nposition_mm=[0,0,0]\n'
         'x_axis=[1,0,0]\nz_axis=[0,0,1]', "stated_twice"),
        ("[robot.mount]\nposition_mm=[0,0,0]\nx_axis=[0,0,2]\nz_axis=[0,0,1]", "axes_parallel"),
        ('[robot]\nhome_deg = [0, 0, 0]', "missing_key robot.home_deg"),
        ('[[structures]]\nlabelmap = "gone.nii.gz"\nnaming = "totalsegmentator-v2"', "no_such_file gone.nii.gz"),
    ],
)  # fmt: skip
def test_contradictions_with_the_robot_are_refused(added, message, write):
    """Registration, mount and label maps are held against each other and the folder."""
    with refused(*message.split()):
        load_case(write(text=GOOD + added))


def test_what_is_no_case_file_is_refused(tmp_path):
    path = tmp_path / "case.toml"
    with refused("no_such_file", "case.toml"):
        load_case(tmp_path)
    for content in (b"\x00\xff\xfe binary", b"schema = ", b"", b"# " + b"x" * 2_000_000):
        path.write_bytes(content)
        with refused("not_toml" if 0 < len(content) < 100 else "file_size"):
            load_case(path)


@pytest.mark.parametrize("name", ["Müller 1", "患者 3", "Mu\u0308ller", "a.b-c_d"])
def test_a_patient_of_any_alphabet_has_a_case(name, write):
    """Umlauts, composed or not, and other scripts: exports to robots write them plainly, all else as they are."""
    assert load_case(write(text=GOOD.replace('name = "one"', f'name = "{name}"'))).name == name


def unknown_keys(value, schema, definitions):
    """Keys of a case that its JSON Schema does not have, anywhere below."""
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    if "anyOf" in schema:
        return min((unknown_keys(value, one, definitions) for one in schema["anyOf"]), key=len)
    if isinstance(value, list):
        return [key for one in value for key in unknown_keys(one, schema.get("items", {}), definitions)]
    if not isinstance(value, dict):
        return []
    rest = schema.get("additionalProperties") or None
    kinds = {key: schema.get("properties", {}).get(key, rest) for key in value}
    below = [found for key, kind in kinds.items() if kind for found in unknown_keys(value[key], kind, definitions)]
    return [key for key, kind in kinds.items() if kind is None] + below


@pytest.mark.parametrize("name", ["abdomen/case.toml", "carton/case_h.toml"])
def test_the_json_schema_has_the_keys_of_every_case_and_no_others(name):
    """`run-twin schema`: what an editor completes, and what it marks."""
    schema = case_schema()
    data = tomllib.loads((folder() / name).read_text(encoding="utf-8"))
    assert unknown_keys(data, schema, schema["$defs"]) == []
    data["needle"]["lenght_mm"] = 1.0
    assert unknown_keys(data | {"serch": {}}, schema, schema["$defs"]) == ["serch", "lenght_mm"]


@pytest.fixture
def carton(tmp_path):
    shutil.copytree(folder() / "carton", tmp_path, dirs_exist_ok=True)
    path = tmp_path / "case_m.toml"
    text = path.read_text(encoding="utf-8")

    def read(*lines):
        path.write_text(text.replace("[robot]\n", "\n".join(["[robot]", *lines, ""])), encoding="utf-8")
        return load_case(path)

    return read


def test_speeds_are_read_and_reduced_by_default(carton):
    """250 mm/s on the way, 10 mm/s in, half of the joints' speed."""
    assert carton().robot.speeds == DEFAULT_SPEEDS == SpeedLimits(250.0, 10.0, 0.5, 1.0)
    lines = ["tip_speed_mm_s = 100", "insertion_speed_mm_s = 5", "joint_speed_fraction = 0.2"]
    assert carton(*lines, "joint_acceleration_fraction = 0.3").robot.speeds == SpeedLimits(100.0, 5.0, 0.2, 0.3)


@pytest.mark.parametrize(
    "line",
    ["tip_speed_mm_s = 1001", "tip_speed_mm_s = 0", "insertion_speed_mm_s = 101", "joint_speed_fraction = 1.1"]
    + ["joint_acceleration_fraction = 0", "insertion_speed_mm_s = 50\ntip_speed_mm_s = 20"],
)
def test_what_is_no_limit_is_refused(carton, line):
    with refused("out_of_range" if "\n" in line else "bad_value", line.split()[0]):
        carton(line)


@pytest.mark.parametrize(
    ("position", "z", "told"),
    [
        ((600.0, 20.0, -30.0), (0.0, -1.0, 0.0), None),
        ((0.0, 0.0, 0.0), (0.0, -1.0, 0.0), None),
        *(
            (metres, (0.0, -1.0, 0.0), "wrong_unit")
            for metres in ((0.6, 0.02, -0.03), (0.0, 0.0, -1.2), (2.0, 0.0, 0.5))
        ),
        ((600.0, 0.0, 0.0), (0.5, 0.75**0.5, 0.0), "axes_not_square 60.0"),
    ],
)
def test_a_mount_is_in_millimetres_and_square(position, z, told):
    mount = MountSection(position_mm=position, x_axis=(1.0, 0.0, 0.0), z_axis=z)
    if told is None:
        T_ct_base = np.linalg.inv(mount_pose(mount, Space.LPS, "case.toml"))
        assert T_ct_base[:3, 3] == pytest.approx(position)
        return
    with refused(*told.split()):
        mount_pose(mount, Space.LPS, "case.toml")


def model(space=Space.LPS, cells=None, fle_mm=None, **keys):
    return error_model(ErrorsSection(**keys), space=space, cells=cells, fle_mm=fle_mm)


def test_a_cell_makes_a_uniform_error():
    """Cell over root 12 in each axis: 1 and 5 mm give .29, .29, 1.44, across the slices along z."""
    found = model(ct_pixel_mm=1.0, ct_spacing_mm=5.0)
    np.testing.assert_allclose(np.sqrt(np.diag(found.marker_cov_ct)), [0.2887, 0.2887, 1.4434], atol=1e-4)
    np.testing.assert_array_equal(found.marker_cov_ct, found.target_cov_ct)
    assert found.anisotropic


def test_the_case_s_own_ct_gives_what_is_not_stated():
    found = model(cells=Cells(0.7, 3.0, np.array([0.0, 1.0, 0.0])))
    np.testing.assert_allclose(np.sqrt(np.diag(found.marker_cov_ct)), np.array([0.7, 3.0, 0.7]) / np.sqrt(12))
    assert not model().anisotropic
    np.testing.assert_allclose(model().marker_cov_ct, 0.25 * np.eye(3))


def test_a_bed_axis_turns_the_slices_and_ras_is_understood():
    for axis, space in (("left", Space.LPS), ((2.0, 0.0, 0.0), Space.LPS), ((-1.0, 0.0, 0.0), Space.RAS)):
        found = model(space, ct_in_plane_mm=0.3, ct_slice_mm=1.0, bed_axis=axis)
        np.testing.assert_allclose(np.diag(found.marker_cov_ct), [1.0, 0.09, 0.09])


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"space": Space.LOCAL, "ct_slice_mm": 1.0}, "local_space"),
        ({"space": Space.LOCAL, "ct_slice_mm": 1.0, "bed_axis": "head"}, "local_space"),
        ({"ct_slice_mm": 1.0, "bed_axis": (0.0, 0.0, 0.0)}, "zero_direction"),
        ({"fle_mm": 1.0, "touch_mm": 0.1}, "stated_twice"),
        ({"fle_mm": 1.0, "ct_pixel_mm": 0.1}, "stated_twice"),
    ],
)
def test_contradictions_are_refused(settings, told):
    with refused(told):
        model(**settings)


def test_cell_and_deviation_are_one_error():
    with pytest.raises(ValidationError, match="state the same error"):
        ErrorsSection(ct_pixel_mm=1.0, ct_in_plane_mm=0.3)


def test_the_short_form():
    """fle_mm^2/3 in each axis and no touch."""
    short = model(fle_mm=0.9)
    np.testing.assert_allclose(short.marker_cov_ct, 0.27 * np.eye(3))
    assert short.touch_mm == 0


def test_a_nominal_arm_errs_ten_times_as_much():
    found = model(arm="nominal", twist_deg=0.01)
    assert (found.arm.link_mm, found.arm.twist) == (0.5, np.radians(0.01))
    assert model().arm.link_mm == 0.05


def test_a_surface_is_known_by_its_own_voxels():
    """Uniform in its cell along every axis of an oblique map; of what slices exceed 3 mm by half, to all sides."""
    R = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for sizes, off in (((0.7, 0.9, 3.0), (0.7, 0.9, 3.0)), ((0.7, 0.7, 5.0), np.hypot((0.7, 0.7, 5.0), 1.0))):
        S = model().surface_cov_ct(R * sizes)
        np.testing.assert_allclose(np.sqrt(np.diag(R.T @ S @ R)), np.array(off) / np.sqrt(12))
        np.testing.assert_allclose(model().scaled(3.0).surface_cov_ct(R * sizes), 9 * S)
    assert not model().surface_cov_ct(None).any()
    for voxel in (None, R):
        np.testing.assert_array_equal(model(surface_mm=0.4).surface_cov_ct(voxel), 0.4**2 * np.eye(3))


def test_scaling_scales_every_deviation():
    one, two = model(surface_mm=0.3), model(surface_mm=0.3).scaled(2.0)
    np.testing.assert_allclose(two.marker_cov_ct, 4 * one.marker_cov_ct)
    np.testing.assert_allclose(two.target_cov_ct, 4 * one.target_cov_ct)
    assert [two.touch_mm, two.surface_mm, two.arm.drift] == [2 * one.touch_mm, 0.6, 2 * one.arm.drift]


def loaded(path, **sections):
    return load_case(path, case_options(sections, where="test"))


def margins(case):
    return {one.name: one.margin_mm for one in case.structure if one.margin_mm is not None}


def test_each_kind_changes_its_table_alone(tmp_path):
    path = write_patient(tmp_path / "a")
    case = loaded(path, needle={"length_mm": 200.0}, arm={"model": "ur5"}, search={"step_deg": 15.0})
    assert (case.needle.length_mm, case.needle.shaft_mm) == (200.0, 150.0)
    assert case.robot.model.name == "ur5" and round(case.search.step, 6) == 0.261799
    assert loaded(path, target={"position_mm": [1.0, 2.0, 3.0]}).target_ct.tolist() == [1.0, 2.0, 3.0]


def test_a_target_by_name_takes_the_place_of_a_position(tmp_path):
    path = write_patient(tmp_path / "a")
    (path.parent / "points.csv").write_text("name,x_mm,y_mm,z_mm\none,1,0,0\ntwo,2,0,0\n")
    assert loaded(path, target={"points": "points.csv", "name": "two"}).target_ct.tolist() == [2.0, 0.0, 0.0]
    path.write_text(tiny_text(target='points = "points.csv"\nname = "one"\nstructure = "organ"'))
    assert loaded(path, target={"name": "two"}).target_ct.tolist() == [2.0, 0.0, 0.0]
    assert loaded(path, target={"position_mm": [7, 0, 0]}).target_ct.tolist() == [7.0, 0.0, 0.0]


def test_margins_by_name_pattern_and_addition(tmp_path):
    """Of what the case has a margin for; names first, then what is added to all."""
    path = write_patient(tmp_path / "a")
    assert margins(loaded(path, margins={"rib": 9.0})) == {"rib": 9.0}
    assert margins(loaded(path, margins={"r*": 9.0, "add_mm": 0.5})) == {"rib": 9.5}
    assert margins(loaded(path, margins={"add_mm": 2})) == {"rib": 5.0}


@pytest.mark.parametrize(
    ("steps", "left"),
    [
        (({"*": 1.0}, {"rib": 8.0}), 8.0),
        (({"rib": 8.0}, {"*": 1.0}), 1.0),
        (({"rib": 8.0}, {"*": 1.0}, {"rib": 8.0}), 8.0),
        (({"*": 1.0}, {"rib": 8.0}, {"*": 1.0}), 1.0),
        (({"r*": 1.0}, {"*b": 8.0}), 8.0),
        (({"rib": 8.0, "*": 1.0},), 8.0),
    ],
)
def test_of_margins_that_fit_one_structure_the_last_stated_counts(tmp_path, steps, left):
    """To and fro: 8 mm stated last were 1 mm by an earlier pattern; the order is an input too."""
    plain = load_case(write_patient(tmp_path / "a"))
    case, back = plain, plain
    for step in steps:
        case = case.replace(margins=step)
    for step in reversed(steps):
        back = back.replace(margins=step)
    assert margins(case) == {"rib": left}
    assert margins(back) == margins(case) or back.inputs != case.inputs


def test_a_mount_takes_the_place_of_a_registration(tmp_path):
    path = write_patient(
        tmp_path / "a", text=tiny_text() + '[registration]\nmarkers_ct = "a.csv"\nmarkers_base = "b.csv"\n'
    )
    mount = {"position_mm": [500.0, 0.0, 0.0], "x_axis": [1.0, 0.0, 0.0], "z_axis": [0.0, 0.0, 1.0]}
    case = loaded(path, mount=mount)
    assert case.registration is None and case.robot.T_base_ct_mount is not None


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"colour": {"red": 1}}, "unknown_key colour"),
        ({"needle": 3}, "not_a_table"),
        ({"needle": {"length_mm": float("nan")}}, "bad_value"),
        ({"needle": {"length": 3.0}}, "unknown_key length"),
        ({"needle": {"length_mm": "long"}}, "bad_value needle.length_mm"),
        ({"margins": {"rip": 3.0}}, "no_match rip"),
        ({"margins": {"organ": 3.0}}, "no_match organ"),
        ({"margins": {"rib": "3"}}, "not_a_number rib"),
        ({"margins": {"add_mm": -4}}, "bad_value margin_mm"),
        ({"target": {"position_mm": [0, 0]}}, "missing_key target.position_mm"),
    ],
)
def test_an_option_that_cannot_be_used_is_refused(tmp_path, sections, message):
    """As a line of the file would be; one that changes nothing too: whoever typed it believes that it does."""
    path = write_patient(tmp_path / "a")
    with refused(*message.split()):
        loaded(path, **sections)


def test_options_are_an_input(tmp_path):
    path = write_patient(tmp_path / "a")
    plain, wide = loaded(path), loaded(path, margins={"rib": 9.0})
    assert [one.role for one in wide.inputs if one not in plain.inputs] == ["options"]
    assert loaded(path, needle={}).inputs == plain.inputs
