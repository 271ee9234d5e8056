"""The chance to hit: against closed forms, and against a million draws."""

import numpy as np
import pytest
from scipy.special import chdtr

from puncture_twin.planning.uncertainty.hit import (
    chance_within,
    hit_in_ball,
    hit_in_mesh,
    mean_over_faces,
    rays_to_ball,
    target_rays,
)

DRAWS = np.random.default_rng(3).normal(size=(1_000_000, 3))

DEVIATIONS = [(1.0, 1.0, 1.0), (1.0, 1.7, 0.5), (1.0, 10.0, 1.0), (10.0, 10.0, 1.0)]


def covariance(deviations, seed=0):
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return axes @ np.diag(np.square(deviations)) @ axes.T, axes


@pytest.mark.parametrize("deviations", DEVIATIONS)
@pytest.mark.parametrize("radius", [0.3, 2.5, 8.0])
def test_within_a_radius_as_a_million_draws_say(deviations, radius):
    found = hit_in_ball(covariance(deviations)[0][None], radius)[0]
    assert found == pytest.approx(np.mean(np.sum((DRAWS * deviations) ** 2, axis=1) < radius**2), abs=0.0015)


def test_equal_axes_are_a_chi_squared():
    """P(s |z| < a) to 1e-7; and two equal axes beside one that is nearly none are a Rayleigh distribution."""
    radii = np.array([[0.1, 0.7, 2.0, 5.0]])
    np.testing.assert_allclose(chance_within(np.full((1, 3), 4.0), radii)[0], chdtr(3, radii[0] ** 2 / 4), atol=1e-7)
    flat = chance_within(np.array([[1e-3, 1.0, 1.0]]), radii)[0]
    np.testing.assert_allclose(flat, 1 - np.exp(-(radii[0] ** 2) / 2), atol=1e-3)


def test_the_chance_grows_with_the_radius_and_is_never_above_one():
    radii = np.linspace(0, 200, 400)[None]
    for high in (1.0, 5.0, 30.0):
        found = chance_within(np.array([[1.0, 2.0, high**2]]), radii)[0]
        assert found[0] == 0
        assert np.all(np.diff(found) > -1e-7)
        assert 1 - 1e-6 < found[-1] <= 1


def test_a_size_that_is_all_but_known_gives_the_chance_of_a_known_one(ball):
    rays = target_rays(ball(8.0), np.array([3.0, 0.0, 0.0]))
    covs = np.array([covariance(size * np.array([1.0, 2.0, 3.0]))[0] for size in np.geomspace(0.1, 50.0, 20)])
    np.testing.assert_allclose(hit_in_mesh(rays, covs), hit_in_mesh(rays, covs, 10**7), atol=5e-6)


@pytest.mark.parametrize("deviations", DEVIATIONS)
@pytest.mark.parametrize("off", [0.0, 8.0, 12.0])
def test_within_a_ball_of_triangles_from_inside_on_its_face_and_outside(ball, deviations, off):
    deviations = 3 * np.array(deviations)
    cov, axes = covariance(deviations, seed=1)
    found = hit_in_mesh(target_rays(ball(8.0, subdivisions=4), np.array([off, 0.0, 0.0])), cov[None])[0]
    tips = (DRAWS * deviations) @ axes.T + [off, 0, 0]
    assert found == pytest.approx(np.mean(np.sum(tips**2, axis=1) < 64), abs=0.004)


@pytest.mark.parametrize(("surface", "off"), [(1.0, 0.0), (1.0, 6.0), (2.5, 8.0), (5.0, 0.0)])
def test_a_surface_that_lies_off_as_a_whole_makes_the_ball_larger_or_smaller(ball, surface, off):
    """By a normal number; a ball that is less than nothing is never hit."""
    cov, axes = covariance((2.0, 1.0, 1.5), seed=3)
    rays = target_rays(ball(8.0, subdivisions=4), np.array([off, 0.0, 0.0]))
    tips = (DRAWS * [2.0, 1.0, 1.5]) @ axes.T + [off, 0, 0]
    radius = 8.0 + surface * np.random.default_rng(4).normal(size=len(tips))
    truth = np.mean(np.linalg.norm(tips, axis=1) < radius)
    assert hit_in_mesh(rays, cov[None], surface_mm=surface)[0] == pytest.approx(truth, abs=0.02)


def test_the_mean_over_faces_is_that_of_the_directions_that_they_face(ball, box):
    S = np.diag([0.04, 0.09, 2.0])
    assert mean_over_faces(box((1000.0, 1000.0, 1e-3)), S) == pytest.approx(np.sqrt(2.0), rel=1e-3)
    assert mean_over_faces(ball(1.0), S) == pytest.approx(np.sqrt(2.13 / 3), rel=1e-3)


@pytest.mark.parametrize("deviations", DEVIATIONS)
@pytest.mark.parametrize("off", [0.0, 2.0, 5.0])
def test_within_a_radius_of_a_target_beside_which_the_tip_is_believed(deviations, off):
    """A known offset beside the covariance: to .004 of a million draws; without one it is Ruben's series."""
    cov, axes = covariance(deviations, seed=2)
    offset = off * np.array([0.6, 0.0, 0.8])
    found = hit_in_mesh(rays_to_ball(offset, 2.0), cov[None])[0]
    tips = (DRAWS * deviations) @ axes.T + offset
    assert found == pytest.approx(np.mean(np.sum(tips**2, axis=1) < 4), abs=0.004)
    if off == 0:
        assert found == pytest.approx(hit_in_ball(cov[None], 2.0)[0], abs=0.004)


def test_a_target_on_a_flat_face_is_hit_half_of_the_time_at_most(box):
    rays = target_rays(box([50.0, 50.0, 50.0]), np.array([25.0, 0.0, 0.0]))
    assert hit_in_mesh(rays, np.eye(3)[None])[0] == pytest.approx(0.5, abs=0.002)


def test_an_error_whose_size_was_estimated_follows_fishers_f(ball):
    cov, _ = covariance((1.0, 2.0, 0.7))
    size = np.sqrt(3 / np.random.default_rng(5).chisquare(3, len(DRAWS)))
    drawn = np.sum((DRAWS * [1.0, 2.0, 0.7] * size[:, None]) ** 2, axis=1) < 4
    assert hit_in_ball(cov[None], 2.0, 3)[0] == pytest.approx(drawn.mean(), abs=0.002)
    rays = target_rays(ball(2.0, subdivisions=4), np.zeros(3))
    assert hit_in_mesh(rays, cov[None], 3)[0] == pytest.approx(drawn.mean(), abs=0.006)


def test_no_error_hits_for_certain_and_outside_never(ball):
    for off, chance in ((0.0, 1.0), (3.0, 0.0)):
        assert hit_in_mesh(target_rays(ball(2.0, subdivisions=2), np.array([off, 0, 0])), np.zeros((1, 3, 3)))[
            0
        ] == pytest.approx(chance)
    assert hit_in_ball(np.zeros((1, 3, 3)), 0.5)[0] == pytest.approx(1.0)
