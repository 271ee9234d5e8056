"""The limit that `register` prints for one insertion holds 95 of 100 targets, read as badly as the markers are."""

import numpy as np
import pytest

from benchmarks.one_insertion import T, held, markers_of
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.registration.residuals import leverage
from puncture_twin.planning.uncertainty.hit import hit_in_ball, radius_for_chance


@pytest.mark.parametrize("markers", [3, 4, 6, 8])
def test_it_holds_what_it_says_whether_the_noise_is_stated_or_found(markers):
    """5,000 draws of markers and target; the rms, which has no reading of the target, holds a sixth of them at most."""
    found = held(markers, 5000, np.random.default_rng(markers))
    assert found.stated == pytest.approx(0.95, abs=0.012)
    assert found.found == pytest.approx(0.95, abs=0.012)
    assert found.rms < 0.2


@pytest.mark.parametrize("freedom", [None, 3, 12])
def test_the_radius_is_the_chance_the_other_way_round(freedom):
    cov = np.diag([4.0, 0.3, 0.01])
    for chance in (0.5, 0.95):
        assert hit_in_ball(cov[None], radius_for_chance(cov, chance, freedom), freedom)[0] == pytest.approx(
            chance, abs=1e-3
        )
    assert radius_for_chance(np.zeros((3, 3)), 0.95, freedom) == 0.0


def test_without_declared_errors_it_is_fitzpatricks_formula():
    """The trace of the covariance, at the markers' middle and far away."""
    points = markers_of(5)
    pairs = MarkerPairs(tuple("ABCDE"), points, apply(T, points) + 0.2 * np.random.default_rng(2).normal(size=(5, 3)))
    found = register(pairs, method="rigid", target_ct=np.zeros(3), fle_mm=1.0)
    places = np.array([[0.0, 0.0, 40.0], [200.0, 100.0, -300.0]])
    np.testing.assert_allclose(found.expected_tre_mm(places), leverage(points, places), rtol=0.01)
    assert found.freedom is None
