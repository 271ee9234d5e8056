"""Workers that die, hang, or take too much: one case costs one row, and the others go on."""

import cohort_world
import pytest
from cohort_world import merged, timings, write_cohort, write_patient
from refusals import refused

from puncture_twin.planning.base.progress import Silent
from puncture_twin.planning.batch.plan import read_plan_table
from puncture_twin.planning.batch.run import Part, run_cohort, running
from puncture_twin.planning.batch.run_case import Limits, run_here
from puncture_twin.run_twin import main


@pytest.fixture
def planned(tmp_path):
    """A cohort of three, whose last case is refused, and its folder; and how its cases are run."""
    write_cohort(tmp_path / "c")
    out = tmp_path / "out"
    assert main(["batch", "plan", str(tmp_path / "c"), "--out", str(out), "--no-arm"]) == 0

    def run(**keys):
        counts = run_cohort(out, Silent(), **keys)
        assert not list(out.glob(".puncture-twin-cases-*"))
        return counts

    return out, run


def rows(out):
    """Exit code and reason of each case, after a merge."""
    main(["batch", "merge", "--out", str(out)])
    return [(row["exit_code"], row["reason"]) for row in merged(out).values()]


def test_a_worker_that_dies_costs_nothing_but_time_and_twice_its_case_one_row(planned):
    """The case before and the case after have their verdicts; the next run tries it again.

    The second try of another one is committed; that there were two is in the timings alone.
    """
    out, run = planned
    counts = run(write_page=cohort_world.die)
    assert counts.reasons["worker_died"] == 1 and counts.ended == {0: 1, 2: 1, 3: 1}
    first, second, _ = rows(out)
    assert (first[0], second) == (0, (3, "worker_died"))
    ids = [one.id for one in read_plan_table(out).cases]
    assert [timings(out / one)["attempt"] for one in ids] == [2, 2, 1]
    counts = run(elsewhere=run_here)
    assert (counts.before, counts.ended[0], counts.failed) == (2, 1, 0)
    assert [code for code, _ in rows(out)] == [0, 0, 2]


def test_a_case_beyond_a_limit_is_stopped(planned):
    """With its reason, and the refused one is reached."""
    out, run = planned
    reasons = run(write_page=cohort_world.sleep_or_eat, limits=Limits(1500, 10.0)).reasons
    assert (reasons["timed_out"], reasons["out_of_memory"]) == (1, 1)
    assert [code for code, _ in rows(out)] == [3, 3, 2]


def test_a_full_disk_stops_the_run_with_one_line(planned):
    """No row says that a case failed, which only the disk did."""
    out, run = planned
    with refused("unwritable"):
        run(write_page=cohort_world.full, elsewhere=run_here)
    assert rows(out) == [(None, "not run")] * 3


def test_a_second_run_of_the_same_folder_is_refused(planned):
    """At once; two parts side by side are not, and the whole waits for no part."""
    out, run = planned
    with running(out, Part(1, 1)):
        for part in (Part(1, 1), Part(1, 2)):
            with refused("folder_in_use"):
                run(part=part)
    with running(out, Part(1, 2)):
        with refused("folder_in_use"):
            run(part=Part(1, 2))
        with refused("folder_in_use"):
            run()
        with running(out, Part(2, 2)):
            pass


def test_the_same_case_twice_is_run_once(tmp_path, capfd):
    """Two rows, one result: the same bytes have one answer."""
    for name in ("a", "b"):
        write_patient(tmp_path / "c" / name)
    assert main(["batch", "plan", str(tmp_path / "c"), "--out", str(tmp_path / "out"), "--no-arm"]) == 0
    assert main(["batch", "run", "--out", str(tmp_path / "out")]) == 0
    assert "2 cases: 1 the same as other cases, 0 already had a row, 1 done, 0 failed" in capfd.readouterr().out
    assert rows(tmp_path / "out") == [(0, None)] * 2
