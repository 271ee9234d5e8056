"""What a cohort is made of: a folder, a CSV, a TOML file; each case as it is written."""

import os

import pytest
from cohort_world import plan_of, write_patient
from refusals import refused

from puncture_twin.planning.batch.cohort import read_cohort


def stated(cohort):
    return [one.stated for one in read_cohort(cohort)[0]]


def test_a_folder_is_every_case_below_it(tmp_path):
    """At any depth, behind links too, each once, sorted; a link in a circle ends."""
    write_patient(tmp_path / "c" / "b")
    write_patient(tmp_path / "c" / "a" / "deep")
    write_patient(tmp_path / "elsewhere")
    (tmp_path / "c" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "c" / "b" / "round").symlink_to(tmp_path / "c")
    assert stated(tmp_path / "c") == ["a/deep/case.toml", "b/case.toml", "linked/case.toml"]


def test_a_patient_that_cannot_be_looked_up_is_not_left_out(tmp_path, monkeypatch):
    """Behind a link to an archive that is not mounted, or in a folder that may not be read."""
    write_patient(tmp_path / "c" / "a")
    (tmp_path / "c" / "b").symlink_to(tmp_path / "archive" / "b")
    with refused("cohort_not_whole"):
        read_cohort(tmp_path / "c")
    (tmp_path / "c" / "b").unlink()
    write_patient(tmp_path / "c" / "b")
    listed = os.scandir

    def scandir(folder):
        if os.fspath(folder).endswith("/b"):
            raise PermissionError(13, "Permission denied", os.fspath(folder))
        return listed(folder)

    monkeypatch.setattr(os, "scandir", scandir)
    with refused("cohort_not_whole", "/b: "):
        read_cohort(tmp_path / "c")


def test_a_csv_lists_cases_relative_to_itself_or_absolute(tmp_path):
    """As written, cell for cell, in its order; a folder stands for its case; empty lines and cells say nothing."""
    here = write_patient(tmp_path / "c" / "a")
    text = f"name,case,target,needle.length_mm,margins.rib\nfirst,a,,,\n\n,a/case.toml,5 0 0,200,4\n,{here},,,\n"
    (tmp_path / "c" / "list.csv").write_text(text)
    cases, inputs = read_cohort(tmp_path / "c" / "list.csv")
    assert [one.stated for one in cases] == ["a", "a/case.toml", str(here)]
    assert cases[0].name == "first" and cases[0].options.sections == {}
    sections = {"target": {"position_mm": [5.0, 0.0, 0.0]}, "needle": {"length_mm": 200}, "margins": {"rib": 4}}
    assert cases[1].options.sections == sections
    assert [one.role for one in inputs] == ["cohort"]
    assert all(plan_of(one.path)[0].refusal == "" for one in cases)


@pytest.mark.parametrize(
    ("cell", "option"),
    [
        ("1,2,3", {"position_mm": [1.0, 2.0, 3.0]}),
        ("[1.5; -2; 3e1]", {"position_mm": [1.5, -2.0, 30.0]}),
        ("lesion 2", {"name": "lesion 2"}),
        ("1 2", {"name": "1 2"}),
    ],
)
def test_a_target_is_a_point_or_a_name(tmp_path, cell, option):
    """Three numbers are a position; anything else is a name."""
    (tmp_path / "c.csv").write_text(f'case,target\na,"{cell}"\n')
    assert read_cohort(tmp_path / "c.csv")[0][0].options.sections == {"target": option}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("path\na\n", "missing_column"),
        ("case,colour\na,red\n", "unknown_column colour"),
        ("case,needle\na,red\n", "unknown_column"),
        ("case,case\na,b\n", "duplicate_column"),
        ("case,name\na\n", "ragged_row"),
        ("case\n", "cohort_size"),
        ("", "file_size"),
        ("case,name\n,b\n", "bad_name"),
        ("case\na\0b\n", "bad_name"),
        ('case\na"b\n"c\n', "not_csv"),
        ("case\n" + "a" * 30_000, "not_csv"),
        ("\n,\ncase\ra\rb,c\r", "ragged_row line 5"),
        ("case,needle.length_mm\na,nan\n", "bad_value"),
    ],
)
def test_a_csv_that_cannot_be_used_is_refused(tmp_path, text, message):
    """With its line, and nothing is guessed."""
    (tmp_path / "c.csv").write_text(text)
    with refused(*message.split()):
        read_cohort(tmp_path / "c.csv")


EMPTY = "[" + "{}, " * 101 + "]"

TOML = """cases = ["p*/case.toml"]
targets = [[0, 0, 0], [5, 0, 0]]
arms = ["ur3", "ur5"]
[margins]
usual = {}
wide = { rib = 8.0 }
[needles.long]
length_mm = 220.0
"""


def test_a_cohort_file_is_a_grid(tmp_path):
    """Every match with every combination; the options have names."""
    for name in ("p1", "p0"):
        write_patient(tmp_path / name)
    (tmp_path / "cohort.toml").write_text(TOML)
    cases, _ = read_cohort(tmp_path / "cohort.toml")
    assert len(cases) == 2 * 2 * 2 * 2 and cases[0].stated == "p0/case.toml"
    assert cases[0].name == "target 1, margins usual, needle long, arm ur3"
    wide = {"target": {"position_mm": [5, 0, 0]}, "margins": {"rib": 8.0}}
    assert cases[7].options.sections == {**wide, "needle": {"length_mm": 220.0}, "arm": {"model": "ur5"}}
    assert len({row.id for one in cases[:8] for row in plan_of(one.path, **one.options.sections)}) == 8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "missing_key missing"),
        ("cases = []\n", "bad_value list"),
        ('cases = ["q*"]\n', "no_match q*"),
        ('cases = ["p0"]\ncolours = ["red"]\n', "unknown_key colours"),
        ('cases = ["p0"]\nmargins = [3]\n', "not_a_table margins.1"),
        ('schema = 2\ncases = ["p0"]\n', "unknown_version"),
        ('cases = ["p0"]\n[mounts.a]\nwhen = 2020-01-01\n', "bad_value"),
        (
            'cases = ["p0"]\n' + "".join(f"{axis} = {EMPTY}\n" for axis in ("needles", "arms", "errors")),
            "cohort_size 1030301",
        ),
    ],
)
def test_a_cohort_file_that_cannot_be_used_is_refused(tmp_path, text, message):
    write_patient(tmp_path / "p0")
    (tmp_path / "cohort.toml").write_text(text or "# nothing\n")
    with refused(*message.split()):
        read_cohort(tmp_path / "cohort.toml")


def test_a_folder_whose_name_is_no_text_is_refused(tmp_path):
    """No table can hold its case, and a case is not left out."""
    (tmp_path / os.fsdecode(b"p\xff")).mkdir()
    (tmp_path / os.fsdecode(b"p\xff") / "case.toml").write_text("schema = 1\n")
    with refused("not_text"):
        read_cohort(tmp_path)


def test_what_is_no_cohort_is_refused(tmp_path):
    """An empty folder, a file of another kind, nothing at all."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "c.txt").write_text("case\n")
    for name, message in (("empty", "cohort_size"), ("c.txt", "not_a_cohort"), ("gone.csv", "no_such_file")):
        with refused(message):
            read_cohort(tmp_path / name)
