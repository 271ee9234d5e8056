"""The breath as it is declared: Lujan's positions, weights by pattern, and what is refused."""

import numpy as np
import pytest
from case_world import ORGAN, SKIN, case_text, structure, write_balls
from refusals import refused

from puncture_twin.planning.breathing.breathing import Breathing, fraction_within, positions
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.labels.naming import ByName

BREATHING = '[breathing]\namplitude_mm = 12.0\ndirection = "feet"\n{keys}\n[breathing.weights]\n"*" = 0.0\n'


def case_with(folder, keys="", text=BREATHING, space="LPS"):
    write_balls(folder)
    sections = (text.format(keys=keys), SKIN, ORGAN, structure("rib", "avoid"))
    (folder / "case.toml").write_text(case_text(*sections, space=space))
    return load_case(folder / "case.toml")


def breathing(**keys):
    usual = {"amplitude_mm": 12.0, "direction_ct": np.array([0, 0, -1.0]), "weights": ByName({"*": 0.0})}
    return Breathing(**{**usual, "phases": 8, "exponent": 2, "scanned_at": 0.0, "gate": None, **keys})


@pytest.mark.parametrize("exponent", [1, 2, 3, 4])
def test_positions_are_those_of_the_curve_in_time(exponent):
    """Each is z0 - b cos^2n at one of the evenly spaced times, exhale and inhale among them."""
    times = np.arange(10) / 10
    curve = np.cos(np.pi * times - np.pi / 2) ** (2 * exponent)
    found = positions(10, exponent)
    assert found[0] == 0 and found[-1] == 1
    assert np.abs(curve[:, None] - found).min(axis=1).max() < 1e-11
    assert np.abs(curve[:, None] - found).min(axis=0).max() < 1e-11


def test_one_phase_is_exhale_and_weights_follow_the_most_specific_pattern():
    assert positions(1, 2).tolist() == [0.0]
    np.testing.assert_allclose(breathing(scanned_at=1.0).moved_ct(0.0), [0, 0, 12])
    np.testing.assert_allclose(breathing().moved_ct(1.0, 0.5), [0, 0, -6])
    weights = ByName({"*": 0.0, "rib*": 0.2, "rib_left_7": 0.4})
    assert [weights.of(name) for name in ("Rib_1", "rib_1", "rib_left_7")] == [0.0, 0.2, 0.4]
    assert ByName({"rib*": 0.2}).of("liver") is None


@pytest.mark.parametrize(("exponent", "published"), [(1, 0.27), (2, 0.44), (3, 0.53), (4, 0.59)])
def test_the_time_within_two_millimetres_of_exhale_is_that_of_the_curve(exponent, published):
    """For 12 mm; and so often does a sampled curve lie there."""
    told = fraction_within(2 / 12, exponent)
    sampled = np.mean(np.sin(np.pi * (np.arange(200_000) + 0.5) / 200_000) ** (2 * exponent) <= 2 / 12)
    assert told == pytest.approx(sampled, abs=1e-4)
    assert told == pytest.approx(published, abs=5e-3)


def test_a_gate_lets_through_itself_and_all_below():
    """Its own position is checked, and is one of all phases too: what all phases allow, the gate allows."""
    found = breathing(gate=0.3)
    assert found.positions[found.in_window].tolist() == [0.0, *found.positions[1:3].tolist(), 0.3]
    assert 0.3 in found.positions
    assert breathing(gate=0.0).positions[breathing(gate=0.0).in_window].tolist() == [0.0]
    assert breathing().in_window.all()


@pytest.mark.parametrize(
    ("patterns", "message"),
    [
        ({"rib": 0.0}, "no_rule"),
        ({"*": 0.0, "kidny": 1.0}, "no_match kidny"),
        ({"*": 0.0, "r?b": 0.1, "ri?": 0.2}, "ambiguous_patterns rib"),
    ],
)
def test_weights_that_leave_a_doubt_are_refused(patterns, message):
    with refused(*message.split()):
        ByName(patterns).check(["rib", "liver"], "breathing.weights", "case.toml")


def test_a_direction_need_not_be_a_unit_vector(tmp_path):
    text = BREATHING.replace('"feet"', "[0.0, 3.0, -4.0]")
    np.testing.assert_allclose(case_with(tmp_path, text=text).breathing.direction_ct, [0, 0.6, -0.8])
    np.testing.assert_allclose(case_with(tmp_path, text=text, space="RAS").breathing.direction_ct, [0, -0.6, -0.8])


@pytest.mark.parametrize(
    ("keys", "text", "space", "message"),
    [
        ("phases = 7", BREATHING, "LPS", "out_of_range"),
        ("gate = 1.5", BREATHING, "LPS", "bad_value gate"),
        ("scanned_at = -0.1", BREATHING, "LPS", "bad_value scanned_at"),
        ("exponent = 0", BREATHING, "LPS", "bad_value exponent"),
        ("", BREATHING.replace("12.0", "-12.0"), "LPS", "bad_value amplitude_mm"),
        ("", BREATHING.replace('"feet"', "[0.0, 0.0, 0.0]"), "LPS", "zero_direction"),
        ("", BREATHING.replace('"*" = 0.0', '"*" = 2.5'), "LPS", "bad_value weights"),
        ("", BREATHING.replace('"*" = 0.0', '"*" = -1.0'), "LPS", "bad_value weights"),
        ("", BREATHING, "local", "local_space"),
        ("", BREATHING.split("[breathing.weights]")[0], "LPS", "missing_key weights"),
    ],
)
def test_a_breath_that_cannot_be_meant_is_refused(tmp_path, keys, text, space, message):
    with refused(*message.split()):
        case_with(tmp_path, keys, text, space)


def test_a_case_without_the_table_declares_none(tmp_path):
    assert case_with(tmp_path, text="").breathing is None


@pytest.mark.parametrize(
    ("keys", "whole", "text"),
    [
        ({}, True, "at each phase if inserted at that phase"),
        ({"phases": 1}, False, "at exhale, if inserted at exhale; no other phase was checked"),
        ({"phases": 1, "gate": 0.25}, False, "when gated to this window (s <= 0.25)"),
        ({"phases": 1, "amplitude_mm": 0.0}, True, "at each phase if inserted at that phase"),
    ],
)
def test_one_phase_does_not_speak_for_the_others(keys, whole, text):
    """Only positions up to full inhale are the whole breath; one phase alone was called safe at each."""
    found = breathing(**keys)
    assert (found.whole, found.window_text) == (whole, text)
