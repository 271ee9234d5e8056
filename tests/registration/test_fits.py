"""Each fit is the least of what it weighs, by SciPy; what is said of its noise, by formula; test and regions hold."""

import numpy as np
import pytest
from refusals import refused
from scipy.optimize import least_squares
from scipy.special import chdtri
from uncertainty_world import declared, world

from puncture_twin.planning.geometry.rigid import apply, exp_rotation, log_rotation, pose
from puncture_twin.planning.registration.fits import (
    NoiseTest,
    ReadingNoise,
    design,
    differenced_map,
    fit_joint,
    fit_rigid,
    fit_triad,
    fit_weighted,
    least_squares_map,
    noise_test,
)
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register

T_TRUE = pose(exp_rotation(np.array([0.4, -0.2, 1.1])), np.array([300.0, -200.0, 100.0]))
MARKERS = np.array([[10.0, 20, 147], [110, 120, 147], [60, -10, 80], [90, -10, 20]])
SIX = np.vstack([MARKERS, [[20, 150, 147], [0, 80, 60]]])
TARGET = np.array([50.0, 130.0, 63.0])
READ = (0.29, 0.29, 1.44)
"""Deviations of a reading along the CT's axes, mm."""


def noise(touch=0.35, read=READ):
    """Read worse along z, each touch unlike the others, and no arm."""
    touched = np.array([touch**2 * np.diag([1.0, 1.0 + n, 1.0]) for n in range(len(MARKERS))])
    return ReadingNoise(np.diag(np.square(read)), touched, np.zeros((3 * len(MARKERS), 28)), np.zeros(28), True)


def pairs(off=0.0, seed=0):
    """Markers whose touches are off by so many mm in all directions."""
    base = apply(T_TRUE, MARKERS) + np.random.default_rng(seed).normal(0.0, off, MARKERS.shape)
    return MarkerPairs(tuple("ABCD"), MARKERS, base)


def least(points_ct, points_base, weights, T):
    """The rigid motion nearest T whose stacked residuals z have the least z' W z."""
    root = np.linalg.cholesky(weights).T

    def moved(x):
        return pose(exp_rotation(x[3:]) @ T[:3, :3], T[:3, 3] + x[:3])

    def residuals(x):
        return root @ (points_base - apply(moved(x), points_ct)).ravel()

    return moved(
        least_squares(residuals, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=[1] * 3 + [0.01] * 3).x
    )


def assert_same_motion(found, expected):
    """To a micrometre and a microradian; exactly a rotation."""
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(log_rotation(found[:3, :3] @ expected[:3, :3].T), 0.0, atol=1e-6)
    np.testing.assert_allclose(apply(found, MARKERS), apply(expected, MARKERS), atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_weighted_fit_is_the_least_by_its_own_weights(seed):
    """With the weights of the rotation that it found; it is another motion than the least-squares fit."""
    given, told = pairs(2.0, seed), noise()
    plain = fit_rigid(given.points_ct, given.points_base)
    found = fit_weighted(given.points_ct, given.points_base, told, plain)
    weights = np.linalg.inv(told.covariance(found[:3, :3]).independent)
    assert_same_motion(found, least(given.points_ct, given.points_base, weights, found))
    assert np.abs(apply(found, MARKERS) - apply(plain, MARKERS)).max() > 0.2


@pytest.mark.parametrize("seed", range(3))
def test_the_joint_fit_is_the_least_by_the_whole_covariance(seed):
    """Taken at the least-squares fit; what the arm does wrong at all markers makes it another motion."""
    w = world("abdomen/case.toml", "joint", declared(arm="nominal", tip_offset_mm=1.0, needle_direction_deg=0.5))
    told, points = w.puncture.noise, w.puncture.points_ct
    there = apply(w.puncture.T_base_ct, points) + np.random.default_rng(seed).normal(0.0, 2.0, points.shape)
    plain = fit_rigid(points, there)
    weights = np.linalg.inv(told.covariance(plain[:3, :3]).whole)
    found = fit_joint(points, there, told, plain)
    assert_same_motion(found, least(points, there, weights, plain))
    weighted = fit_weighted(points, there, told, plain)
    assert np.abs(apply(found, points) - apply(weighted, points)).max() > 1e-3


@pytest.mark.parametrize("method", ["rigid", "triad", "weighted", "joint"])
def test_many_sets_are_fitted_as_each_alone(method):
    told, count = noise(), 3 if method == "triad" else len(MARKERS)

    def fit(ct, base):
        if method in ("rigid", "triad"):
            return {"rigid": fit_rigid, "triad": fit_triad}[method](ct, base)
        return {"weighted": fit_weighted, "joint": fit_joint}[method](ct, base, told, fit_rigid(ct, base))

    base = np.array([pairs(2.0, seed).points_base[:count] for seed in range(6)])
    ct = np.broadcast_to(MARKERS[:count], base.shape)
    together = fit(ct.reshape(2, 3, count, 3), base.reshape(2, 3, count, 3))
    assert together.shape == (2, 3, 4, 4)
    for found, one in zip(together.reshape(-1, 4, 4), base, strict=True):
        np.testing.assert_allclose(found, fit(MARKERS[:count], one), atol=1e-9)


@pytest.mark.parametrize(
    ("method", "fit"), [("weighted", fit_weighted), ("joint", fit_joint), ("rigid", lambda *given: given[3])]
)
def test_a_method_is_its_fit(method, fit):
    given, told = pairs(0.5), noise()
    expected = fit(given.points_ct, given.points_base, told, fit_rigid(given.points_ct, given.points_base))
    found = register(given, method=method, target_ct=TARGET, noise=told, accept_residuals=True)
    np.testing.assert_allclose(found.T_base_ct, expected, atol=1e-9)


@pytest.mark.parametrize("method", ["rigid", "weighted", "joint"])
def test_readings_without_any_error_cannot_be_weighed(method):
    """If it is one direction of one marker; the limit is a millionth of the others' deviation."""
    told = noise(touch=0.0, read=(0.3, 0.3, 0.0))
    told.cov_base[1:] = 0.1 * np.eye(3)
    for exact in (told, noise(touch=0.0, read=(0.3, 0.3, 0.28e-6))):
        with refused("no_marker_noise"):
            register(pairs(0.1), method=method, target_ct=TARGET, noise=exact)
    enough = noise(touch=0.0, read=(0.3, 0.3, 0.32e-6))
    register(pairs(0.1), method=method, target_ct=TARGET, noise=enough, accept_residuals=True)


def test_an_arm_alone_is_noise_enough_where_nothing_is_weighed():
    """Its errors are common to all markers: they say how far the fit may be off, not which marker to trust."""
    jacobian = np.random.default_rng(1).normal(size=(12, 28))
    arm = ReadingNoise(np.zeros((3, 3)), np.zeros((4, 3, 3)), jacobian, np.full(28, 0.01), True)
    register(pairs(0.1), method="rigid", target_ct=TARGET, noise=arm, accept_residuals=True)
    for method in ("weighted", "joint"):
        with refused("no_marker_noise"):
            register(pairs(0.1), method=method, target_ct=TARGET, noise=arm, accept_residuals=True)


def test_residuals_that_hold_no_noise_do_not_tell_its_size():
    """Below a hundredth of a millimetre (rms); a declared size is not asked of them."""
    told, fre_mm = noise(), register(pairs(0.01), method="rigid", target_ct=TARGET).fre_mm
    below, above = (pairs(0.01 * wanted / fre_mm) for wanted in (0.0095, 0.0105))
    with refused("no_marker_noise"):
        register(below, method="rigid", target_ct=TARGET, noise=told, noise_found=True)
    assert register(above, method="rigid", target_ct=TARGET, noise=told, noise_found=True).uncertainty.test.scaled
    declared_size = register(below, method="rigid", target_ct=TARGET, noise=told)
    assert not declared_size.uncertainty.test.scaled


def test_what_is_said_of_declared_noise():
    """Its source, and one number instead of an interval where it agrees; else both are scaled to the residuals."""
    agreed = register(pairs(0.3), method="weighted", target_ct=TARGET, noise=noise())
    assert agreed.fle_source == "[errors]"
    assert agreed.fle_interval_mm == (agreed.fle_mm, agreed.fle_mm)
    with refused("residuals_too_large"):
        register(pairs(4.0), method="weighted", target_ct=TARGET, noise=noise())
    beyond = register(pairs(4.0), method="weighted", target_ct=TARGET, noise=noise(), accept_residuals=True)
    test = beyond.uncertainty.test
    assert test.scale > 2 and "residuals_unexplained" in [flag.code for flag in beyond.flags]

    assert beyond.fle_source == f"[errors], scaled by {test.scale:.2f} to the residuals"
    np.testing.assert_allclose(beyond.fle_interval_mm, beyond.fle_mm / test.scale * np.array(test.interval), rtol=1e-12)
    found = register(pairs(0.3), method="weighted", target_ct=TARGET, noise=noise(), noise_found=True)
    assert found.residual_test.declared_fle_mm is None
    assert agreed.residual_test.declared_fle_mm == pytest.approx(
        np.sqrt(3 * np.linalg.eigvalsh(noise().covariance(agreed.T_base_ct[:3, :3]).whole)[-1])
    )


@pytest.mark.parametrize("told", [None, noise()])
def test_the_expected_error_at_a_point_has_the_noises_interval(told):
    given = register(pairs(4.0), method="rigid", target_ct=TARGET, noise=told, accept_residuals=True)
    expected = given.expected_tre_mm(np.array([TARGET, 10.0 * TARGET]))
    assert expected.shape == (2,) and expected[1] > 2 * expected[0]
    ends = np.array(given.expected_tre_interval_mm(TARGET))
    np.testing.assert_allclose(ends / expected[0], np.array(given.fle_interval_mm) / given.fle_mm, rtol=1e-9)
    assert ends[0] < expected[0] < ends[1]
    if told is not None:
        shift = given.uncertainty.cov_at(apply(given.T_base_ct, TARGET))[:3, :3]
        assert expected[0] == pytest.approx(np.sqrt(np.trace(shift)))


@pytest.mark.parametrize("count", [3, 6])
def test_the_statistic_is_chi_squared_and_its_regions_hold(count, rng):
    """20,000 registrations: chi-squared at both tails; region by chi2 (known) and by F (found) 95 %, naive far less."""
    read, touched, markers = np.array([0.29, 0.29, 1.44]), 0.35, SIX[:count]
    cov_touched = np.tile(touched**2 * np.eye(3), (count, 1, 1))
    told = ReadingNoise(np.diag(read**2), cov_touched, np.zeros((3 * count, 28)), np.zeros(28), True)
    ct = markers + rng.normal(size=(20_000, *markers.shape)) * read
    base = apply(T_TRUE, markers) + rng.normal(size=ct.shape) * touched
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
    assert np.mean(square[:4000] <= s**2 * chdtri(3, 0.05)) < {3: 0.82, 6: 0.925}[count]
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


def test_a_method_without_a_formula_is_differenced():
    base = apply(T_TRUE, SIX)
    np.testing.assert_allclose(
        differenced_map(fit_rigid, SIX, base), least_squares_map(design(base, base.mean(axis=0))), atol=1e-6
    )
