"""Limits of chances that nothing can be held against, and errors that are none: refused, never passed as safe."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
import trimesh
from refusals import refused
from scipy.special import ndtr
from uncertainty_world import MOUNT, ball

from puncture_twin.planning.search import chances as of_candidates
from puncture_twin.planning.search.candidates import Chances, find_windows
from puncture_twin.planning.search.chances import limited, refined_chances, satisfies_limits
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.uncertainty.hit import proximity, touch_bound, touch_chance

LIMITS = "min_hit = 0.999\nmax_touch = 0.0001"
NO_READING = (
    "ct_in_plane_mm = 0\nct_slice_mm = {across}\nbed_axis = [1.0, 2.0, 3.0]\ntouch_mm = 0\nrepeatability_deg = 0\n"
)
NO_ARM = "link_mm = 0\ntwist_deg = 0\njoint_deg = 0\ntip_offset_mm = 0\n"


@pytest.mark.parametrize(("arm", "base"), [(False, None), (None, MOUNT), (None, "")])
def test_limits_without_the_arm_or_markers_are_refused(tmp_path, arm, base):
    context = prepare(ball(tmp_path, search=LIMITS, **({} if base is None else {"base": base})), arm=arm)
    with refused("no_needle_error"):
        context.search()
    with refused("no_needle_error"):
        context.check(0.35, 0.0)


def test_without_limits_cases_are_searched_and_computed_readings_err_not(tmp_path):
    found = prepare(ball(tmp_path), arm=False).search()
    assert found.safe.any() and np.isnan(found.chances.hit).all()
    with refused("no_marker_noise"):
        prepare(ball(tmp_path, errors='marker_noise = "found"', noise=0.0))
    assert prepare(ball(tmp_path, errors='marker_noise = "found"')).chance is not None


@pytest.mark.parametrize("name", ["ribb", "organ", "skin"])
def test_a_limit_of_a_structure_that_none_is_judged_by_is_refused(tmp_path, name):
    with refused("unknown_structure", name):
        prepare(ball(tmp_path, search=f"max_touch_of = {{ {name} = 0.001 }}")).search()


def test_a_chance_that_is_not_known_keeps_no_limit(tmp_path):
    context = prepare(ball(tmp_path), arm=False)
    found = context.search()
    found = replace(found, chances=Chances.unknown(("rib",), len(found)))
    settings = context.case.search
    for keys, left in (
        ({}, True),
        ({"min_hit": 0.5}, False),
        ({"max_touch": 0.5}, False),
        ({"max_touch_of": MappingProxyType({"rib": 0.5})}, False),
    ):
        case = replace(context.case, search=replace(settings, **keys))
        assert limited(case, found).safe.any() == left


@pytest.mark.parametrize("limit", ["min_hit", "max_touch"])
def test_limits_are_kept_in_a_configuration_or_not_as_the_search_says(tmp_path, limit):
    context = prepare(ball(tmp_path, errors="touch_mm = 3.0\n"))
    found = context.search()
    rows = np.flatnonzero(np.isfinite(found.chances.hit))
    hit, touch = found.chances.hit[rows], found.chances.touch[rows, 0]
    value = float(np.median(hit)) if limit == "min_hit" else float(np.sort(touch)[-2:].mean())
    case = replace(context.case, search=replace(context.case.search, **{limit: value}))
    said = limited(case, found).safe[rows]
    q = found.arm.q_insertion[rows]
    kept = satisfies_limits(replace(context.chance, case=case), found.outward_ct[rows], q)
    assert said.any() and not said.all()
    np.testing.assert_array_equal(kept, said)


@pytest.mark.parametrize("across", [0, 1])
def test_readings_without_any_error_are_refused(tmp_path, across):
    """A covariance that has no inverse weighs nothing, along an oblique axis too."""
    with refused("no_marker_noise"):
        prepare(ball(tmp_path, errors=NO_READING.format(across=across) + NO_ARM))


@pytest.mark.parametrize("name", ["any", "joint"])
def test_a_structure_with_the_name_of_another_column_is_refused(tmp_path, name):
    path = ball(tmp_path)
    path.write_text(path.read_text().replace('name = "rib"', f'name = "{name}"'))
    with refused("reserved_name"):
        prepare(path)


def test_a_surface_that_lies_off_takes_from_the_chance_to_hit(tmp_path):
    chances = []
    for surface in (0.0, 5.0):
        folder = tmp_path / str(surface)
        folder.mkdir()
        found = prepare(ball(folder, errors=f"surface_mm = {surface}")).search()
        chances.append(np.nanmax(found.chances.hit))
    assert chances[0] > 0.999 and chances[1] == pytest.approx(ndtr(6.0 / 5.0), abs=0.06)


@pytest.mark.parametrize(("errors", "told"), [("", True), ("surface_mm = 0", False), ("surface_mm = 0.5", False)])
def test_meshes_of_which_nobody_knows_how_far_they_lie_off_are_named(tmp_path, errors, told):
    context = prepare(ball(tmp_path, errors=errors))
    found = context.search()
    row = found.ranked[0]
    said = context.explain(found.theta[row], found.beta[row])
    for text in (said.text(), said.summary()["chances"]["not_modelled"]):
        assert ("errors of the meshes (organ, rib: errors.surface_mm)" in text) == told


def test_an_open_target_has_no_chance_to_be_hit(tmp_path):
    sheet = trimesh.Trimesh([[-8, -8, -6], [8, -8, -6], [8, 8, -6], [-8, 8, -6]], [[0, 1, 2], [0, 2, 3]])
    path = ball(tmp_path, organ=sheet)
    with refused("open_mesh"):
        prepare(path)
    path.write_text(path.read_text().replace('structure = "organ"', 'structure = "organ"\nhit_radius_mm = 2.0', 1))
    assert prepare(path).chance is not None


def test_a_needle_that_leans_is_refined_where_it_is_most_doubtful(tmp_path, monkeypatch):
    """A slat beside the tip is nearest, a ring below the skin is what a leaning needle touches: table and check agree.

    First order, which sees the slat alone, says less than 1 in 10,000.
    """
    slat = trimesh.creation.box((2, 40, 2))
    slat.apply_translation((4.5, 0, 4))
    ring = trimesh.creation.annulus(r_min=6.0, r_max=9.0, height=4.0)
    ring.apply_translation((0, 0, 60))
    path = ball(tmp_path, search="max_touch = 0.05", errors="needle_direction_deg = 2.0")
    trimesh.util.concatenate([slat, ring]).export(tmp_path / "rib.ply")
    path.write_text(path.read_text().replace("theta_deg = [20, 20]", "theta_deg = [0, 0]"))
    context = prepare(path)
    monkeypatch.setattr(of_candidates, "BEST", 0)  # as of the many candidates that are not among the best
    found = context.search()
    assert (found.verdict.reason == "touch_likely").any() and not found.safe.any()


@pytest.mark.parametrize("limit", [0.05, None])
def test_what_is_shown_or_may_decide_is_line_sampled_and_the_rest_is_marked(tmp_path, monkeypatch, limit):
    """Rows from a third of the limit on, the best, and the best of every window: as `check` has them."""
    path = ball(tmp_path, search=f"max_touch = {limit}" if limit else "", errors="touch_mm = 2.0\nsurface_mm = 0.7\n")
    path.write_text(
        path.read_text().replace("theta_deg = [20, 20]", "theta_deg = [10, 50]").replace("[0, 80]", "[0, 40]")
    )
    monkeypatch.setattr(of_candidates, "BEST", 2)
    context = prepare(path)
    found = context.search()
    rows = np.flatnonzero(np.isfinite(found.chances.hit))
    outward, q = found.outward_ct[rows], found.arm.q_insertion[rows]
    first = context.chance.chances(outward, q)
    lines, done = refined_chances(context.chance, outward, q, first), found.chances.refined[rows]
    shown = {*found.ranked[:2].tolist(), *(window.best for window in find_windows(found).windows)}
    near = first.touch >= (limit or np.inf) / 3
    assert done[np.isin(rows, list(shown)) | near.any(axis=1)].all()
    assert done.any() and not done.all() and (lines.touch != first.touch)[done].any()
    for name in ("touch", "margin", "touch_any"):
        table, of_lines, of_first = (getattr(one, name) for one in (found.chances, lines, first))
        np.testing.assert_array_equal(table[rows][done], of_lines[done])
        np.testing.assert_array_equal(table[rows][~done], of_first[~done])
    for row in shown:
        said = context.explain(found.theta[row], found.beta[row]).breakdown
        assert said.p_touch["rib"] == pytest.approx(found.chances.touch[row, 0], abs=1e-9)


def test_the_bound_is_never_below_first_order(rng):
    root = rng.normal(size=(50, 6, 6)) * np.array([1, 1, 1, 0.01, 0.01, 0.01])[:, None]
    cov = root @ np.swapaxes(root, -1, -2)
    outward, normal = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in rng.normal(size=(2, 50, 3)))
    distance, depth = rng.uniform(1, 5, (50, 1)), rng.uniform(0, 100, (50, 1))
    for surface, freedom in ((0.0, None), (0.5, 3)):
        near = proximity(distance, depth, normal[:, None], outward, cov, surface)
        bound = touch_bound(distance - 0.6, outward, cov, 100.0, surface, freedom)
        assert (bound >= touch_chance(near, 0.6, freedom) - 1e-12).all()
