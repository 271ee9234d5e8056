"""Grids of angles: solid angles that add up, neighbours, and what lies beyond."""

import numpy as np
import pytest

from puncture_twin.planning.case.entry import grid, outward


def angle_grid(theta_deg, beta_deg, step_deg):
    return grid(tuple(np.radians(theta_deg)), tuple(np.radians(beta_deg)), np.radians(step_deg), np.eye(3)).grid


@pytest.mark.parametrize(
    ("theta_deg", "beta_deg"),
    [((0, 90), (0, 360)), ((0, 180), (0, 360)), ((20, 60), (0, 360)), ((10, 40), (30, 120)), ((0, 40), (30, 120))],
)
def test_solid_angles_are_those_of_the_whole_range(theta_deg, beta_deg):
    """(cos θ0 - cos θ1) Δβ, however the range lies."""
    found = angle_grid(theta_deg, beta_deg, 2.0)
    (low, high), width = np.radians(theta_deg), np.radians(beta_deg[1] - beta_deg[0])
    assert found.solid_angle().sum() == pytest.approx((np.cos(low) - np.cos(high)) * width, rel=1e-12)
    assert len(found.solid_angle()) == len(found)


def test_neighbours_are_at_most_a_step_apart_and_each_row_has_all_of_its_own():
    """Four neighbours inside, along the full circle too; all rows at the pole are one direction."""
    found = angle_grid((0, 60), (0, 360), 10.0)
    pairs = found.neighbours()
    vectors = outward(np.repeat(found.theta, len(found.beta)), np.tile(found.beta, len(found.theta)))
    apart = np.arccos(np.clip((vectors[pairs[:, 0]] * vectors[pairs[:, 1]]).sum(axis=1), -1, 1))
    assert apart.max() <= np.radians(10.0) + 1e-7
    counts = np.bincount(pairs.ravel(), minlength=len(found)).reshape(7, 36)
    assert (counts[1:-1] == 4).all() and (counts[-1] == 3).all()
    at_pole = {tuple(sorted(pair)) for pair in pairs.tolist() if max(pair) < 36}
    assert {(i, i + 1) for i in range(35)} <= at_pole


def test_an_open_range_of_azimuths_has_ends():
    found = angle_grid((10, 30), (0, 350), 10.0)
    assert not found.full_circle
    assert {(0, 35), (35, 0)}.isdisjoint(map(tuple, found.neighbours().tolist()))


def test_beyond_lies_one_step_outside():
    """Around the cap alone for a full circle; on all four sides otherwise; nowhere for the whole sphere."""
    theta, beta = angle_grid((0, 60), (0, 360), 10.0).beyond()
    np.testing.assert_allclose(np.degrees(theta), 70.0)
    assert len(beta) == 36
    theta, beta = np.degrees(angle_grid((20, 60), (30, 90), 10.0).beyond())
    assert {10.0, 70.0} <= set(np.round(theta, 9)) and {20.0, 100.0} <= set(np.round(beta, 9))
    assert len(angle_grid((0, 180), (0, 360), 10.0).beyond()[0]) == 0
