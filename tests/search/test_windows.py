"""Windows of safe directions and safe cones on grids whose verdicts are known; which candidate is chosen, or none."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.case.entry import AngleGrid, outward
from puncture_twin.planning.search.candidates import SQUARE_DEGREES, connected, find_windows
from puncture_twin.planning.search.choice import (
    BEST,
    Choice,
    choose,
    choose_stated,
    chosen_angles,
    parse_choice,
    with_file_read,
)
from puncture_twin.planning.search.constraints import grid_cone, with_grid_cone
from puncture_twin.planning.search.context import prepare
from tests import report_world as world
from tests.case_world import write_case


def candidates(*, step_deg=2.0, **ranges):
    case = world.make_case()
    found = world.make_candidates(case, step_deg=step_deg, **ranges)
    return replace(found, grid=world.make_directions(case, step_deg=step_deg, **ranges).grid)


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


CHANGES = (('space = "LPS"', 'space = "RAS"'), ("theta_deg = [0, 10]", 'frame = "ct"\ntheta_deg = [0, 60]'))


@pytest.fixture(scope="module")
def context(tmp_path_factory):
    return prepare(write_case(tmp_path_factory.mktemp("choice"), *CHANGES), arm=False)


@pytest.fixture(scope="module")
def found(context):
    return context.search()


def test_a_rank_is_one_row_and_a_window_its_rows_the_best_first(context, found):
    assert parse_choice(None, None, None, None, None) == BEST
    np.testing.assert_array_equal(choose(context, found, BEST).rows, found.ranked)
    chosen = choose(context, found, Choice(rank=5))
    assert chosen.candidates.ranking.rank[chosen.rows].tolist() == [5]
    windows = find_windows(found)
    chosen = choose(context, found, Choice(window=len(windows.windows)))
    assert set(windows.of_row[chosen.rows]) == {len(windows.windows)}
    assert (np.diff(found.ranking.rank[chosen.rows]) > 0).all()


def test_an_entry_is_in_the_space_of_the_case_and_gives_its_own_direction_back(context, found):
    row = int(found.ranked[0])
    typed = tuple((found.path.entry_ct[row] * [-1, -1, 1]).tolist())
    theta, beta = chosen_angles(context.case, Choice(entry_mm=typed))
    np.testing.assert_allclose((theta, beta), (found.theta[row], found.beta[row]), atol=1e-9)
    chosen = choose(context, found, Choice(entry_mm=typed))
    np.testing.assert_allclose(chosen.candidates.path.entry_ct[0], found.path.entry_ct[row], atol=1e-6)


def test_points_that_are_no_entry_and_rejected_directions_are_refused(context, found):
    row = int(found.ranked[0])
    off = context.case.target_ct + 0.5 * (found.path.entry_ct[row] - context.case.target_ct)
    with refused("entry_elsewhere", "RAS"):
        choose(context, found, Choice(entry_mm=tuple((off * [-1, -1, 1]).tolist())))
    typed = tuple((context.case.target_ct * [-1, -1, 1]).tolist())
    with refused("entry_at_target"):
        choose(context, found, Choice(entry_mm=typed))
    row = int(np.flatnonzero(~found.safe)[0])
    with refused("direction_rejected", found.verdict.reason[np.flatnonzero(~found.safe)[0]], by=NoAnswerError):
        choose(context, found, Choice(angles=(found.theta[row], found.beta[row])))


@pytest.mark.parametrize(
    ("choice", "allowed"), [(Choice(rank=10**6), "out_of_range"), (Choice(window=500), "out_of_range")]
)
def test_what_there_is_not_is_refused_with_what_there_is(context, found, choice, allowed):
    with refused(allowed):
        choose(context, found, choice)


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ((1.0, None, None, None, None), "one_angle"),
        ((1.0, 2.0, 3, None, None), "conflicting_options"),
        ((None, None, 1, 2, None), "conflicting_options"),
        ((None, None, None, None, "1,2"), "wrong_count"),
        ((None, None, None, None, "1,2,nan"), "not_finite"),
        ((None, None, None, None, "left"), "not_a_number"),
    ],
)
def test_choices_that_are_none_are_refused(typed, said):
    with refused(*said.split()):
        parse_choice(*typed)


def line(path, *points, kind="Line", system="LPS"):
    controls = [{"label": f"L-{n}", "position": list(map(float, p)), "positionStatus": "defined"} for n, p in points]
    markup = {"type": kind, "coordinateSystem": system, "coordinateUnits": "mm", "controlPoints": controls}
    path.write_text(json.dumps({"markups": [markup]}))
    return path


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_end_of_a_line_away_from_the_target_is_the_entry(context, found, tmp_path, order):
    """Drawn in either direction; the file's own space holds, and its hash is handed on."""
    row = int(found.ranked[0])
    ends = [found.path.entry_ct[row], context.case.target_ct + 3.0]
    path = line(tmp_path / "line.mrk.json", *((n, ends[n]) for n in order))
    choice = with_file_read(context.case, parse_choice(None, None, None, None, str(path)))
    np.testing.assert_allclose(np.multiply(choice.entry_mm, [-1, -1, 1]), found.path.entry_ct[row])
    np.testing.assert_allclose(choose_stated(context, choice).candidates.theta, found.theta[row], atol=1e-9)
    assert choice.read[0].sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    one = line(tmp_path / "one.mrk.json", (0, ends[0]), kind="Fiducial")
    assert with_file_read(context.case, Choice(entry_file=one)).entry_mm == choice.entry_mm


def test_a_line_to_elsewhere_or_many_points_are_no_entry(context, tmp_path):
    elsewhere = line(tmp_path / "line.mrk.json", (1, (80, 0, 0)), (2, (0, 60, 0)))
    with refused("line_misses_target", "60.0"):
        with_file_read(context.case, Choice(entry_file=elsewhere))
    many = line(tmp_path / "many.mrk.json", *((n, (n, 0, 0)) for n in range(3)), kind="Fiducial")
    with refused("wrong_count"):
        with_file_read(context.case, Choice(entry_file=many))
