"""The case file: what it means, and every way in which it is refused with one clear line."""

import hashlib
import tomllib

import numpy as np
import pytest
from case_world import ORGAN, SKIN, case_text, changed
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.case_file import case_schema
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
