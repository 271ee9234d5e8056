"""Names that come from files: kept whole, and refused where they would reach a terminal as something else."""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from case_world import write_case
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.formats.labels.labelmaps import LabelMap
from puncture_twin.planning.formats.labels.naming import names_for
from puncture_twin.planning.formats.points import read_points
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.table import write_table

HOSTILE = {
    "an escape sequence": "liver\x1b[2J",
    "a line break": "liver\nsafe",
    "a right-to-left mark": "liver\u200f",
    "a right-to-left override": "\u202erevil",
    "a zero-width joiner": "li\u200dver",
    "a NUL": "liver\0",
    "201 characters": "x" * 201,
}


@pytest.fixture(scope="module")
def long_named():
    carton = prepare(folder() / "carton" / "case_m.toml", arm=False)
    names = {"bolt_h": 199 * "v" + "h", "bolt_l": 199 * "v" + "l"}
    structures = tuple(replace(s, name=names.get(s.name, s.name)) for s in carton.anatomy.structures)
    anatomy = replace(carton.anatomy, structures=structures)
    return replace(carton, anatomy=anatomy, engine=FastEngine([s.mesh for s in anatomy.checked], lambda *_: None))


def test_a_long_name_is_whole_in_the_verdict_and_in_the_table(long_named, tmp_path):
    found = long_named.check(np.radians(50), np.radians(270))
    name = 199 * "v" + "h"
    assert found.verdict.structure[0] == name
    explained = long_named.explain(np.radians(50), np.radians(270))
    assert f"too_close ({name})" in explained.text()
    assert f"  {name} avoid" in explained.text()
    assert explained.summary()["reason_structure"] == name
    write_table(found, tmp_path / "candidates.parquet")
    assert pq.read_table(tmp_path / "candidates.parquet")["reason_structure"].to_pylist() == [name]


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_name_of_a_label_or_a_point_is_refused(kind, tmp_path):
    name = HOSTILE[kind]
    labelmap = LabelMap(np.ones((2, 2, 2), np.int32), np.eye(4), {1: name}, tmp_path / "a.seg.nrrd")
    with refused("bad_name") as caught:
        names_for(None, tmp_path, lambda _: b"", labelmap)
    assert str(caught.value).isprintable()
    with refused("bad_name"):
        names_for("names.csv", tmp_path, lambda _: f'id,name\n1,"{name}"\n'.encode(), labelmap)
    point = {"label": name, "position": [0, 0, 0]}
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": [point]}
    (tmp_path / "a.mrk.json").write_text(json.dumps({"markups": [markup]}))
    with refused("bad_name") as caught:
        read_points(tmp_path / "a.mrk.json")
    assert str(caught.value).isprintable()


def test_a_hostile_text_of_the_case_is_refused(tmp_path):
    for changes in (
        ('structure = "organ"', 'structure = "organ"\nname = "a\\u001b[31mb"'),
        ('mesh = "organ.stl"', 'mesh = "organ\\u202e.stl"'),
        ('markers_base = "touch.csv"', 'markers_base = "touch.csv"\nuse = ["A\\n", "B", "C"]'),
        ("[[structure]]", '[[structures]]\nlabelmap = "labels.nrrd"\navoid = { "\\u0007*" = 1 }\n[[structure]]'),
    ):
        path = write_case(tmp_path, changes)
        with refused("bad_name") as caught:
            load_case(path)
        assert str(caught.value).isprintable()


def test_names_of_other_scripts_are_names(tmp_path):
    """Letters of any script are printable; a name of 200 characters is one."""
    (tmp_path / "a.csv").write_text(f"name,x_mm,y_mm,z_mm\nлегкое,1,2,3\n肝臓,1,2,4\n{'n' * 200},1,2,5\n")
    assert read_points(tmp_path / "a.csv").names == ("легкое", "肝臓", "n" * 200)
