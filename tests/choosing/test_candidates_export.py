"""The table of candidates as CSV and JSON: the same rows, round degrees, and whose table it is."""

import csv
import json

import pyarrow.parquet as pq
import pytest
from refusals import refused_command

from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK
from tests.case_world import write_case

CHANGES = (("theta_deg = [0, 10]\nstep_deg = 10.0", 'frame = "ct"\ntheta_deg = [0, 60]\nstep_deg = 6.0'),)


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    here = tmp_path_factory.mktemp("candidates")
    case = write_case(here, *CHANGES)
    assert main(["search", str(case), "--no-arm", "--no-pictures", "--out", str(here / "out")]) == OK
    return case, here / "out"


def expected(folder):
    return pq.read_table(folder / "candidates.parquet").to_pylist()


def test_a_grid_has_round_degrees_in_every_table(searched):
    """6 degrees ten times are 60, not 59.99999999999999."""
    angles = {row["theta_deg"] for row in expected(searched[1])}
    assert angles == {6.0 * step for step in range(11)}


def test_the_csv_is_the_table(searched, tmp_path, run):
    """Read by Python's own reader: every number to the last digit, nothing where there is none."""
    code, told = run("export", searched[1], "--format", "candidates-csv", "--out", tmp_path)
    assert code == OK
    with (tmp_path / "candidates.csv").open(newline="") as stream:
        read = list(csv.DictReader(stream))
    rows = expected(searched[1])
    assert told["rows"] == len(read) == len(rows)
    for got, want in zip(read, rows, strict=True):
        for name, value in want.items():
            if isinstance(value, bool):
                assert got[name] == str(value).lower()
            else:
                assert (None if got[name] == "" and value is None else type(value)(got[name])) == value
    assert [one["role"] for one in told["inputs"]][:2] == ["candidates", "case"]


def test_the_json_is_the_table_with_its_origin(searched, tmp_path):
    """Columns once, a list a row; the run's case, version and hashes beside them."""
    table = searched[1] / "candidates.parquet"
    assert main(["export", str(table), "--format", "candidates-json", "--out", str(tmp_path)]) == OK
    read = json.loads((tmp_path / "candidates.json").read_text())
    assert [dict(zip(read["columns"], row, strict=True)) for row in read["rows"]] == expected(searched[1])
    assert read["run"] == json.loads(pq.read_schema(table).metadata[b"run"])


def test_a_case_is_searched_first(searched, tmp_path):
    """Its table lies beside the text, in one set; the arm is checked only where the case says where it is."""
    case, out = searched
    text = case.read_text()
    other = case.with_name("other.toml")
    other.write_text(text[: text.index("[registration]")] + text[text.index("[[structure]]") :])
    assert main(["export", str(other), "--format", "candidates-csv", "--out", str(tmp_path)]) == OK
    names = {"candidates.csv", "candidates.parquet", "manifest.json", "timings.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert len(expected(tmp_path)) == len(expected(out))


def test_what_is_no_table_or_was_edited_is_refused(searched, tmp_path, capsys):
    no_table = tmp_path / "x.parquet"
    no_table.write_bytes(b"PAR1 and no more")
    form = ["--format", "candidates-csv", "--out", str(tmp_path / "out")]
    refused_command(["export", no_table, *form], capsys, "not_parquet")
    refused_command(["export", searched[1], *form, "--rank", "1"], capsys, "conflicting_options")
    assert not (tmp_path / "out").exists()
