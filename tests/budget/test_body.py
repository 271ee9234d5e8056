"""The body in the error budget: a needle that bends and a breath, each against draws, and only where declared."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest
from budget_world import chain as chain_of_case, drawn_trials
from case_world import ORGAN, SKIN, ball, case_text, structure

from puncture_twin.planning.breathing.breathing import Breathing, fraction_within, mean_square_within
from puncture_twin.planning.budget.chain import other_gauges
from puncture_twin.planning.budget.what_if import changes, source_costs
from puncture_twin.planning.formats.labels.naming import ByName
from puncture_twin.planning.needle.deflection import GAUGES, Shaft
from puncture_twin.planning.uncertainty.pose_error import Bend

ROOMS = 8_000


class Path:
    """A path on which any needle bends as its gauge says; no tissue is needed for that."""

    bend = Bend(1.9, 150.0)


def breath(gate, scanned_at=0.0, exponent=2):
    return Breathing(12.0, np.array([0.0, 0.0, -1.0]), ByName({"*": 1.0}), 8, exponent, scanned_at, gate)


@pytest.fixture(scope="module")
def chain():
    return chain_of_case("abdomen/case.toml")


@pytest.mark.parametrize("exponent", [1, 2, 4, 6])
@pytest.mark.parametrize("about", [0.0, 0.3])
def test_the_mean_square_of_the_breath_has_a_closed_form(exponent, about):
    def power(n):
        return comb(2 * n, n) / 4**n

    expected = power(2 * exponent) - 2 * about * power(exponent) + about**2
    assert mean_square_within(1.0, exponent, about) == pytest.approx(expected, rel=1e-12)


def drawn_positions(one, count, rng):
    s = np.sin(rng.uniform(0, np.pi / 2, 8 * count)) ** (2 * one.exponent)
    s = s[s <= (1.0 if one.gate is None else one.gate)]
    return s[:count]


@pytest.mark.parametrize("gate", [None, 0.25])
def test_rooms_with_bevel_and_breath_err_as_predicted(chain, gate):
    """Whole chains, each needle bent to a side and inserted at a time that are drawn; also per axis of the base."""
    both = replace(chain, path=Path(), breathing=breath(gate, scanned_at=0.1))
    rng = np.random.default_rng(11)
    rooms = drawn_trials(chain, chain.errors, ROOMS, rng, Path.bend)
    one = both.breathing
    s = drawn_positions(one, len(rooms.tip_ct), rng)
    target = rooms.target_ct[: len(s)] + (s - one.scanned_at)[:, None] * one.amplitude_mm * one.direction_ct
    missed = (rooms.tip_ct[: len(s)] - target) @ chain.T_base_ct[:3, :3].T
    assert np.sqrt(np.mean(np.sum(missed**2, axis=1))) == pytest.approx(both.expected_mm(), rel=0.03)
    drawn, predicted = (np.sqrt(np.diag(cov)) for cov in (missed.T @ missed / len(s), both.tip_mean_square()))
    np.testing.assert_allclose(drawn, predicted, rtol=0.03)


def test_sources_of_the_body_add_up_and_gates_and_fixation_take_them_away(chain):
    both = replace(chain, path=Path(), breathing=breath(None))
    costs = {cost.source: cost for cost in source_costs(both)}
    assert costs["bend"].alone_mm == pytest.approx(1.9)
    assert costs["breathing"].alone_mm == pytest.approx(12.0 * mean_square_within(1.0, 2, 0.0) ** 0.5)
    assert sum(cost.alone_mm**2 for cost in costs.values()) == pytest.approx(both.expected_mm() ** 2)
    assert not {"bend", "breathing"} & {cost.source for cost in source_costs(chain)}
    groups = {change.group for change in changes(chain, np.empty((0, 3)), None)}
    assert not {"needle", "breath"} & groups
    motion = np.diag([0.4, 0.4, 1.0]) ** 2
    one = replace(chain, motion_base=motion)
    costs = {cost.source: cost for cost in source_costs(one)}
    assert costs["motion"].alone_mm == pytest.approx(np.sqrt(np.trace(motion)))
    assert sum(cost.alone_mm**2 for cost in costs.values()) == pytest.approx(one.expected_mm() ** 2)
    (fixed,) = (change for change in changes(one, np.empty((0, 3)), None) if change.group == "body")
    assert fixed.rms_mm == pytest.approx(chain.expected_mm()) == pytest.approx(costs["motion"].without_mm)
    assert not {"body"} & {change.group for change in changes(chain, np.empty((0, 3)), None)}
    one = replace(chain, breathing=breath(0.5))
    found = {c.what: c.rms_mm for c in changes(one, np.empty((0, 3)), None) if c.group == "breath"}
    assert list(found) == [
        "inserted at any phase",
        "inserted at s <= 0.25 (50 % of the time)",
        "inserted at s <= 0.1 (38 % of the time)",
    ]
    assert sorted(found.values(), reverse=True) == list(found.values())
    assert found["inserted at any phase"] > one.expected_mm() > found["inserted at s <= 0.25 (50 % of the time)"]
    assert fraction_within(0.25, 2) == pytest.approx(0.5)


@pytest.mark.parametrize("solid", [False, True])
def test_other_gauges_are_the_neighbours_of_the_own(solid):
    """One finer, two thicker, of the same kind; at the end of the chart what there is."""
    found = other_gauges(Shaft(150.0, 1.27, 0.0 if solid else 0.838))
    assert list(found) == [19, 17, 16]
    assert all((shaft.inner_mm == 0.0) is solid for shaft in found.values())
    assert list(other_gauges(Shaft(150.0, GAUGES[10].outer_mm))) == [11]


BODY = """[tissue."*"]
stiffness_n_mm2 = 0.05
[breathing]
amplitude_mm = 12.0
gate = 0.25
[breathing.weights]
"*" = 0.5
[motion]
target_sd_mm = [0.4, 0.4, 1.0]
"""


def test_register_shows_them_where_they_are_declared(tmp_path, run):
    ball(tmp_path / "skin.stl", 100.0, (0, 0, 0))
    ball(tmp_path / "organ.stl", 20.0, (0, 0, 0))
    markers = [("A", 90.0, 10.0, 40.0), ("B", -80.0, 20.0, 55.0), ("C", 5.0, -85.0, 50.0), ("D", 10.0, 80.0, 58.0)]
    for name, shift in (("ct", np.zeros(3)), ("base", np.array([350.0, 0.0, 0.0]))):
        rows = (f"{marker},{','.join(map(str, np.add(at, shift)))}" for marker, *at in markers)
        (tmp_path / f"markers_{name}.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n")
    needle = "length_mm = 210.0\nshaft_mm = 150.0\ndiameter_mm = 1.27\ngauge = 18\nbevel_deg = 0.5"
    rest = '[errors]\n[registration]\nmarkers_ct = "markers_ct.csv"\nmarkers_base = "markers_base.csv"\n'
    ball(tmp_path / "rib.stl", 5.0, (40, 0, 40))
    avoided = structure("rib", "avoid", margin_mm=3.0)
    (tmp_path / "case.toml").write_text(case_text(BODY + rest, SKIN, ORGAN, avoided, needle=needle))
    code, found = run("register", tmp_path)
    assert code == 0
    budget = found["budget"]
    costs = {one["text"]: one["alone_mm"] for one in budget["sources"]}
    assert 0.1 < costs["bending of the needle"] < 10
    assert costs["breathing while it is inserted"] == pytest.approx(12 * mean_square_within(0.25, 2, 0.0) ** 0.5)
    assert costs["target's motion, breath and push"] == pytest.approx(np.sqrt(0.4**2 + 0.4**2 + 1.0))
    assert {one["group"] for one in budget["changes"]} > {"needle", "breath", "body"}
    assert budget["not_modelled"] == "errors of the meshes (organ, rib: errors.surface_mm)"
