"""The merged table and dataset, in every reader that people use; what changed against another; the state."""

import duckdb
import numpy as np
import pandas
import polars
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from cohort_world import merged, plan_of, run_here, tiny_text, write_cohort, write_patient
from refusals import refused, refused_command

from puncture_twin.planning.batch.merge import compare, read_cases, union_schema
from puncture_twin.planning.batch.run import cohort_state
from puncture_twin.run_twin import main

AORTA = '[[structure]]\nname = "aorta"\nmesh = "rib.stl"\nunit = "mm"\nrole = "avoid"\nmargin_mm = 1.0\n'


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    """Three patients, one of whom has an organ more, one is refused; planned, run and merged."""
    here = tmp_path_factory.mktemp("merge")
    write_cohort(here / "c")
    write_patient(here / "c" / "p9", text=tiny_text() + AORTA)
    run_here(here / "c", here / "out")
    assert main(["batch", "merge", "--out", str(here / "out")]) == 0
    return here


def test_a_row_a_case(cohort):
    """Case as written, verdict, best direction, reason: null where there is a safe direction."""
    rows = merged(cohort / "out")
    assert list(rows) == ["p0/case.toml", "p1/case.toml", "p2/case.toml", "p9/case.toml"]
    assert [row["exit_code"] for row in rows.values()] == [0, 0, 2, 0]
    assert [row["reason"] is None for row in rows.values()] == [True, True, False, True]
    assert rows["p2/case.toml"]["safe"] == 0 and rows["p0/case.toml"]["safe"] > 0
    assert len({row["id"] for row in rows.values()}) == 4
    schema, names = pq.read_schema(cohort / "out" / "cases.parquet"), ("case", "id", "safe", "exit_code", "reason")
    assert [str(schema.field(name).type) for name in names] == ["string", "string", "int64", "int64", "string"]
    assert str(schema.field("best_theta_deg").type) == "double"


def read_duckdb(folder):
    return duckdb.sql(f"FROM read_parquet('{folder}/**/*.parquet', hive_partitioning = true)").df()


def read_polars(folder):
    table = polars.read_parquet(f"{folder}/**/*.parquet", hive_partitioning=True)
    return table.to_pandas(use_pyarrow_extension_array=False)


@pytest.mark.parametrize("read", [pandas.read_parquet, read_duckdb, read_polars])
def test_no_reader_drops_an_organ(cohort, read):
    """The one that only the last case has is a column of all, null for the others; the rows are those of the cases."""
    table, rows = read(cohort / "out" / "candidates"), merged(cohort / "out")
    for row in rows.values():
        mine = table[table["id"].astype(str) == row["id"]]
        assert len(mine) == row["directions"]
        assert (mine["verdict"].astype(str) == "safe").sum() == row["safe"]
        organ = mine["clearance_aorta_mm"].astype(float)
        assert np.isfinite(organ).all() if row["case"] == "p9/case.toml" else np.isnan(organ).all()


def test_a_column_of_two_types_is_refused(tmp_path):
    """Results of two versions are not mixed."""
    with refused("tables_differ", "int64"):
        union_schema([pa.schema([("a", pa.int64())]), pa.schema([("a", pa.string())])], tmp_path)


def test_the_page_names_failures_first_and_links_no_page_that_is_not_there(cohort):
    """Reasons before the table; a case without a page has no link."""
    text = (cohort / "out" / "cohort.html").read_text()
    assert text.index("organ.stl") < text.index("p0/case.toml")
    assert "report.html" not in text and "<td>safe</td>" not in text and "safe for the organs" in text


def test_merging_again_gives_the_same_bytes(cohort):
    before = {name: (cohort / "out" / name).read_bytes() for name in ("cases.parquet", "cohort.html")}
    assert main(["batch", "merge", "--out", str(cohort / "out")]) == 0
    assert {name: (cohort / "out" / name).read_bytes() for name in before} == before


def test_a_case_that_was_not_run_says_so(tmp_path, capfd):
    """A row with no exit code and no verdict; the command says that the table is not whole."""
    write_cohort(tmp_path / "c", 2)
    assert main(["batch", "plan", str(tmp_path / "c"), "--out", str(tmp_path / "out"), "--no-arm"]) == 0
    assert main(["batch", "merge", "--out", str(tmp_path / "out")]) == 1
    assert "2 not run" in capfd.readouterr().out
    found = [(row["exit_code"], row["reason"], row["safe"]) for row in merged(tmp_path / "out").values()]
    assert found == [(None, "not run", None)] * 2


def test_what_is_expected_is_held(cohort, tmp_path, capfd):
    """The same verdicts: 0. One that changed, or a clearance beyond the tolerance: 1, with its line."""
    expected, table = tmp_path / "expected.parquet", pq.read_table(cohort / "out" / "cases.parquet")
    pq.write_table(table, expected)
    command = ["batch", "merge", "--out", str(cohort / "out"), "--expect", str(expected)]
    assert main(command) == 0
    moved = [None if value is None else value + 0.02 for value in table["best_clearance_mm"].to_pylist()]
    pq.write_table(
        table.set_column(table.column_names.index("best_clearance_mm"), "best_clearance_mm", [moved]), expected
    )
    assert main(command) == 1 and "3 not as expected" in capfd.readouterr().out
    assert main([*command, "--tolerance-mm", "0.03"]) == 0
    pq.write_table(table.slice(1), expected)
    assert main(command) == 1 and "p0/case.toml: new" in capfd.readouterr().out
    expected.write_text("no table")
    capfd.readouterr()
    refused_command(command, capfd, "not_parquet")


def row(case, safe, clearance=None, entry=None, reason=None, code=0):
    values = dict(zip("xyz", entry or (None, None, None), strict=True))
    best = {f"best_entry_{axis}_mm": value for axis, value in values.items()} | {"best_clearance_mm": clearance}
    return {"case": case, "options": "{}", "safe": safe, "exit_code": code, "reason": reason, **best}


def test_two_cohorts_are_compared_case_by_case():
    """What became safe, what was lost, what came and went, how far the best entry moved."""
    no, at = {"reason": "no safe direction", "code": 1}, (0, 0, 0)
    before = [
        row("a", 5, 2.0, at),
        row("b", 0, **no),
        row("c", 3, 1.0, at),
        row("gone", 1, 1.0, at),
        row("same", 0, **no),
    ]
    after = [row("a", 5, 2.5, (3, 4, 0)), row("b", 2, 1.0, at), row("c", 0, reason="x", code=2), row("same", 0, **no)]
    found = compare(before, [*after, row("new", 0, **no)])
    kinds = {"a": "same", "b": "became safe", "c": "lost", "same": "same", "new": "new", "gone": "gone"}
    assert {one.case: one.kind for one in found.changes} == kinds
    assert (found.changes[0].moved_mm, found.changes[0].clearance_mm) == (5.0, 0.5)
    assert [one.case for one in found.beyond(0.1)] == ["a", "b", "c", "new", "gone"]
    assert [one.case for one in found.beyond(0.6)] == ["b", "c", "new", "gone"]


def test_compare_prints_what_changed(cohort, tmp_path, capfd):
    assert main(["batch", "compare", str(cohort / "out"), str(cohort / "out" / "cases.parquet")]) == 0
    assert "4 cases: 4 same" in capfd.readouterr().out
    with refused("no_such_file"):
        read_cases(tmp_path)


def test_the_state_counts_each_case_once(tmp_path, capfd):
    """Done, failed with its reason, missing, stale."""
    write_cohort(tmp_path / "c", 4)
    run_here(tmp_path / "c", tmp_path / "out", most=3)
    state = cohort_state(tmp_path / "out", lambda done, of: None)
    assert (state.done, state.failed, state.missing, state.stale) == (3, 0, 1, 0)
    run_here(tmp_path / "c", tmp_path / "out")
    case = tmp_path / "c" / "p0" / "case.toml"
    case.write_text(case.read_text() + "# later\n")
    assert main(["batch", "status", "--out", str(tmp_path / "out")]) == 0
    said = capfd.readouterr().out
    assert "1  failed\n       1  case.toml: structure 'organ'" in said
    assert "1  stale" in said and "p0/case.toml" in said and "0  missing" in said
    assert len(plan_of(case)) == 1
