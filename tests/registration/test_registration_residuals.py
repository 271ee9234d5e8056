"""Residuals against the noise: honest noise passes, more is refused, none is zero; the marker that misses is named."""

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from puncture_twin.planning.geometry.rigid import apply, exp_rotation, left_jacobian, pose
from puncture_twin.planning.registration.fits import REJECT_LEVEL, fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs, rigid_rss
from puncture_twin.planning.registration.registration import (
    FALSE_ALARM,
    MIN_FLE_MM,
    ResidualTest,
    outlier_marker,
    register,
)
from puncture_twin.twin.experiment.chen2019 import TABLE_1, TABLE_2

TARGET = np.array([50.0, 130.0, 63.0])
MARKERS = np.array([[10.0, 20, 147], [110, 120, 147], [60, -10, 80], [20, 150, 147], [-40, 30, 60], [90, -60, 10]])
DRAWS = 20_000
FLE_MM = 1.5


def pairs(points_ct, points_base):
    return MarkerPairs(tuple("ABCDEF"[: len(points_ct)]), points_ct, points_base)


def drawn_fre(count, fle_mm, rng):
    """FRE of many rigid fits of noisy markers, shape (DRAWS,)."""
    noisy = MARKERS[:count] + rng.normal(0, fle_mm / np.sqrt(3), (DRAWS, count, 3))
    x = MARKERS[:count] - MARKERS[:count].mean(axis=0)
    return np.sqrt(rigid_rss(x, noisy - noisy.mean(axis=1, keepdims=True)) / count)


def missing_by(millimetres):
    """The first four markers, two of them touched too far apart and two too near, each off by about so much."""
    base = MARKERS[:4].copy()
    spokes = base - base.mean(axis=0)
    signs = np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    return base + signs * millimetres * spokes / np.linalg.norm(spokes, axis=1, keepdims=True)


def test_the_closed_form_of_the_residuals_is_that_of_the_fit():
    """Spreads less twice the singular values: what the fitted markers miss by, proper rotations only."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        count = int(rng.integers(3, 7))
        x, y = rng.normal(0, 80, (2, count, 3))
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        residuals = apply(fit_rigid(x, y), x) - y
        assert rigid_rss(x, y) == pytest.approx(np.sum(residuals**2), rel=1e-9)


@pytest.mark.parametrize(("count", "power"), [(3, 0.797), (4, 0.966), (5, 0.995), (6, 0.9993)])
def test_honest_noise_is_refused_once_in_a_thousand_and_four_times_as_much_nearly_always(count, power):
    """Of 20,000 registrations 0.1 %, to four standard errors; of the larger noise what chi-squared says."""
    limit = ResidualTest(count, 0.0, FLE_MM).limit_mm
    honest, large = (np.mean(drawn_fre(count, n * FLE_MM, np.random.default_rng(count)) > limit) for n in (1, 4))
    assert honest == pytest.approx(REJECT_LEVEL, abs=4 * np.sqrt(REJECT_LEVEL / DRAWS))
    assert power == pytest.approx(chi2.sf(chi2.isf(REJECT_LEVEL, 3 * count - 6) / 16, 3 * count - 6), abs=0.001)
    assert large == pytest.approx(power, abs=0.012)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_the_interval_of_the_estimated_noise_holds_the_truth_in_95_percent(count):
    """Chi-squared with 3N - 6 degrees: with three markers the truth may be 3.7 times the estimate."""
    fre = drawn_fre(count, FLE_MM, np.random.default_rng(10 + count))[:4000]
    bounds = np.array([ResidualTest(count, float(value)).fle_interval_mm for value in fre])
    held = np.mean((bounds[:, 0] <= FLE_MM) & (bounds[:, 1] >= FLE_MM))
    assert held == pytest.approx(0.95, abs=0.015)  # four standard errors
    if count == 3:
        low, high = np.array(ResidualTest(3, 1.0).fle_interval_mm) / ResidualTest(3, 1.0).fle_mm
        assert (low, high) == (pytest.approx(0.57, abs=0.005), pytest.approx(3.73, abs=0.005))


def test_residuals_of_11_mm_are_refused_and_flagged_where_accepted():
    """Without a declared noise an FRE above 5 mm passes no more."""
    with refused("residuals_too_large"):
        register(pairs(MARKERS[:4], missing_by(11.0)), method="rigid", target_ct=TARGET)
    found = register(pairs(MARKERS[:4], missing_by(11.0)), method="rigid", target_ct=TARGET, accept_residuals=True)
    assert any(flag.code == "residuals_unexplained" for flag in found.flags)
    assert found.fle_mm > 10.0


def test_a_declared_noise_that_does_not_explain_the_residuals_is_refused_or_scaled():
    """Chi-squared beyond its 99.9 % point: refused; accepted, the noise is s times the declared, and so the error."""
    base = missing_by(3.0)
    with refused("residuals_too_large", "0.5"):
        register(pairs(MARKERS[:4], base), method="rigid", target_ct=TARGET, fle_mm=0.5)
    found = register(pairs(MARKERS[:4], base), method="rigid", target_ct=TARGET, fle_mm=0.5, accept_residuals=True)
    s = np.sqrt(np.sum(found.residuals**2) / (0.5**2 / 3) / 6)
    assert found.residual_test.scale == pytest.approx(s, rel=1e-9)
    assert found.fle_mm == pytest.approx(0.5 * s, rel=1e-9)
    low, high = found.expected_tre_interval_mm(TARGET)
    assert low < found.expected_tre_mm(TARGET[None])[0] < high
    assert f"scaled by {s:.2f}" in found.fle_source
    assert any(flag.code == "residuals_unexplained" for flag in found.flags)


def test_a_declared_noise_that_explains_the_residuals_stays_as_declared():
    found = register(pairs(MARKERS[:4], missing_by(1.0)), method="rigid", target_ct=TARGET, fle_mm=1.5)
    assert found.fle_mm == 1.5
    assert found.residual_test.fle_interval_mm == (1.5, 1.5)
    assert found.flags == ()


def test_a_triad_is_tested_by_its_rigid_fit():
    """The triad's own residuals are larger and follow no chi-squared; the paper's set passes a declared 2.5 mm."""
    ct = np.array([TABLE_1[name] for name in "ABC"], dtype=float)
    base = np.array([TABLE_2[name] for name in "ABC"])
    found = register(pairs(ct, base), method="triad", target_ct=TARGET, fle_mm=2.5)
    residuals = apply(fit_rigid(ct, base), ct) - base
    assert found.residual_test.fre_mm == pytest.approx(np.sqrt(np.mean(np.sum(residuals**2, axis=1))), rel=1e-9)
    assert found.residual_test.fre_mm < found.fre_mm


@pytest.mark.parametrize("count", [3, 4, 6])
def test_no_residual_is_no_error_of_zero(count):
    """Markers that fit to the digit: the noise keeps a floor, and three markers leave it open up to 3.7 times."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    found = register(pairs(MARKERS[:count], apply(T, MARKERS[:count])), method="rigid", target_ct=TARGET)
    assert found.fre_mm < 1e-9
    assert found.fle_mm == MIN_FLE_MM
    assert "floor" in found.fle_source
    assert found.expected_tre_mm(TARGET[None])[0] > 0.1
    assert found.expected_tre_interval_mm(TARGET).high > found.expected_tre_mm(TARGET[None])[0]


TURN = np.array([0.3, -0.2, 1.0])
T_BASE_CT = pose(exp_rotation(TURN), left_jacobian(TURN) @ [300.0, -50.0, 100.0])
PLACES = np.array([[0, 0, 80], [60, 10, 75], [0, 70, 60], [-50, -40, 65], [40, -60, 70], [-70, 30, 50]], dtype=float)
NAMES = ("A", "navel", "C", "D", "left rib", "F")


def markers(seed, noise_mm=0.4, moved=None, by_mm=0.0):
    """Six markers, each axis read with this noise; one of them moved."""
    rng = np.random.default_rng(seed)
    base = apply(T_BASE_CT, PLACES) + rng.normal(0.0, noise_mm, PLACES.shape)
    if moved is not None:
        base[moved] += by_mm * np.array([0.6, 0.0, 0.8])
    return MarkerPairs(NAMES, PLACES, base)


@pytest.mark.parametrize("moved", range(6))
def test_a_marker_that_slipped_is_called_by_its_name(moved):
    """A residual of some 4 mm among five below 1.5: named, with how far the others place it from its reading."""
    pairs = markers(3, moved=moved, by_mm=8.0)
    found = register(pairs, method="rigid", target_ct=TARGET)
    (said,) = [flag.sentence for flag in found.flags if flag.code == "outlier_marker"]
    assert said.startswith(f"marker {NAMES[moved]} does not fit: the other 5 place it")
    told = outlier_marker(pairs, None)
    rest = [row for row in range(6) if row != moved]
    T = fit_rigid(PLACES[rest], pairs.points_base[rest])
    miss = np.linalg.norm(apply(T, PLACES[moved : moved + 1])[0] - pairs.points_base[moved])
    assert told.miss_mm == pytest.approx(miss) and miss > 1.2 * found.residual_mm[moved]


def test_honest_markers_are_called_odd_as_often_as_is_said():
    """In 400 honest sets about the stated one in a hundred, by the spread of such a count."""
    count = 400
    alarms = sum(outlier_marker(markers(seed, noise_mm=1.0), None) is not None for seed in range(count))
    assert 1 <= alarms <= count * FALSE_ALARM + 4 * np.sqrt(count * FALSE_ALARM)


def test_a_declared_noise_that_explains_it_is_held():
    """What is odd among good readings is none where readings are declared to err as much."""
    pairs = markers(5, noise_mm=0.2, moved=2, by_mm=4.0)
    assert outlier_marker(pairs, None).name == "C" and outlier_marker(pairs, 3.0) is None


def test_tiny_residuals_and_few_markers_name_nobody():
    """Below the floor of the noise everything is luck; of three none can be told; a row places nothing."""
    assert outlier_marker(markers(1, noise_mm=0.0, moved=1, by_mm=0.3), None) is None
    pairs = markers(1, moved=1, by_mm=8.0)
    assert outlier_marker(MarkerPairs(NAMES[:3], pairs.points_ct[:3], pairs.points_base[:3]), None) is None
    row = np.array([[0.0, 0, 0], [50, 0, 0], [100, 0, 0], [40, 80, 0]])
    assert outlier_marker(MarkerPairs(NAMES[:4], row, row + [0, 0, 1.0]), None) is None
