"""What map and page show of chances: where there are some, and nothing new where there are none."""

from dataclasses import replace

import numpy as np
import pytest
import report_world as world
from PIL import Image

from puncture_twin.planning.search.candidates import Chances
from puncture_twin.planning.search.uncertainty_breakdown import Goal, Remedy, UncertaintyBreakdown
from puncture_twin.planning.uncertainty.pose_error import ErrorBudget
from puncture_twin.twin.report.map.map_raster import chance_raster, map_raster, touch_nothing
from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.page.page import Uncertainty, methods_text
from puncture_twin.twin.report.page.page_data import map_data
from puncture_twin.twin.report.patient import trials
from puncture_twin.twin.report.present import Section, text

BUDGET = ErrorBudget(1.0, 0.8, 0.6, np.array([1.9, 1.5, 1.2]), {"touch": 0.75, "ct_slice": 0.25})
BREAKDOWN = UncertaintyBreakdown(
    0.93, {"rib_right_9": 0.02}, 0.02, BUDGET, "residuals agree with the declared errors",
    (Goal("", 0.99, False, (Remedy("touch", 0.35, 0.1),), 0.6),), "breathing, needle bending, tissue motion",
)  # fmt: skip
ROOMS = {
    "rooms": 1000, "seed": 7, "unreached": 3, "realised_rms_mm": 1.01, "predicted_rms_mm": 1.0, "coverage_95": 0.947,
    "hit_share": 0.93, "mean_p_hit": 0.931, "touch_share": 0.02, "mean_p_touch": 0.021, "wrong_belief": True,
    "touch_share_by_structure": {"rib_right_9": 0.02}, "p_touch_by_structure": {"rib_right_9": 0.021},
    "guessed_touches": True, "not_modelled": "breathing, needle bending, tissue motion",
}  # fmt: skip

GAINS = {
    "expected_mm": 2.0,
    "sources": [{"text": "touch noise", "alone_mm": 1.6, "without_mm": 1.2}],
    "changes": [{"group": "slices", "text": "slices of 1 mm", "expected_mm": 1.25}],
    "best": {"group": "slices", "text": "slices of 1 mm", "expected_mm": 1.25},
    "not_modelled": "tissue motion",
}

TOLD = (
    "The next 0.75 mm would be gained by: slices of 1 mm.",
    "1.60</td>",
    "How sure it is",
    "0.93",
    "touch noise (touch_mm) would have to be 0.1 mm instead of 0.35",
    "75.0 %",
    "breathing, needle bending",
    "In many trials",
    "94.70 %",
    "p_touch_any",
    "wrong by design",
)


@pytest.fixture(scope="module")
def shown():
    """A case, its candidates with chances that grow with the clearance, and its plan."""
    case = world.make_case()
    found = world.make_candidates(case)
    touch = np.where(found.safe, np.exp(-found.clearance.least / 3), np.nan)
    blank = np.where(found.safe, 0.93, np.nan)
    wide = np.stack([touch, np.zeros(len(found))], axis=1)
    chances = Chances(
        found.clearance.structures, blank, wide, wide, touch, touch, blank, blank, np.ones(len(found), bool)
    )
    return case, replace(found, chances=chances)


def test_the_layer_shows_what_the_table_holds(shown):
    """Within the safe region, smoothed by less than half a cell; nothing of a case without chances."""
    case, found = shown
    rows = map_raster(found, map_view(case, found), 400).rows
    chance = chance_raster(found, rows)
    known = np.append(found.safe, False)[rows]
    assert np.array_equal(np.isfinite(chance), known)
    assert np.median(np.abs(chance[known] - touch_nothing(found)[rows[known]])) < 0.02
    assert chance_raster(replace(found, chances=None), rows) is None


def test_the_map_has_the_layer_only_with_chances(shown):
    case, found = shown
    with_it, without = (np.asarray(world.map_image(one, case)) for one in (found, replace(found, chances=None)))
    assert (with_it != without).any(axis=2).mean() > 0.01


def test_the_page_says_how_sure_it_is(shown, tmp_path):
    """Chances, sources, the test, what would have to shrink, what is not modelled; the pointer reads both chances."""
    case, found = shown
    picture = tmp_path / "rooms.png"
    Image.new("RGB", (4, 4)).save(picture)
    anatomy, told = world.make_anatomy(), (world.make_plan(case, found), None, world.make_registration())
    plain = world.page_text(tmp_path, case, anatomy, replace(found, chances=None), *told)
    uncertainty = Uncertainty(BREAKDOWN, ROOMS, picture, GAINS)
    text = world.page_text(tmp_path, case, anatomy, found, *told, uncertainty=uncertainty)
    for words in TOLD:
        assert words in text
    for words in ("How sure it is", "In many trials", 'id="budget"'):
        assert words not in plain
    none = replace(found, chances=replace(found.chances, hit=np.full(len(found), np.nan)))
    for one, computed in ((found, True), (none, False), (replace(found, chances=None), False)):
        said = methods_text(case, anatomy, one)
        assert ("Chances to hit and to touch were propagated" in said) == computed
    known, unknown = (map_data(case, one, None) for one in (found, replace(found, chances=None)))
    assert "p_touch_any" in known and "p_touch_any" not in unknown


def test_trials_without_any_that_was_reached_say_nothing():
    said = text([Section("many trials", trials({**ROOMS, "realised_rms_mm": None}))])
    assert "the needle reached the target in none" in said and "realised" not in said and trials(None) == []
