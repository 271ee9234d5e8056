"""The stopwatch: names, sums, and whoever is told."""

import io
import itertools

import pytest

from puncture_twin.planning.base.progress import Stages
from puncture_twin.twin.report.progress import LineDisplay, rate_text


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


@pytest.mark.parametrize(
    ("per_second", "text"), [(250.0, "250/s"), (1.0, "1/s"), (0.5, "30/min"), (0.01, "36.0/h"), (0.0, "0.0/h")]
)
def test_a_rate_has_the_unit_in_which_it_says_something(per_second, text):
    """Never "0/s" of what takes a minute each."""
    assert rate_text(per_second) == text


def test_there_is_no_rate_without_time_behind_it(monkeypatch):
    """The first report starts the clock; what was done before it counts for nothing; failures are told."""
    stream, now = io.StringIO(), itertools.count(0, 10)
    monkeypatch.setattr("puncture_twin.twin.report.progress.LINE_EVERY_S", 5.0)
    monkeypatch.setattr("puncture_twin.twin.report.progress.time.monotonic", lambda: float(next(now)))
    with LineDisplay(stream) as display:
        display.count("cases", 4, 10)
        display.count("cases", 5, 10, 2)
    assert stream.getvalue().splitlines() == ["cases: 4/10", "cases: 5/10, 2 failed, 1/min, 4 min left"]
