"""Registration by declared errors: its test, its regions, its interval, and what is refused."""

import numpy as np
import pytest
from refusals import refused
from scipy.special import chdtri

from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose
from puncture_twin.planning.registration.fits import (
    ReadingNoise,
    design,
    differenced_map,
    fit_rigid,
    fit_weighted,
    least_squares_map,
)
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.registration.residuals import NoiseTest, noise_test

T_TRUE = pose(exp_rotation(np.array([0.4, -0.2, 1.1])), np.array([300.0, -200.0, 100.0]))
MARKERS = np.array([[10.0, 20, 147], [110, 120, 147], [60, -10, 80], [90, -10, 20], [20, 150, 147], [0, 80, 60]])


def noise(count, *, ct=(0.29, 0.29, 1.44), touch=0.35):
    """Of so many markers, read worse along z, touched alike; no arm."""
    return ReadingNoise(
        np.diag(np.square(ct)),
        np.tile(touch**2 * np.eye(3), (count, 1, 1)),
        np.zeros((3 * count, 28)),
        np.zeros(28),
        True,
    )


def draws(count, markers, rng, told):
    ct = markers + rng.normal(size=(count, *markers.shape)) * np.sqrt(np.diag(told.cov_ct))
    base = apply(T_TRUE, markers) + rng.normal(size=ct.shape) * np.sqrt(told.cov_base[0, 0, 0])
    return ct, base


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_the_statistic_is_chi_squared_and_its_regions_hold(count, rng):
    """20,000 registrations: chi-squared at both tails; region by chi2 (known) and by F (found) 95 %, naive far less."""
    told, markers = noise(count), MARKERS[:count]
    ct, base = draws(20_000, markers, rng, told)
    T = fit_weighted(ct, base, told, fit_rigid(ct, base))
    omega = told.covariance(T_TRUE[:3, :3]).independent
    fitted = apply(T_TRUE, markers)
    A = design(fitted, fitted.mean(axis=0))
    L = least_squares_map(A, np.linalg.inv(omega))
    target = np.array([50.0, 130.0, 63.0])
    error = T[:, :3, :3] @ target + T[:, :3, 3] - apply(T_TRUE, target)
    X = np.concatenate([np.eye(3), -np.cross(np.eye(3), apply(T_TRUE, target) - fitted.mean(axis=0))], axis=1)
    cov = X @ L @ omega @ L.T @ X.T
    square = np.einsum("na,ab,nb->n", error, np.linalg.inv(cov), error)
    residuals = base - (np.einsum("nab,nmb->nma", T[:, :3, :3], ct) + T[:, None, :3, 3])
    tests = [noise_test(r.ravel(), omega, A) for r in residuals[:4000]]
    assert np.mean([test.probability < 0.01 for test in tests]) == pytest.approx(0.01, abs=0.006)
    assert np.mean([test.probability > 0.9 for test in tests]) == pytest.approx(0.1, abs=0.02)
    assert np.mean(square <= chdtri(3, 0.05)) == pytest.approx(0.95, abs=0.006)
    s = np.array([test.estimate for test in tests])
    factor = NoiseTest(count, 1.0, found=True).region_factor
    assert np.mean(square[:4000] <= (s * factor) ** 2) == pytest.approx(0.95, abs=0.012)
    assert np.mean(square[:4000] <= s**2 * chdtri(3, 0.05)) < {3: 0.82, 4: 0.88, 5: 0.905, 6: 0.925}[count]
    held = [test.interval.low <= 1 <= test.interval.high for test in tests]
    assert np.mean(held) == pytest.approx(0.95, abs=0.012)


@pytest.mark.parametrize(
    ("count", "low", "high", "factor"),
    [(3, 0.57, 3.73, 5.28), (4, 0.64, 2.20, 3.78), (5, 0.69, 1.83, 3.40), (6, 0.72, 1.65, 3.24)],
)
def test_interval_and_region_of_an_estimated_size(count, low, high, factor):
    test = NoiseTest(count, float(3 * count - 6), found=True)
    assert test.estimate == pytest.approx(1.0)
    np.testing.assert_allclose(test.interval, (low, high), atol=0.006)
    assert test.region_factor == pytest.approx(factor, abs=0.006)


def test_alike_axes_are_weighed_alike(rng):
    told = noise(6, ct=(0.5, 0.5, 0.5))
    ct, base = draws(1, MARKERS, rng, told)
    plain = fit_rigid(ct[0], base[0])
    np.testing.assert_allclose(fit_weighted(ct[0], base[0], told, plain), plain, atol=1e-9)


def test_a_method_without_a_formula_is_differenced(rng):
    base = apply(T_TRUE, MARKERS)
    np.testing.assert_allclose(
        differenced_map(fit_rigid, MARKERS, base), least_squares_map(design(base, base.mean(axis=0))), atol=1e-6
    )


def test_residuals_far_beyond_the_declaration_are_refused_and_can_be_accepted():
    """Then all errors are scaled to them, and chances follow Student's t."""
    base = apply(T_TRUE, MARKERS) + np.random.default_rng(0).normal(0, 4.0, MARKERS.shape)
    pairs = MarkerPairs(tuple("ABCDEF"), MARKERS, base)
    settings = {"method": "weighted", "target_ct": np.array([50.0, 130.0, 63.0]), "noise": noise(6)}
    with refused("residuals_too_large"):
        register(pairs, **settings)
    found = register(pairs, **settings, accept_residuals=True)
    assert found.uncertainty.test.scaled
    assert found.uncertainty.test.scale > 2
    assert any(flag.code == "residuals_unexplained" for flag in found.flags)
    assert found.fle_interval_mm.low < found.fle_mm < found.fle_interval_mm.high
