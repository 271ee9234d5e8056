"""What the map of directions writes: nobody reads what is unknown as an organ, nor a scale where there is none."""

from dataclasses import replace

import numpy as np
import pytest
import report_world as world
from matplotlib.text import Text

from puncture_twin.planning.base.reasons import REASON_TEXT, UNSEEN_AIR_TEXT, Reason
from puncture_twin.planning.search.explain import reason_text
from puncture_twin.twin.report.map import map_raster
from puncture_twin.twin.report.map.map_picture import map_figure
from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.numbers import reason_counts
from puncture_twin.twin.report.page.page_data import map_data


@pytest.fixture(scope="module")
def candidates(case):
    """The far ring leaves the image, and a rib is in the path of a sector."""
    found = world.make_candidates(case)
    far = found.verdict.reason == "too_long"
    verdict = replace(
        found.verdict,
        reason=np.where(far, "unknown_region", found.verdict.reason),
        structure=np.where(far, "skin", found.verdict.structure).astype(object),
        detail=np.full(len(far), ""),
    )
    return replace(found, verdict=verdict)


def with_clearance(found, mm):
    """The same directions, each with this least clearance."""
    distance = np.full_like(found.clearance.by_structure, mm)
    return replace(found, clearance=replace(found.clearance, by_structure=distance, least=distance.min(axis=1)))


def written(found, case):
    """All that the picture of these directions says."""
    return [text.get_text() for text in map_figure(found, case).findobj(Text)]


@pytest.fixture(scope="module")
def said(case, candidates):
    return written(candidates, case)


def test_where_nobody_looked_is_not_the_skin(said):
    """The region says that it is unknown and not seen; the rib beside it is named as it was."""
    assert "unknown:\nnot seen" in said and "rib right 9" in said and "skin" not in said


def test_an_unknown_structure_says_that_it_is_unknown(case, candidates):
    """One that nobody named is written as unknown, not as an organ that forbids."""
    rib = candidates.verdict.reason == "too_close"
    verdict = replace(candidates.verdict, reason=np.where(rib, "unknown_region", candidates.verdict.reason))
    said = written(replace(candidates, verdict=verdict), case)
    assert "unknown:\nrib right 9" in said and "rib right 9" not in said


def test_text_and_page_say_that_it_was_not_seen(case, candidates):
    """As the map does; the table of candidates keeps the word that programs read."""
    row = int(np.flatnonzero(candidates.verdict.reason == "unknown_region")[0])
    assert reason_text(candidates, row) == "unknown_region (not seen: image or mesh ends)"
    data = map_data(case, candidates, candidates.best)
    assert data["structures"][data["structure"][row]] == data["not_seen"] == "not seen: image or mesh ends"
    assert candidates.verdict.structure[row] == "skin"


@pytest.mark.parametrize(
    ("clearance", "legend"),
    [(68.5, "safe, least clearance 68.5 mm everywhere"), (np.inf, "safe, no structure has a margin")],
)
def test_one_clearance_is_one_shade_and_no_scale(case, candidates, said, clearance, legend):
    """No bar from 68.5 to 68.5 mm, and none from 0 to 1 where nothing has a margin."""
    even = with_clearance(candidates, clearance)
    assert len(np.unique(map_raster.row_colours(even)[even.safe], axis=0)) == 1
    texts = written(even, case)
    assert legend in texts and not [text for text in texts if text.endswith("by least clearance")]
    assert {"5.0 mm", "11.5 mm", "safe, by least clearance"} <= set(said)


def front_of(found, rows):
    """The same directions with this front."""
    pareto = np.zeros(len(found), dtype=bool)
    pareto[rows] = True
    return replace(found, ranking=replace(found.ranking, pareto=pareto))


def test_a_large_front_is_thinned_and_says_so(case, candidates):
    """The best-ranked of those that keep apart, everywhere where the front is; a small one is whole."""
    view, safe = map_view(case, candidates), np.flatnonzero(candidates.safe & (candidates.theta > 0.01))
    many, few = front_of(candidates, safe), front_of(candidates, safe[: map_raster.MOST_DOTS])
    shown = map_raster.shown_front(many, view)
    assert map_raster.MOST_DOTS / 3 < len(shown.rows) <= map_raster.MOST_DOTS
    assert shown.text == f"Pareto front ({len(shown.rows)} of {len(safe)})"
    assert shown.rows[0] == safe[np.argmin(candidates.ranking.rank[safe])]
    places, dots = (view.place(candidates.theta[rows], candidates.beta[rows]) for rows in (safe, shown.rows))
    assert np.linalg.norm(places[:, None] - dots, axis=2).min(axis=1).max() < 0.35
    whole = map_raster.shown_front(few, view)
    assert whole.text == "Pareto front" and sorted(whole.rows) == sorted(safe[: map_raster.MOST_DOTS])


def test_a_needle_through_a_structure_crosses_it(case, candidates):
    """Nobody reads of a distance below zero: not beside the map, and not in the reason; a touch is none yet."""
    through = with_clearance(candidates, -0.6)
    texts = written(through, case)
    box = next(text for text in texts if text.startswith("Best"))
    assert "\ncrosses rib right 9" in box and "nearest" not in box
    row = int(np.flatnonzero(candidates.verdict.reason == "too_close")[0])
    amounts = {mm: replace(through.verdict, amount=np.full(len(through), mm)) for mm in (-0.6, 0.0)}
    assert reason_text(replace(through, verdict=amounts[-0.6]), row).endswith(
        ": the needle crosses it, at least 0.6 mm deep; 1 mm clearance is demanded"
    )
    assert reason_text(replace(through, verdict=amounts[0.0]), row).endswith(
        " with 0.00 mm clearance where 1 mm is demanded"
    )


def test_a_small_chance_is_not_written_as_none(candidates):
    """A rejection for a chance of .0028 said that it was 0.00."""
    verdict = candidates.verdict
    reasons, amounts = (
        np.array(["touch_likely"] * len(candidates), verdict.reason.dtype),
        np.full(len(candidates), 2.8e-3),
    )
    likely = replace(candidates, verdict=replace(verdict, reason=reasons, amount=amounts))
    assert reason_text(likely, 0).split(" with ")[1].startswith("0.0028 chance to touch")


def test_the_greys_of_what_is_not_known_are_told_apart(case, candidates):
    """In the body, beside it, and outside of the grid: a colour or lines of its own each; the legend has both."""
    found = world.make_candidates(case, beta_deg=(0, 180))
    refused = found.verdict.reason == "too_close"
    depth = np.where(refused, found.path.length + np.where(np.degrees(found.theta) > 40.0, 1.0, -1.0), np.nan)
    reason = np.where(refused, "unknown_region", found.verdict.reason)
    found = replace(found, verdict=replace(found.verdict, reason=reason, depth=depth))
    air, body = found.unseen_air, refused & ~found.unseen_air
    assert air.any() and body.any() and np.array_equal(air, refused & (np.degrees(found.theta) > 40.0))
    counts = {line.text: line.count for line in reason_counts(found)}
    assert counts[UNSEEN_AIR_TEXT] == air.sum() and counts[REASON_TEXT[Reason.UNKNOWN_REGION]] == body.sum()
    raster = map_raster.map_raster(found, map_view(case, found), 400)
    middle = np.arange(400) - 199.5
    outside = (raster.rows < 0) & (np.hypot(middle[:, None], middle) < 190.0)
    where = [np.append(rows, False)[raster.rows] for rows in (air, body)] + [outside]
    dark = [np.median(raster.rgba[one][:, :3].mean(axis=1)) for one in where]
    lines = [(raster.rgba[one][:, :3] == colour).all(axis=1).mean() for one, colour in zip(where, LINES, strict=True)]
    assert dark[1] + 50 < dark[0] and dark[0] + 30 < dark[2] and all(0.1 < fraction < 0.4 for fraction in lines)


LINES = (map_raster.HATCH_AIR, map_raster.HATCH, map_raster.HATCH_NOT_SEARCHED)
