"""Where markers are proposed: on the skin, beside the windows, of little error, and never to be confused."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from case_world import coarse_carton
from refusals import refused
from scipy.spatial.distance import pdist

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.registration.fits import design, fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs, renamings
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.touch import marker_places
from puncture_twin.planning.touch.marker_places import APART_MM, SLIP_MM, WINDOW_MM, propose_markers, tape_to
from puncture_twin.twin.plant.scanner.image import box


@pytest.fixture(scope="module")
def carton(tmp_path_factory):
    context = replace(prepare(coarse_carton(tmp_path_factory.mktemp("places") / "carton", 20.0)), chance=None)
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
    context, _, proposals = carton
    assert proposals[5].expected_mm < proposals[3].expected_mm
    for proposal in proposals.values():
        points = np.array([one.point_ct for one in proposal.places])
        pairs = MarkerPairs(tuple(one.name for one in proposal.places), points, points)
        assert not renamings(pairs, context.case.target_ct, SLIP_MM).found


def test_a_count_out_of_range_is_refused_and_without_a_window_there_is_no_answer(carton):
    context, candidates, _ = carton
    for count in (2, 13):
        with refused("out_of_range"):
            propose_markers(context, candidates, count)
    with refused("no_safe_direction", by=NoAnswerError):
        propose_markers(context, SimpleNamespace(safe=np.zeros(4, bool)), 4)


def test_nothing_stands_over_a_place_and_none_is_on_an_edge(carton):
    """An arm across the top, 40 mm above, as the CT shows it; the nearest edge of the box is a marker's half away."""
    context, candidates, proposals = carton
    points = np.array([one.point_ct for one in proposals[5].places])
    top = context.anatomy.skin.mesh.vertices[:, 2].max()
    low, high = points.min(axis=0), points.max(axis=0)
    arm = box(np.array([low[0], points[:, 1].mean(), top + 55.0]), np.array([60.0, np.ptp(points[:, 1]) + 80.0, 30.0]))
    over = np.abs(points[:, 0] - low[0]) < 30.0
    limb = Structure(OUTSIDE_BODY, Role.UNKNOWN, 0.0, arm, "arm")
    anatomy = replace(context.anatomy, surroundings=(*context.anatomy.surroundings, limb))
    found = propose_markers(replace(context, anatomy=anatomy, placement=None, reach=None), candidates, 5)
    moved = np.array([one.point_ct for one in found.places])
    assert over.any() and (np.abs(moved[:, 0] - low[0]) > 30.0).all() and high[0] > low[0] + 30.0
    normals = np.array([one.normal_ct for one in (*found.places, *proposals[5].places)])
    assert np.allclose(np.abs(normals).max(axis=1), 1.0)


def test_where_windows_cover_the_skin_the_best_places_are_given_with_what_is_not_met(carton):
    """Entries all over the top, 25 mm apart: no place is so far from each; if they are 4 mm apart there is none."""
    context, candidates, _ = carton
    bare, mesh = replace(context, placement=None, reach=None), context.anatomy.skin.mesh

    def entries(step):
        at = [np.arange(low, high, step) for low, high in mesh.bounds.T[:2]]
        grid = np.stack([*np.meshgrid(*at), np.full((len(at[1]), len(at[0])), mesh.bounds[1, 2])], axis=-1).reshape(
            -1, 3
        )
        best = SimpleNamespace(row=0)
        return SimpleNamespace(safe=np.ones(len(grid), bool), path=SimpleNamespace(entry_ct=grid), best=best)

    found = propose_markers(bare, entries(25.0), 4)
    assert len(found.places) == 4 and 5.0 < found.near_window_mm < WINDOW_MM
    assert "from an entry" in found.unmet[0] and f"{found.near_window_mm:.0f} mm" in found.unmet[0]
    with refused("no_place", by=NoAnswerError):
        propose_markers(bare, entries(4.0), 4)
    assert propose_markers(bare, candidates, 4).unmet == ()


@pytest.mark.parametrize("count", [3, 4])
def test_no_set_of_a_coarse_choice_errs_less(carton, monkeypatch, count):
    """Against all sets of 18 places, apart and told apart: the least error, to 2 %."""
    context, candidates, _ = carton
    monkeypatch.setattr(marker_places, "PLACES", 18)
    monkeypatch.setattr(marker_places, "BETWEEN_PLACES_MM", 20.0)
    tried = []
    thinned = marker_places._thinned
    monkeypatch.setattr(
        marker_places, "_thinned", lambda points: tried.append(points[thinned(points)]) or thinned(points)
    )
    bare, case = replace(context, placement=None, reach=None), context.case
    found = propose_markers(bare, candidates, count)
    (points,) = tried
    C = case.errors.marker_cov_ct + case.errors.touch_mm**2 * np.eye(3)
    sets = [some for rows in itertools.combinations(range(len(points)), count)
            if pdist(some := points[list(rows)]).min() >= APART_MM]  # fmt: skip
    errors = []
    for some in sets:
        A = design(some, case.target_ct)
        information = A.T @ np.kron(np.eye(count), np.linalg.inv(C)) @ A
        known = np.linalg.cond(information) < 1e12
        errors.append(np.sqrt(np.trace(np.linalg.inv(information)[:3, :3])) if known else np.inf)
    for row in np.argsort(errors):
        names = MarkerPairs(tuple("ABCD"[:count]), sets[row], sets[row])
        if not renamings(names, case.target_ct, SLIP_MM).found:
            assert errors[row] <= found.expected_mm * (1 + 1e-6) and found.expected_mm <= 1.02 * errors[row]
            return
    pytest.fail("no set is told apart")


def test_a_tape_round_a_cylinder():
    """Radius times angle to either side of the middle, whichever side is up, and straight over a hollow."""
    cylinder = trimesh.creation.cylinder(100.0, 8.0, sections=720)
    skin = Skin(
        TriangleMesh(np.asarray(cylinder.vertices), np.asarray(cylinder.faces)),
        np.zeros(len(cylinder.faces), bool),
        None,
        (),
    )
    sides = {"front": [0, -1, 0], "left": [1, 0, 0], "back": [0, 1, 0], "right": [-1, 0, 0]}
    names = [*sides]
    for number, (name, up) in enumerate(sides.items()):
        for degrees in (-170.0, -60.0, 45.0, 120.0):
            upward, across = np.array(up, float), np.array(sides[names[(number + 1) % 4]], float)
            point = 100 * (np.cos(np.radians(degrees)) * upward + np.sin(np.radians(degrees)) * across)
            tape = tape_to(skin, point - [0, 0, 4.0], upward)
            assert tape.length_mm == pytest.approx(100 * np.radians(abs(degrees)), abs=0.6), name
            assert tape.toward == names[(number + (1 if degrees > 0 else -1)) % 4], name


def test_where_the_image_cuts_the_sides_nobody_can_halve_them():
    mesh = trimesh.creation.box([300.0, 200.0, 6.0])
    cut = mesh.face_normals[:, 0] > 0.9
    for flags, known in ((cut, False), (np.zeros(len(cut), bool), True)):
        skin = Skin(TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)), flags, None, ())
        tape = tape_to(skin, np.array([-40.0, -100.0, 0.0]), np.array([0.0, -1.0, 0.0]))
        assert (tape is not None) == known
    assert tape.length_mm == pytest.approx(40.0) and tape.toward == "right"
