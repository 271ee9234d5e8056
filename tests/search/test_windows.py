"""Windows of safe directions and safe cones by the grid, on grids whose verdicts are known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from puncture_twin.planning.case.entry import AngleGrid, outward
from puncture_twin.planning.search.ranking import grid_cone, with_grid_cone
from puncture_twin.planning.search.windows import SQUARE_DEGREES, connected, find_windows
from tests import report_world as world


def candidates(*, step_deg=2.0, **ranges):
    case = world.make_case()
    found = world.make_candidates(case, step_deg=step_deg, **ranges)
    return replace(found, grid=world.make_grid(case, step_deg=step_deg, **ranges))


def with_safe(found, safe):
    reason = np.where(safe, "", "too_close")
    rank = np.where(safe, np.cumsum(safe), 0).astype(np.int32)
    verdict, ranking = replace(found.verdict, reason=reason), replace(found.ranking, rank=rank)
    return replace(found, verdict=verdict, ranking=ranking)


@settings(max_examples=40)
@given(theta=st.floats(0, np.pi / 2), beta=st.floats(0, 2 * np.pi), radius_deg=st.floats(2 / np.sqrt(2) + 1e-6, 30))
def test_no_cone_enters_a_cap_that_is_as_wide_as_a_cell(theta, beta, radius_deg):
    """Whatever lies between the grid's directions: a barred disc of at least a cell's diagonal is never entered."""
    found = candidates()
    apart = np.arccos(np.clip(outward(found.theta, found.beta) @ outward(theta, beta), -1, 1))
    safe = apart > np.radians(radius_deg)
    cone = grid_cone(found.grid, safe)
    assert (cone <= apart[safe] - np.radians(radius_deg) + 1e-9).all()


@settings(max_examples=80)
@given(
    grid=st.sampled_from([(0, 90, 0, 360, 6.0), (0, 180, 0, 360, 12.0), (30, 80, 0, 357, 7.0), (0, 60, 20, 200, 5.0)]),
    share=st.floats(0.02, 0.98),
    seed=st.integers(0, 2**32 - 1),
    smooth=st.booleans(),
)
def test_a_cone_ends_at_the_nearest_of_all_that_are_not_safe(grid, share, seed, smooth):
    """Scattered and in patches, round the pole and round a gap between the azimuths: to the bit, found among all."""
    low, high, first, last, step = grid
    theta, beta = (np.radians(np.arange(a, b + 1e-9, step)) for a, b in ((low, high), (first, last)))
    full = np.isclose(last - first, 360)
    beta = beta[:-1] if full else beta
    angles = AngleGrid(theta, beta, np.radians(step), bool(full))
    vectors = outward(np.repeat(theta, len(beta)), np.tile(beta, len(theta)))
    rng = np.random.default_rng(seed)
    score = vectors @ rng.normal(size=3) if smooth else rng.random(len(vectors))
    safe = score > np.quantile(score, share)
    barred = np.concatenate([vectors[~safe], outward(*angles.beyond())])
    chord = cKDTree(barred).query(vectors[safe])[0]
    expected = np.maximum(2 * np.arcsin(np.clip(chord / 2, 0, 1)) - np.sqrt(2) * angles.step, 0)
    assert grid_cone(angles, safe).tolist() == expected.tolist()


def test_a_cone_never_reaches_over_the_ends_of_the_search():
    found = candidates(theta_deg=(0, 60))
    cone = grid_cone(found.grid, np.ones(len(found), bool))
    assert cone[found.theta > np.radians(59.9)].max() == pytest.approx(0.0, abs=1e-12)
    assert cone[0] == pytest.approx(np.radians(62.0) - np.sqrt(2) * np.radians(2.0), abs=1e-9)
    whole = candidates(theta_deg=(0, 180))
    np.testing.assert_allclose(grid_cone(whole.grid, np.ones(len(whole), bool)), np.pi)


def test_rejected_candidates_have_no_cone():
    found = candidates()
    found = with_grid_cone(found, found.grid)
    assert np.isnan(found.safe_cone[~found.safe]).all() and np.isfinite(found.safe_cone[found.safe]).all()


@settings(max_examples=50)
@given(share=st.floats(0.05, 0.95), seed=st.integers(0, 2**32 - 1), full=st.booleans(), low=st.sampled_from([0, 20]))
def test_windows_are_what_scipy_callsconnected(share, seed, full, low):
    """Scattered directions, round the pole, round the circle or with a gap between its ends: the same sets."""
    theta, beta = np.radians(np.arange(low, 91, 5.0)), np.radians(np.arange(0, 360 if full else 341, 5.0))
    angles = AngleGrid(theta, beta, np.radians(5.0), full)
    safe = np.random.default_rng(seed).random(len(angles)) < share
    pairs = angles.neighbours()
    pairs = pairs[safe[pairs].all(axis=1)]
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(safe), len(safe)))
    count, expected = connected_components(links, directed=False)
    assert len(set(zip(connected(angles, safe).tolist(), expected.tolist(), strict=True))) == count
    assert len(set(connected(angles, safe).tolist())) == count


def test_a_window_winds_and_goes_over_pole_and_azimuth_zero():
    angles = AngleGrid(np.radians(np.arange(10, 91, 2.0)), np.radians(np.arange(0, 91, 2.0)), np.radians(2.0), False)
    safe = np.zeros((len(angles.theta), len(angles.beta)), bool)
    safe[::2] = safe[1::4, -1] = safe[3::4, 0] = True
    label = connected(angles, safe.ravel())
    assert len(np.unique(label[safe.ravel()])) == 1
    found = candidates(step_deg=2.0)
    u = outward(found.theta, found.beta)
    for centre in (outward(0.0, 0.0), outward(np.radians(45.0), 0.0)):
        safe = np.degrees(np.arccos(np.clip(u @ centre, -1, 1))) < 12.0
        assert len(find_windows(with_safe(found, safe)).windows) == 1


def test_windows_are_the_connected_sets():
    found = candidates(step_deg=1.0)
    u = outward(found.theta, found.beta)
    centres = outward(np.radians([30.0, 60.0]), np.radians([10.0, 200.0]))
    near = np.degrees(np.arccos(np.clip(u @ centres.T, -1, 1))) < [10.0, 15.0]
    windows = find_windows(with_safe(found, near.any(axis=1)))
    assert [window.number for window in windows.windows] == [1, 2]
    for window, inside, half in zip(windows.windows, near.T, np.radians([10.0, 15.0]), strict=True):
        np.testing.assert_array_equal(windows.of_row == window.number, inside)
        cap = 2 * np.pi * (1 - np.cos(half))
        assert window.square_deg == pytest.approx(cap * SQUARE_DEGREES, rel=0.05)
        assert window.entry_cm2 == pytest.approx(cap * world.SKIN_RADIUS**2 / 100, rel=0.05)
        assert window.directions == inside.sum()
        assert windows.of_row[window.best] == window.number
    assert (windows.of_row[~near.any(axis=1)] == 0).all()


def test_a_window_is_as_wide_as_a_cone_and_nothing_safe_has_none():
    found = with_safe(candidates(), np.ones(len(candidates()), bool))
    straight = find_windows(found).windows[0].entry_cm2
    oblique = replace(found, path=replace(found.path, skin_angle=np.full(len(found), np.radians(60.0))))
    assert find_windows(oblique).windows[0].entry_cm2 == pytest.approx(2 * straight)
    found = candidates()
    windows = find_windows(with_safe(found, np.zeros(len(found), bool)))
    assert windows.windows == () and (windows.of_row == 0).all()
    found = candidates(step_deg=1.0)
    far = np.abs(np.degrees(found.theta) - 70.0) < 3.0  # a ring: narrow, but longer
    whole = find_windows(with_safe(found, np.degrees(found.theta) < 20.5))
    assert whole.largest.wide_deg == pytest.approx(41.0, abs=0.1)
    both = find_windows(with_safe(found, far | (np.degrees(found.theta) < 20.5)))
    largest = max(both.windows, key=lambda one: one.entry_cm2)
    assert both.largest == largest and both.headline.startswith("the largest window: ")
    assert f"count {len(both)}" in repr(both)
    assert f"{largest.entry_cm2:.1f} cm2 on the skin, {largest.wide_deg:.0f} deg wide" in both.headline
    assert find_windows(with_safe(found, np.zeros(len(found), bool))).headline == "no window: nothing is safe"
