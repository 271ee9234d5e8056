"""One case as a pure function into a folder that appears whole, once."""

import shutil

import pyarrow.parquet as pq
import pytest
from cohort_world import fail, plan_of, task_of, write_patient

from puncture_twin.planning.base.output.manifest import problems
from puncture_twin.planning.batch.plan import commit, discard, is_final, new_draft, read_row, write_row
from puncture_twin.planning.batch.run_case import STALE, run_case
from puncture_twin.planning.search.context import prepare


@pytest.fixture
def path(tmp_path):
    return write_patient(tmp_path / "a")


def run(row, out, **keys):
    task = task_of(row, out, **keys)
    end = run_case(task)
    assert list(task.work.iterdir()) == []
    return end


def test_the_result_is_the_librarys(path, tmp_path):
    """The best direction, the counts and the table are those of `prepare(...).search()`."""
    (row,) = plan_of(path)
    assert run(row, tmp_path).exit_code == 0
    found, told = prepare(path, arm=False).search(), read_row(tmp_path, row.id)
    best = found.at(int(found.ranked[0]))
    assert (told["best_theta_deg"], told["best_beta_deg"]) == pytest.approx((best["theta_deg"], best["beta_deg"]))
    assert (told["directions"], told["safe"], told["reason"]) == (len(found), int(found.safe.sum()), None)
    table = pq.read_table(tmp_path / row.id / "candidates.parquet")
    assert table["verdict"].to_pylist().count("safe") == told["safe"]
    assert problems(tmp_path / row.id) == ()


def test_no_safe_direction_is_a_row_with_its_reason(tmp_path):
    """Exit code 1, safe 0, and what most directions fell to; the table is there."""
    (row,) = plan_of(write_patient(tmp_path / "a", ("margin_mm = 3.0", "margin_mm = 900.0")))
    assert run(row, tmp_path)[1:3] == (1, "no safe direction (most: too_close)")
    told = read_row(tmp_path, row.id)
    assert (told["safe"], told["best_theta_deg"]) == (0, None) and told["directions"] > 0


def test_a_refusal_is_a_row_with_its_reason(path, tmp_path):
    """At reading, or later: exit code 2, the line without the folder, no table."""
    (path.parent / "organ.stl").write_bytes(b"solid")
    late = write_patient(tmp_path / "b", ("position_mm = [0.0,", "position_mm = [300.0,"))
    for one, said in ((path, "organ.stl"), (late, "lies outside the skin")):
        (row,) = plan_of(one)
        end = run(row, tmp_path)
        assert end.exit_code == 2 and said in end.reason and str(tmp_path) not in end.reason
        assert read_row(tmp_path, row.id)["safe"] == 0
        assert not (tmp_path / row.id / "candidates.parquet").exists()


def test_a_bug_is_a_row_that_is_tried_again(path, tmp_path):
    """Exit code 3; the next run takes it away and runs the case."""
    (row,) = plan_of(path)
    assert run(row, tmp_path, write_page=fail)[1:3] == (3, "ZeroDivisionError: a bug")
    assert not is_final(read_row(tmp_path, row.id))
    discard(tmp_path, row.id, tmp_path / "work")
    assert read_row(tmp_path, row.id) is None
    assert run(row, tmp_path).exit_code == 0


def test_a_changed_input_is_no_row(path, tmp_path):
    """Whatever the new bytes would give: safe, or a refusal. Nothing is committed under the old id."""
    (row,) = plan_of(path)
    content = path.read_text()
    for changed in (content + "# more\n", content.replace("[target]", "[tarket]"), ""):
        path.write_text(changed)
        assert run(row, tmp_path)[1:3] == (None, STALE)
        assert not (tmp_path / row.id).exists()
    path.write_text(content)
    assert run(row, tmp_path).exit_code == 0


def test_a_second_commit_is_discarded(path, tmp_path):
    """The first stays, byte for byte; a second run of a done case does nothing."""
    (row,) = plan_of(path)
    run(row, tmp_path)
    before = {file.name: file.read_bytes() for file in (tmp_path / row.id).iterdir()}
    draft = new_draft(tmp_path / "work", row.id)
    write_row({"id": row.id, "exit_code": 1}, draft)
    assert commit(draft, tmp_path, row.id, (), {}) is False
    assert run(row, tmp_path, write_page=fail).exit_code == 0
    assert {file.name: file.read_bytes() for file in (tmp_path / row.id).iterdir()} == before


@pytest.mark.parametrize("name", ["row.json", "candidates.parquet", "manifest.json"])
@pytest.mark.parametrize("damage", ["cut", "gone", "edited"])
def test_half_a_result_is_none(path, tmp_path, name, damage):
    """What a crash of the machine, or a person, has left is not taken for an answer."""
    (row,) = plan_of(path)
    run(row, tmp_path)
    file = tmp_path / row.id / name
    content = file.read_bytes()
    file.unlink() if damage == "gone" else file.write_bytes(
        content[:-20] if damage == "cut" else content.replace(content[40:44], b"    ", 1)
    )
    assert read_row(tmp_path, row.id) is None


def test_the_same_bytes_give_the_same_files(path, tmp_path):
    """In another place, at another time: all but the timings."""
    shutil.copytree(path.parent, tmp_path / "elsewhere")
    (one,), (other,) = plan_of(path), plan_of(tmp_path / "elsewhere" / "case.toml")
    run(one, tmp_path / "o1")
    run(other, tmp_path / "o2")
    names = {file.name for file in (tmp_path / "o1" / one.id).iterdir()} - {"timings.json", "row.json"}
    assert "candidates.parquet" in names
    for name in names - {"manifest.json"}:
        assert (tmp_path / "o1" / one.id / name).read_bytes() == (tmp_path / "o2" / one.id / name).read_bytes()
