"""What tests of commands share."""

import json

import pytest

from puncture_twin.run_twin import main
from puncture_twin.twin.report.scene.film import FilmTimes


@pytest.fixture(scope="module")
def short_film():
    """Three frames, in this process: a whole film, made in another one, is in test_own_arm_page."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("puncture_twin.twin.jobs.patient.rehearsed.worker_count", lambda wanted, pieces: 1)
        times = "puncture_twin.twin.report.scene.film.film_times"
        patch.setattr(times, lambda total: FilmTimes((0.0, total), 1.0, 1))
        yield


@pytest.fixture
def run(capfd):
    """A function: a command with --json; its exit code, and the one object on stdout."""

    def answer(*arguments):
        code = main([*map(str, arguments), "--json"])
        out = capfd.readouterr().out
        return code, json.loads(out) if out else None

    return answer
