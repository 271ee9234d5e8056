"""The predicted chances come true in rooms drawn from the declaration, and do not where the declaration is wrong."""

import numpy as np
import pytest

from benchmarks.trust import calibration_error, scene, tally
from puncture_twin.meshes import folder

ROOMS = 5_000
"""A ratio's deviation is .007, coverage's .003: one off by .05, or by .02, is seen in 499 of 500 runs."""


@pytest.fixture(scope="module")
def carton():
    return scene("carton-m", folder() / "carton" / "case_m.toml", 4)


def test_a_right_declaration_is_kept(carton):
    """Ratio, regions and calibration, with the noise known and found from four markers; 1 % of rooms are warned."""
    told = tally(carton, 4, ROOMS)
    assert told["known"].noticed == pytest.approx(0.01, abs=0.004)
    for figures in (told["known"], told["found"]):
        assert figures.ratio == pytest.approx(1.0, abs=0.03)
        assert 0.94 <= figures.coverage <= 0.96
        assert figures.ece_hit <= 0.02
        assert figures.ece_touch <= 0.02


@pytest.mark.parametrize("truth", [0.5, 2.0])
def test_a_wrong_declaration_is_seen(carton, truth):
    """Errors that are truly twice or half the declared ones: nothing holds where they are taken at their word."""
    figures = tally(carton, 4, ROOMS // 2, truth=truth, found=False)["known"]
    assert figures.ratio == pytest.approx(truth, rel=0.05)
    assert not 0.94 <= figures.coverage <= 0.96
    assert figures.ece_hit > 0.05
    assert not figures.holds
    assert (figures.noticed > 0.5) == (truth > 1.0)


def test_calibration_error_weighs_bins_by_what_is_in_them():
    """A coin that is said to fall with .3 and falls always errs by .7."""
    assert calibration_error(np.full(10, 0.3), np.ones(10)) == pytest.approx(0.7)
    assert calibration_error(np.array([0.0, 1.0]), np.array([0.0, 1.0])) == 0.0
