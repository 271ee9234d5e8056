"""The stopwatch: names, sums, and whoever is told."""

import pytest

from puncture_twin.planning.base.progress import Stages


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
