"""Lists that are checked row by row: each row says what `check` says of it alone."""

import csv
import hashlib
import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from refusals import refused_command

from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.choosing.list_job import COLUMNS
from puncture_twin.twin.jobs.exit_codes import ANSWER_IS_NO, OK

RAS = np.array([-1.0, -1.0, 1.0])


def write(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def test_entries_are_checked_as_each_alone(context, tmp_path, run):
    """One row out for one in, in order; an entry that is none is a row that says so; the list's hash is an input."""
    found = context.search()
    rows = [found.ranked[0], found.ranked[-1], int(np.flatnonzero(~found.safe & np.isfinite(found.path.length))[0])]
    points = [found.path.entry_ct[row] * RAS for row in rows] + [0.5 * found.path.entry_ct[rows[0]] * RAS]
    lines = [f"{name},{','.join(f'{x:.9f}' for x in point)}" for name, point in zip("abcd", points, strict=True)]
    listed = write(tmp_path / "entries.csv", "name,x_mm,y_mm,z_mm", *lines)
    code, told = run("check", context.case.path, "--no-arm", "--entries", listed, "--out", tmp_path / "out")
    assert code == ANSWER_IS_NO
    assert [row["verdict"] for row in told["rows"]] == ["safe", "safe", "rejected", "refused"]
    assert "enters the skin" in told["rows"][3]["detail"]
    for row, out in zip(rows, told["rows"], strict=False):
        alone = context.explain(found.theta[row], found.beta[row]).summary()
        assert out["min_clearance_mm"] == pytest.approx(found.clearance.least[row], abs=1e-6)
        assert [out[f"entry_{axis}_mm"] for axis in "xyz"] == pytest.approx(alone["entry_mm"], abs=1e-6)
        assert (out["verdict"], out["reason"]) == (alone["verdict"], alone["reason"])
    digest = hashlib.sha256(listed.read_bytes()).hexdigest()
    assert told["inputs"][0] == {"role": "entries", "path": str(listed), "sha256": digest}
    table = pq.read_table(tmp_path / "out" / "checked.parquet")
    assert table.to_pylist() == told["rows"] and table.column_names == list(COLUMNS)
    with (tmp_path / "out" / "checked.csv").open() as stream:
        read = list(csv.DictReader(stream))
    assert [row["verdict"] for row in read] == [row["verdict"] for row in told["rows"]]
    assert [float(row["path_length_mm"]) for row in read[:3]] == [row["path_length_mm"] for row in told["rows"][:3]]
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["entries"]["check list"]["inputs"][0]["sha256"] == digest


def test_angles_are_a_list_of_entries_too(context, tmp_path, run, capfd):
    found = context.search()
    lines = [f"{at['theta_deg']},{at['beta_deg']}" for at in map(found.at, found.ranked[:3])]
    command = ["check", str(context.case.path), "--no-arm", "--entries", str(tmp_path / "angles.csv")]
    write(tmp_path / "angles.csv", "theta_deg,beta_deg", *lines)
    code, told = run(*command)
    assert code == OK
    assert [row["path_length_mm"] for row in told["rows"]] == pytest.approx(found.path.length[found.ranked[:3]])
    assert main(command) == OK
    assert len([line for line in capfd.readouterr().out.splitlines() if line.split()[1:2] == ["safe"]]) == 3
    write(tmp_path / "angles.csv", "# of a sheet, by hand", "", '"beta_deg","theta_deg","name"', ",,",
          *(f'{",".join(reversed(line.split(",")))},"#{number}"' for number, line in enumerate(lines)))  # fmt: skip
    code, quoted = run(*command)
    assert [row["name"] for row in quoted["rows"]] == ["#0", "#1", "#2"]
    assert [row["path_length_mm"] for row in quoted["rows"]] == [row["path_length_mm"] for row in told["rows"]]


def test_each_target_is_what_a_case_with_that_target_says(context, another, tmp_path, run):
    """Also the direction that was chosen for all; a target outside of the body is a row that says why."""
    points = {"first": (5.0, 3.0, -4.0), "outside": (300.0, 0.0, 0.0)}
    listed = write(
        tmp_path / "t.csv", "name,x_mm,y_mm,z_mm", *(f"{name},{x},{y},{z}" for name, (x, y, z) in points.items())
    )
    command = ["check", context.case.path, "--no-arm", "--targets", listed]
    code, told = run(*command)
    assert code == ANSWER_IS_NO
    alone = another(("position_mm = [0.0, 0.0, 0.0]", "position_mm = [5.0, 3.0, -4.0]"))
    found = alone.search()
    first, second = told["rows"]
    assert first["safe_directions"] == int(found.safe.sum()) > 0
    assert first["theta_deg"] == found.at(found.ranked[0])["theta_deg"]
    assert first["min_clearance_mm"] == pytest.approx(float(found.clearance.least[found.ranked[0]]))
    assert (second["verdict"], second["safe_directions"]) == ("refused", None) and second["detail"]
    code, told = run(*command, "--theta", 10, "--beta", 90)
    explained = alone.explain(np.radians(10), np.radians(90)).summary()
    assert told["rows"][0]["path_length_mm"] == pytest.approx(explained["path_length_mm"])


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (("name,x_mm,y_mm,z_mm", "a,1,2,3", "b,1,2"), "ragged_row line 3"),
        (("name,x_mm,y_mm,z_mm", "a,1,2,nan"), "not_finite line 2"),
        (("name,x,y,z", "a,1,2,3"), "unit_not_stated"),
        (("theta_deg,beta_deg", "1,2", "", "181,2"), "out_of_range line 4 theta_deg 181"),
        (("theta_deg,beta_deg", "1,2,3"), "ragged_row line 2"),
        (("theta_deg,beta_deg,colour", "1,2,3"), "wrong_columns header colour (column 3)"),
        (("theta_deg,name", "1,2"), "wrong_columns header lacks beta_deg"),
        (("", "theta_deg,beta_deg", "1,2", "# 3,4"), "comment_or_row line 4"),
        (("theta_deg,beta_deg",), "empty"),
    ],
)
def test_a_line_that_is_none_is_named_and_nothing_is_written(context, tmp_path, capsys, lines, said):
    listed = write(tmp_path / "bad.csv", *lines)
    arguments = ["check", str(context.case.path), "--no-arm", "--entries", str(listed), "--out", str(tmp_path / "out")]
    refused_command(arguments, capsys, *said.split(), "bad.csv")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["--entries", "a.csv", "--targets", "b.csv"],
        ["--entries", "a.csv", "--rank", "1"],
        ["--entries", "a.csv", "--picture", "a.png"],
        ["--out", "out"],
    ],
)
def test_what_does_not_go_together_is_refused(context, arguments, capsys):
    refused_command(["check", context.case.path, *arguments], capsys, "conflicting_options")


@pytest.mark.parametrize(("end", "warned"), [("\n", False), ("", True)])
def test_a_list_that_may_be_cut_within_a_number_is_told(context, tmp_path, run, end, warned):
    """`30,100` cut to `30,10` is another direction, and looks whole."""
    path = tmp_path / "entries.csv"
    path.write_text("theta_deg,beta_deg\n10,20\n30,10" + end)
    _, told = run("check", context.case.path, "--no-arm", "--entries", path)
    assert [row["beta_deg"] for row in told["rows"]] == [20.0, 10.0]
    assert any("entries.csv: its last line has no line break at its end" in one for one in told["warnings"]) == warned
