"""What tests of commands share."""

from unittest.mock import Mock, patch

import pytest

from puncture_twin.twin.report.scene.film import FilmTimes


@pytest.fixture(scope="module")
def short_film():
    """Three frames, in this process: a whole film, made in another one, is in test_own_arm_page."""
    with pytest.MonkeyPatch.context() as changed:
        changed.setattr("puncture_twin.twin.jobs.patient.rehearsed.worker_count", lambda wanted, pieces: 1)
        times = "puncture_twin.twin.report.scene.film.film_times"
        changed.setattr(times, lambda total: FilmTimes((0.0, total), 1.0, 1))
        yield


@pytest.fixture
def undrawn():
    """`init` without its picture, at which tests of `init` look."""
    with patch.multiple("puncture_twin.twin.report.slices.sheet", draw_slices=Mock(), write_sheet=Mock()):
        yield
