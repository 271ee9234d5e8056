"""Where markers are proposed: on the skin, beside the windows, of little error, and never to be confused."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from case_world import coarse_carton
from refusals import refused

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.method import renamings
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.touch.marker_places import APART_MM, SLIP_MM, WINDOW_MM, girth_mm, propose_markers


@pytest.fixture(scope="module")
def carton(tmp_path_factory):
    """The carton with its arm, its candidates, and proposals by their count."""
    context = prepare(coarse_carton(tmp_path_factory.mktemp("places") / "carton", 20.0))
    candidates = context.search()
    return context, candidates, {count: propose_markers(context, candidates, count) for count in (3, 5)}


def test_places_are_on_the_skin_apart_and_beside_the_windows(carton):
    """On a triangle of the skin, so far from each entry of a safe direction, and from each other."""
    context, candidates, proposals = carton
    entries = candidates.path.entry_ct[candidates.safe]
    for count, proposal in proposals.items():
        points = np.array([one.point_ct for one in proposal.places])
        assert len(points) == count and proposal.arm == "checked" and proposal.declared
        assert max(squared_distance(point, context.anatomy.skin.mesh.triangles).min() for point in points) < 1e-12
        gaps = np.linalg.norm(points[:, None] - entries, axis=2)
        assert gaps.min() >= WINDOW_MM and gaps.min() == pytest.approx(proposal.near_window_mm)
        assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(points, 2)) >= APART_MM


def test_the_expected_error_is_that_of_fits(carton):
    """The rigid fit of 4,000 draws of the declared errors errs so much at the target; markers read along axes alike."""
    context, _, proposals = carton
    case, rng = context.case, np.random.default_rng(1)
    read = case.errors.marker_cov_ct
    for proposal in proposals.values():
        points = np.array([one.point_ct for one in proposal.places])
        read_off = rng.multivariate_normal(np.zeros(3), read, (4000, len(points)))
        touch_off = case.errors.touch_mm * rng.standard_normal((4000, len(points), 3))
        T = fit_rigid(points + read_off, points + touch_off)
        off = np.array([apply(one, case.target_ct) for one in T]) - case.target_ct
        realised = np.sqrt(np.mean(np.sum(off**2, axis=1)))
        uneven = np.sqrt(np.linalg.cond(read + case.errors.touch_mm**2 * np.eye(3)))
        assert proposal.expected_mm <= realised * 1.05  # the weighted fit, which is never worse
        assert realised <= proposal.expected_mm * uneven * 1.05


def test_more_markers_err_less_and_names_cannot_be_swapped(carton):
    """No permutation of the names fits as well as a person puts markers."""
    context, _, proposals = carton
    assert proposals[5].expected_mm < proposals[3].expected_mm
    for proposal in proposals.values():
        points = np.array([one.point_ct for one in proposal.places])
        pairs = MarkerPairs(tuple(one.name for one in proposal.places), points, points)
        assert not renamings(pairs, context.case.target_ct, SLIP_MM).found


def test_a_count_out_of_range_is_refused_and_without_a_window_there_is_no_answer(carton):
    """Two markers leave a rotation free."""
    context, candidates, _ = carton
    for count in (2, 13):
        with refused("out_of_range"):
            propose_markers(context, candidates, count)
    with refused("no_safe_direction", by=NoAnswerError):
        propose_markers(context, SimpleNamespace(safe=np.zeros(4, bool)), 4)


def test_a_tape_round_a_cylinder():
    """Radius times angle, to either side of the highest point, and straight over a hollow."""
    angles, heights = np.meshgrid(np.linspace(0, 2 * np.pi, 720, endpoint=False), np.arange(-4.0, 5.0))
    body = np.column_stack([100 * np.cos(angles.ravel()), 100 * np.sin(angles.ravel()), heights.ravel()])
    up = np.array([0.0, -1.0, 0.0])
    for degrees in (-170.0, -60.0, 0.0, 45.0, 120.0):
        along = np.radians(degrees)
        point = np.array([100 * np.sin(along), -100 * np.cos(along), 0.0])
        assert girth_mm(body, point, up) == pytest.approx(100 * along, abs=0.6)
    dented = body[~((body[:, 0] > 1) & (body[:, 1] < -1))]
    assert girth_mm(dented, np.array([100.0, 0.0, 0.0]), up) == pytest.approx(100 * np.sqrt(2), abs=0.6)
