"""Named points: CSV and Slicer files, their unit and space, and every way in which they can be wrong."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.formats.guard import guard_points
from puncture_twin.planning.formats.points import NamedPoints, read_points, write_points
from puncture_twin.planning.geometry.spaces import Space, Unit

CSV = "name,x_mm,y_mm,z_mm\nA,10,20,147\nB,110,120.5,-1e2\n"
FCSV = """# Markups fiducial file version = 4.11
# CoordinateSystem = LPS
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
vtkMRMLMarkupsFiducialNode_0,10,20,147,0,0,0,1,1,1,0,A,,
vtkMRMLMarkupsFiducialNode_1,110,120.5,-100,0,0,0,1,1,1,0,"B",,
"""
POINTS = [[10.0, 20.0, 147.0], [110.0, 120.5, -100.0]]


def markups(*, points: list[dict[str, Any]] | None = None, **changes: Any) -> str:
    both = [
        {"id": str(i), "label": label, "position": position, "positionStatus": "defined", "orientation": [1.0] * 9}
        for i, (label, position) in enumerate(zip("AB", POINTS, strict=True))
    ]
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "locked": True}
    markup |= {"controlPoints": both if points is None else points} | changes
    kept = {key: value for key, value in markup.items() if value is not None}
    return json.dumps({"@schema": "markups-schema-v1.0.3.json#", "markups": [kept]})


def read(folder: Path, ending: str, data: str | bytes, **options: Any) -> NamedPoints:
    path = folder / f"markers{ending}"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return read_points(path, **options)


@pytest.mark.parametrize(
    ("ending", "text"),
    [
        pytest.param(".csv", CSV, id="csv"),
        pytest.param(".CSV", CSV, id="csv-in-capitals"),
        pytest.param(".csv", "\ufeff" + CSV.replace("\n", "\r\n"), id="csv-of-a-spreadsheet"),
        pytest.param(".csv", CSV.rstrip() + "\n\n,,,\n", id="csv-with-empty-lines"),
        pytest.param(".csv", "z_cm, name ,x_cm,y_cm\n14.7, A ,1,2\n-10,B,11,12.05\n", id="csv-in-cm-in-any-order"),
        pytest.param(".csv", "name,x_m,y_m,z_m\nA,.01,.02,.147\nB,.11,.1205,-.1\n", id="csv-in-m"),
        pytest.param(".mrk.json", markups(), id="markups"),
        pytest.param(".mrk.json", markups(coordinateSystem="1"), id="markups-system-1-as-text"),
        pytest.param(".mrk.json", markups(coordinateSystem=1), id="markups-system-1"),
        pytest.param(".mrk.json", markups(coordinateUnits=["mm", "UCUM", "millimeter"]), id="markups-coded-unit"),
        pytest.param(".fcsv", FCSV, id="fcsv"),
        pytest.param(".fcsv", FCSV.replace("LPS", "1"), id="fcsv-system-1"),
        pytest.param(".fcsv", FCSV.replace(",,\n", ",,,2,0\n"), id="fcsv-of-slicer-5"),
    ],
)
def test_every_form_gives_the_same_points_in_lps(tmp_path: Path, ending: str, text: str) -> None:
    found = read(tmp_path, ending, text, default_space=Space.LPS)
    assert found.names == ("A", "B") and found.space is Space.LPS and found.kinds is None
    assert found.points == pytest.approx(np.array(POINTS), abs=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        found.points[0, 0] = 0.0


@pytest.mark.parametrize(
    ("ending", "text"),
    [
        pytest.param(".csv", CSV, id="csv-in-the-space-of-its-case"),
        pytest.param(".mrk.json", markups(coordinateSystem="RAS"), id="markups"),
        pytest.param(".mrk.json", markups(coordinateSystem=0), id="markups-system-0"),
        pytest.param(".fcsv", FCSV.replace("LPS", "RAS"), id="fcsv"),
        pytest.param(".fcsv", FCSV.replace("LPS", "0"), id="fcsv-system-0"),
    ],
)
def test_ras_becomes_lps(tmp_path: Path, ending: str, text: str) -> None:
    """Right-anterior coordinates arrive with x and y negated, and say LPS."""
    found = read(tmp_path, ending, text, default_space=Space.RAS)
    assert found.space is Space.LPS
    assert found.points == pytest.approx(np.array(POINTS) * [-1, -1, 1], abs=1e-12)


def test_a_slicer_file_speaks_for_itself(tmp_path: Path) -> None:
    """Its own space counts more than the case's, since both are then turned to LPS."""
    text = markups(coordinateSystem="RAS", coordinateUnits="cm")
    found = read(tmp_path, ".mrk.json", text, default_space=Space.LPS, default_unit=Unit.M)
    assert found.points == pytest.approx(np.array(POINTS) * [-10, -10, 10], abs=1e-12)


def test_what_the_file_does_not_state_is_declared(tmp_path: Path) -> None:
    """A robot's base has no patient space, and a local frame is its own; markups without a unit are in mm.

    Version 1.0.0 of their schema knows no unit: Slicer works in mm, and the later versions' default is mm.
    """
    for space in (None, Space.LOCAL):
        found = read(tmp_path, ".csv", CSV, default_space=space)
        assert found.space is space and found.points.tolist() == POINTS
    found = read(tmp_path, ".csv", CSV.replace("_mm", ""), default_unit=Unit.CM)
    assert found.points == pytest.approx(np.array(POINTS) * 10, abs=1e-12)
    found = read(tmp_path, ".mrk.json", markups(coordinateUnits=None), default_unit=Unit.CM)
    assert found.points.tolist() == POINTS
    found = read(tmp_path, ".csv", "name,kind,x_mm,y_mm,z_mm\nA,marker,1,2,3\nL,lesion,4,5,6\n")
    assert found.kinds == ("marker", "lesion")


def test_a_line_names_its_two_ends(tmp_path: Path) -> None:
    """A line as Slicer 5 saves it, in RAS: its ends have the labels of its control points."""
    ends = [
        {"id": "1", "label": "skin entry", "associatedNodeID": "", "position": [-1.0, -2.0, 3.0],
         "orientation": [-1.0, 0, 0, 0, -1.0, 0, 0, 0, 1.0], "selected": True, "positionStatus": "defined"},
        {"id": "2", "label": "target", "description": "", "position": [4.0, 5.0, 6.0], "positionStatus": "defined"},
    ]  # fmt: skip
    measured = [{"name": "length", "enabled": True, "value": 9.1, "units": "mm"}]
    text = markups(type="Line", coordinateSystem="RAS", points=ends, measurements=measured, labelFormat="%N-%d")
    found = read(tmp_path, ".mrk.json", text, default_space=Space.LPS)
    assert found.names == ("skin entry", "target")
    assert found.points.tolist() == [[1.0, 2.0, 3.0], [-4.0, -5.0, 6.0]]


# ---- broken files --------------------------------------------------------------------------------------------------


def one_point(**changes: Any) -> str:
    point = {"label": "A", "position": [1.0, 2.0, 3.0], "positionStatus": "defined"} | changes
    return markups(points=[{key: value for key, value in point.items() if value is not None}])


HEADER = "name,x_mm,y_mm,z_mm\n"
BROKEN: list[tuple[str, str, str | bytes, str]] = [
    ("any-empty", ".csv", "", "file_size"),
    ("any-unknown-ending", ".json", markups(), "unknown_format markers.json mrk.json"),
    ("csv-only-white-space", ".csv", " \n\n", "empty"),
    ("csv-no-header", ".csv", "A,1,2,3\n", "unknown_column"),
    ("csv-no-unit", ".csv", CSV.replace("_mm", ""), "unit_not_stated"),
    ("csv-unknown-unit", ".csv", CSV.replace("_mm", "_inch"), "unknown_unit inch"),
    ("csv-mixed-units", ".csv", CSV.replace("x_mm", "x_m"), "mixed_units"),
    ("csv-unknown-column", ".csv", "name,x_mm,y_mm,z_mm,weight\nA,1,2,3,4\n", "unknown_column weight"),
    ("csv-column-twice", ".csv", "name,x_mm,x_mm,z_mm\nA,1,2,3\n", "wrong_columns"),
    ("csv-no-name", ".csv", "x_mm,y_mm,z_mm\n1,2,3\n", "wrong_columns"),
    ("csv-too-few-fields", ".csv", CSV + "C,1,2\n", "ragged_row"),
    ("csv-decimal-comma", ".csv", HEADER + "A,1,5,2,5,3,5\n", "ragged_row"),
    ("csv-word", ".csv", HEADER + "A,1,2,3\nB,1,two,3\n", "not_a_number"),
    ("csv-underscore", ".csv", HEADER + "A,1_0,2,3\n", "not_a_number 1_0"),
    ("csv-nan", ".csv", HEADER + "A,1,nan,3\n", "not_finite nan"),
    ("csv-overflow-by-unit", ".csv", "name,x_m,y_m,z_m\nA,1e308,2,3\n", "not_finite"),
    ("csv-far-away", ".csv", HEADER + "A,1,2,1e6\n", "too_far"),
    ("csv-empty-name", ".csv", HEADER + " ,1,2,3\n", "bad_name"),
    ("csv-name-twice", ".csv", HEADER + "A,1,2,3\nA,4,5,6\n", "duplicate_name"),
    ("csv-open-quote", ".csv", HEADER + '"A,1,2,3\n', "not_csv"),
    ("csv-not-utf8", ".csv", HEADER.encode() + b"\xe4,1,2,3\n", "not_text 20"),
    ("csv-with-nul", ".csv", HEADER + "A\0,1,2,3\n", "bad_name A\\x00"),
    ("markups-cut", ".mrk.json", markups()[:200], "not_json"),
    ("markups-nested-without-end", ".mrk.json", "[" * 100_000, "not_json"),
    ("markups-key-twice", ".mrk.json", markups().replace('"locked"', '"coordinateSystem"'), "not_json"),
    ("markups-of-another-kind", ".mrk.json", "[1, 2]", "wrong_count"),
    ("markups-curve", ".mrk.json", markups(type="Curve"), "unknown_type Curve"),
    ("markups-no-points", ".mrk.json", markups(points=[]), "empty"),
    ("markups-no-space", ".mrk.json", markups(coordinateSystem=None), "unknown_space"),
    ("markups-unknown-space", ".mrk.json", markups(coordinateSystem="IJK"), "unknown_space IJK"),
    ("markups-line-of-one", ".mrk.json", markups(type="Line", points=[{}]), "wrong_count"),
    ("markups-unknown-unit", ".mrk.json", markups(coordinateUnits=["[in_i]", "UCUM"]), "unknown_unit [in_i]"),
    ("markups-no-label", ".mrk.json", one_point(label=None), "bad_name"),
    ("markups-half-a-letter", ".mrk.json", one_point(label="\ud800"), "bad_name \\ud800"),
    ("markups-label-twice", ".mrk.json", markups().replace('"B"', '"A"'), "duplicate_name"),
    ("markups-undefined", ".mrk.json", one_point(positionStatus="undefined"), "point_undefined undefined"),
    ("markups-no-position", ".mrk.json", one_point(position=None), "not_a_number"),
    ("markups-two-numbers", ".mrk.json", one_point(position=[1, 2]), "not_a_number [1 2]"),
    ("markups-point-no-object", ".mrk.json", markups(points=[3]), "bad_name"),  # type: ignore[list-item]  # the fault
    ("fcsv-no-space", ".fcsv", FCSV.replace("# CoordinateSystem = LPS\n", ""), "unknown_space"),
    ("fcsv-no-columns", ".fcsv", FCSV.replace("# columns", "# c"), "wrong_columns"),
    ("fcsv-no-point", ".fcsv", "\n".join(FCSV.splitlines()[:3]), "empty"),
    ("fcsv-line-cut", ".fcsv", FCSV[:-20], "ragged_row 14"),
    ("fcsv-not-defined", ".fcsv", FCSV.replace(",,\n", ",,,1,0\n"), "point_undefined"),
    ("fcsv-one-more", ".fcsv", FCSV.replace(",,\n", ",,,2\n"), "ragged_row 15 14"),
    ("fcsv-nan", ".fcsv", FCSV.replace("147", "nan"), "not_finite nan"),
]


@pytest.mark.parametrize(("ending", "data", "says"), [pytest.param(*case[1:], id=case[0]) for case in BROKEN])
def test_a_broken_file_is_refused_in_one_line(tmp_path: Path, ending: str, data: str | bytes, says: str) -> None:
    """One line that names the file, the line or point, and what is allowed."""
    with refused(*says.split(), tmp_path / f"markers{ending}") as caught:
        read(tmp_path, ending, data, default_space=Space.LPS)
    str(caught.value).encode("utf-8")  # can be printed


def test_a_local_frame_a_missing_file_and_a_directory_are_refused(tmp_path: Path) -> None:
    with refused("local_space"):
        read(tmp_path, ".mrk.json", markups(), default_space=Space.LOCAL)
    with refused("no_such_file", "markers.csv"):
        read_points(tmp_path / "markers.csv")
    (tmp_path / "folder.csv").mkdir()
    with refused("not_a_file"):
        read_points(tmp_path / "folder.csv")


def test_written_points_read_back_exactly(tmp_path: Path) -> None:
    """Any names (with commas and quotes), kinds and coordinates return bit for bit; nothing is left over."""
    random = np.random.default_rng(2)
    names = ("A", "é,1", 'say "x"', "\u4e09", "'", "a;b", "#1", "# c, d")
    for kinds in (None, names):
        rows = random.normal(size=(len(names), 3)) * 10.0 ** random.integers(-300, 5, (len(names), 3))
        points = NamedPoints(names, guard_points(rows, names, where="test"), Space.LOCAL, kinds)
        write_points(tmp_path / "out.csv", points)
        found = read_points(tmp_path / "out.csv", default_space=Space.LOCAL)
        assert found.names == points.names and found.kinds == kinds
        assert np.array_equal(found.points, points.points)
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]


def test_points_that_cannot_be_written_leave_nothing_behind(tmp_path: Path) -> None:
    """A folder in the file's place is an input error; no part of a file stays."""
    points = read(tmp_path, ".csv", CSV)
    (tmp_path / "folder.csv").mkdir()
    before = sorted(tmp_path.iterdir())
    with refused("unwritable", "folder.csv"):
        write_points(tmp_path / "folder.csv", points)
    assert sorted(tmp_path.iterdir()) == before
