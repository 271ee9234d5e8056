"""Options are laid over a case before it is validated, and are held to the same rules."""

import pytest
from cohort_world import tiny_text, write_patient
from refusals import refused

from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.options import case_options


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
