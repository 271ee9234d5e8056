"""Choosing a candidate: by rank, window, angles or entry; and what is refused."""

import hashlib
import json

import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.search.choice import (
    BEST,
    Choice,
    choose,
    choose_stated,
    chosen_angles,
    parse_choice,
    with_file_read,
)
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.windows import find_windows
from tests.case_world import write_case

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
