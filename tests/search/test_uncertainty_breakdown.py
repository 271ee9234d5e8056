"""What an explanation says of chances: the numbers of the table, and which error would have to shrink, and to what."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT
from uncertainty_world import declared, world

from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.search.chances import ChanceModel
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.uncertainty_breakdown import (
    WISHED_HIT,
    ShrinkableNeedle,
    chance_text,
    error_parts,
    goals_of,
)
from puncture_twin.planning.uncertainty.hit import HitModel, hit_in_ball, proximity
from puncture_twin.planning.uncertainty.lines import Needles
from puncture_twin.planning.uncertainty.sources import SOURCES, deviation, reading_parts

KEYS = {"ct_in_plane_mm": 0.3, "ct_slice_mm": 1.2, "bed_axis": (1.0, 0.0, 0.0), "touch_mm": 0.5, "tip_offset_mm": 0.2}


def asked(radius_mm, **keys):
    made = world("abdomen/case.toml", "rigid", declared(**keys))
    case, q = load_case(ROOT / "meshes" / "abdomen"), made.puncture.q_insertion
    anatomy = SimpleNamespace(checked=(SimpleNamespace(name="rib", demands_margin=True, margin_mm=1.0),))
    model = ChanceModel(case, anatomy, None, made.error, HitModel(radius_mm, None))
    outward = made.puncture.outward_ct[None]
    normal = np.cross(outward, [0.0, 0.0, 1.0])
    normal /= np.linalg.norm(normal)
    cov_ct, off = made.error.covariance_ct(q[None]), np.full((1, 1), keys.get("surface_mm", 0.0))
    near = proximity(np.array([[2.0]]), np.array([[30.0]]), normal[:, None], outward, cov_ct, off)
    return made, ShrinkableNeedle(model, Needles(outward, cov_ct, near, off, None), error_parts(model, q))


def test_parts_add_up_and_shrinking_gives_the_wished_chance():
    made, needle = asked(1.5, **KEYS)
    told = hit_in_ball(made.error.tip_covariance(made.puncture.q_insertion[None]), 1.5)[0]
    assert needle.chance("", {}) == pytest.approx(told, abs=1e-9)
    made, needle = asked(2.0, **KEYS)
    p_hit = needle.chance("", {})
    (goal,) = goals_of(needle, p_hit, {"rib": 0.0})
    assert p_hit < WISHED_HIT == goal.limit and not goal.stated
    assert "ct_slice" in {remedy.source for remedy in goal.remedies}
    for remedy in goal.remedies:
        assert remedy.needed < remedy.declared == pytest.approx(deviation(made.errors, remedy.source))
        again, _ = asked(2.0, **(KEYS | {SOURCES[remedy.source].key: remedy.needed}))
        told = hit_in_ball(again.error.tip_covariance(made.puncture.q_insertion[None]), 2.0)[0]
        assert told == pytest.approx(WISHED_HIT, abs=1e-5)
    _, needle = asked(0.3, **KEYS)
    (goal,) = goals_of(needle, needle.chance("", {}), {})
    assert not goal.remedies and "no single error suffices" in goal.text()
    factors = dict.fromkeys(needle.parts, goal.all_sources)
    assert needle.chance("", factors) == pytest.approx(WISHED_HIT, abs=1e-6)


def test_a_limit_for_touching_is_mended_too():
    _, needle = asked(50.0, **KEYS)
    touched = needle.chance("rib", {})
    limit = touched / 3
    case = needle.model.case
    case = replace(case, search=replace(case.search, max_touch=limit))
    needle = needle._replace(model=replace(needle.model, case=case))
    (goal,) = goals_of(needle, 1.0, {"rib": touched})
    assert goal.stated and goal.remedies and "touch rib" in goal.text()
    first = goal.remedies[0]
    assert needle.chance("rib", {first.source: first.needed / first.declared}) == pytest.approx(limit, rel=1e-6)


def test_reading_is_split_by_slices():
    """Across the slices whether they are read better or worse; not at all where all axes are alike."""
    axis = np.array([0.6, 0.0, 0.8])
    for across in (0.1, 2.0):
        cov = 0.25 * np.eye(3) + (across**2 - 0.25) * np.outer(axis, axis)
        parts = reading_parts(cov)
        assert np.allclose(parts["ct_slice"], across**2 * np.outer(axis, axis))
        assert np.allclose(sum(parts.values()), cov)
    assert list(reading_parts(0.25 * np.eye(3))) == ["markers_ct"]


SHOWN = {1.0: ">0.9999", 0.0: "<0.0001", 0.93: "0.93", 1 - 1e-9: ">0.9999", 0.002: "0.0020", 0.996: "0.9960"}


@pytest.mark.parametrize(("chance", "words"), SHOWN.items())
def test_what_is_not_sure_never_reads_as_sure(chance, words):
    assert chance_text(chance) == words


@pytest.fixture(scope="module")
def carton():
    return prepare(ROOT / "meshes" / "carton" / "case_m.toml")


def test_explanation_says_the_chances_of_the_table_or_that_there_are_none(carton):
    found = carton.explain(np.radians(18), np.radians(232))
    chances = found.summary()["chances"]
    assert chances["p_hit"] == found.candidates.chances.hit[0]
    assert chances["p_touch_any"] == found.candidates.chances.touch_any[0]
    assert sum(chances["share"].values()) == pytest.approx(1)
    text = found.text()
    assert f"{chance_text(chances['p_hit'])} to hit; " in text and "not modelled: breathing" in text
    assert "do not agree with the declared errors" in text
    found = carton.explain(np.radians(90), np.radians(0))
    assert found.breakdown is None and found.summary()["chances"] is None and "no chances to hit" in found.text()
