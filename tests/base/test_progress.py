"""The stopwatch: names, sums, and whoever is told."""

import io
import logging
import subprocess
import sys

import pytest
from case_world import coarse_carton

from puncture_twin.meshes import folder
from puncture_twin.planning.base.progress import Silent, Stages
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.report.progress import BarDisplay, LineDisplay, progress_display


def test_stages_are_announced_when_they_begin_and_added_up():
    """Who shows progress hears of a stage before it runs; a stage that fails is counted too."""
    heard = []
    stages = Stages(announce=heard.append)
    with stages.time("map"):
        assert heard == ["map"] and "map" not in stages.seconds
    first = stages.seconds["map"]
    with pytest.raises(ValueError, match="no"), stages.time("map"):
        raise ValueError("no")
    assert heard == ["map", "map"] and stages.seconds["map"] > first
    with Stages().time("silent"):
        pass


@pytest.fixture
def now(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("puncture_twin.twin.report.progress.LINE_EVERY_S", 0.0)
    monkeypatch.setattr("puncture_twin.twin.report.progress.time.monotonic", lambda: clock[0])
    return clock


def counted(now, *reports):
    stream = io.StringIO()
    with LineDisplay(stream) as display:
        for now[0], stage, done, total, failed in reports:
            display.count(stage, done, total, failed)
    return stream.getvalue().splitlines()


def test_there_is_no_rate_without_time_behind_it(now):
    """The first report starts the clock; what was done before it counts for nothing; failures are told."""
    lines = counted(now, (0, "cases", 4, 10, 0), (0.001, "cases", 5, 10, 0), (50, "cases", 5, 10, 2))
    assert lines == ["cases: 4/10", "cases: 5/10", "cases: 5/10, 2 failed, 1/min, 4 min left"]


def test_a_stage_that_begins_anew_has_its_own_clock(now):
    """Another total, or fewer done than before: the time and the work of the round before say nothing of this one."""
    first, second = (0, "directions", 0, 9000, 0), (10, "directions", 9000, 9000, 0)
    assert counted(now, first, second)[-1] == "directions: 9,000/9,000, 900/s, 0 s left"
    assert counted(now, first, second, (11, "directions", 10, 9000, 0))[-1] == "directions: 10/9,000"
    again = (11, "directions", 0, 20, 0), (21, "directions", 10, 20, 0)
    assert counted(now, first, second, *again)[-1] == "directions: 10/20, 1/s, 10 s left"


def test_bars_say_what_lines_say(now):
    """Also there a rate has time behind it: of 9,000 done in a microsecond nobody knows how fast they go on."""
    stream = io.StringIO()
    stream.isatty = lambda: True
    with progress_display(stream) as display:
        assert isinstance(display, BarDisplay)
        display.count("directions", 0, 9000)
        now[0] = 1e-6
        display.count("directions", 5000, 9000)
        shown = display._bars.tasks[0].fields["far"]
        now[0] = 10.0
        display.count("directions", 6000, 9000)
        assert (shown, display._bars.tasks[0].fields["far"]) == ("5,000/9,000", "6,000/9,000, 600/s, 5 s left")
        display.step("stage", "film")
        display.step("stage", "case")
        assert [task.fields["far"] for task in display._bars.tasks][1:] == [""]
        assert display._bars.tasks[1].description == "stage: case"


def test_a_stage_that_cannot_count_says_what_it_usually_takes_and_what_it_took(now):
    """Nobody knows before how long another takes; what was short is not worth a line."""
    stream = io.StringIO()
    with LineDisplay(stream) as display:
        for now[0], one in ((0.0, "film"), (0.0, "search"), (14.0, "case"), (14.5, "plan")):
            display.step("stage", one)
    said = ["stage: film, usually 3 s", "stage: search", "stage: search, took 14 s", "stage: case", "stage: plan"]
    assert stream.getvalue().splitlines() == said


@pytest.mark.parametrize(("engine", "most"), [("fast", {"structures"}), ("fcl", {"directions"})])
def test_an_engine_counts_what_a_person_counts(engine, most, tmp_path):
    """Structures or directions, never one times the other; of the arm no more directions than there are."""

    class Heard(Silent):
        def __init__(self):
            self.totals = {}

        def count(self, stage, done, total, failed=0):
            assert 0 < done <= total
            self.totals.setdefault(stage, set()).add(total)

    heard = Heard()
    with_arm = engine == "fast"
    context = prepare(coarse_carton(tmp_path / "carton", 30.0), engine=engine, watcher=heard, arm=with_arm)
    found = context.search()
    whole = {"structures": len(context.anatomy.checked), "directions": len(found)}
    assert {stage: totals for stage, totals in heard.totals.items() if stage in whole} == {
        stage: {whole[stage]} for stage in most
    }
    assert ("directions of the arm" in heard.totals) == with_arm
    assert max(heard.totals.get("directions of the arm", {0})) <= len(found)


def test_who_embeds_it_hears_of_stages_and_warnings(caplog):
    """By one logger: stages with their seconds, what each is at, and what the case warns of."""
    caplog.set_level(logging.DEBUG, "puncture_twin")
    context = prepare(folder() / "carton" / "case_m.toml", arm=False)
    said = {(one.levelname, one.getMessage().partition(":")[0]) for one in caplog.records}
    assert {("INFO", "case"), ("INFO", "anatomy"), ("DEBUG", "stage"), ("DEBUG", "anatomy")} <= said
    assert [one.getMessage() for one in caplog.records if one.levelname == "WARNING"] == list(context.anatomy.warnings)


def test_nothing_is_printed_by_default():
    """Neither warnings nor anything else, as Python does where no handler is."""
    code = "from puncture_twin.planning.base.progress import LOG, Silent\nLOG.warning('a')\nSilent().note('b')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")
