"""Directions and images that are not what a recording says: refused or named, and true recordings left alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from selfcal_world import tre

from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import calibrate
from puncture_twin.twin.guidance.ultrasound.puncture import predicted_tre
from puncture_twin.twin.guidance.ultrasound.slips import checked_calibration
from puncture_twin.twin.plant.simulated_recording import PoseRanges, simulate_recording

FILE = Path("recording.csv")
POSES = 28

TURNED = {
    "to the left": lambda v: v @ [[0.0, 1.0], [-1.0, 0.0]],
    "to the right": lambda v: v @ [[0.0, -1.0], [1.0, 0.0]],
    "exchanged": lambda v: v[:, ::-1],
    "u mirrored": lambda v: v * [-1.0, 1.0],
    "v mirrored": lambda v: v * [1.0, -1.0],
}


def drawn(seed, count=POSES, **ranges):
    return simulate_recording(np.random.default_rng(seed), count, ranges=PoseRanges(**ranges))


def codes(found):
    return [one.code for one in found.findings if one.severity == "warning"]


@pytest.mark.parametrize("lean", [0.0, 0.03])
def test_true_recordings_pass_and_one_in_a_hundred_is_warned_of(lean):
    """None of 40 is refused; by F's own level four warnings have a chance of 1 in 1,000."""
    warned = 0
    for seed in range(40):
        recording, truth = drawn(seed, count=(18, POSES, 45)[seed % 3], lean=lean)
        found = checked_calibration(recording, None, FILE)
        assert found.needle_direction_end2 @ truth.direction_end2 > 0.999
        warned += bool(codes(found))
    assert warned <= 3


@pytest.mark.parametrize("seed", range(4))
def test_directions_from_tip_to_hub_are_refused(seed):
    """Their residuals are those of right ones; the tip says which way the needle points."""
    recording, _ = drawn(seed)
    with refused("directions_reversed", "28"):
        checked_calibration(replace(recording, v=-recording.v), None, FILE)


@pytest.mark.parametrize("every", [2, 9])
@pytest.mark.parametrize("seed", range(3))
def test_reversed_poses_are_named_and_set_aside(every, seed):
    """Half or a few of them: V is right, and the sentence lists them. Half and a lost tip may be refused instead."""
    recording, truth = drawn(seed)
    wrong = np.arange(POSES) % every == 0
    try:
        found = checked_calibration(replace(recording, v=np.where(wrong[:, None], -1, 1) * recording.v), None, FILE)
    except InputError as error:
        assert every == 2
        assert error.code == "directions_reversed"
        return
    assert found.needle_direction_end2 @ truth.direction_end2 > 0.999
    said = next(one for one in found.findings if one.code == "directions_reversed")
    assert said.numbers["count"] == wrong.sum()
    assert ", ".join(np.array(recording.names)[wrong]) in said.sentence


@pytest.mark.parametrize("how", TURNED)
def test_directions_in_other_axes_are_refused_with_the_slip(how):
    """Turned by a right angle v is across the needle; the reading in which the poses agree is named."""
    for seed in range(4):
        recording, _ = drawn(seed)
        with refused("directions_scattered"):
            checked_calibration(replace(recording, v=TURNED[how](recording.v)), None, FILE)


def test_a_needle_across_its_holder_keeps_the_sign_of_its_directions():
    """Where the tip lies beside the axis it cannot say which way the needle points: said, not refused."""
    rng = np.random.default_rng(4)
    truth = drawn(4)[1]
    across = np.cross(truth.direction_end2, [0.3, 0.9, -0.2])
    aside = truth._replace(tip_end2=100.0 * across / np.linalg.norm(across) - 20.0 * truth.direction_end2)
    recording, _ = simulate_recording(rng, POSES, truth=aside)
    found = checked_calibration(recording, None, FILE)
    assert found.needle_direction_end2 @ truth.direction_end2 > 0.999
    assert "direction_sign" in codes(found)


def test_pixels_that_are_3_percent_off_are_said_and_counted():
    """Their sizes, near those of a fit with free ones; the error that they leave at the tips is in the expected one."""
    for seed in range(8):
        recording, truth = drawn(seed)
        wrong = replace(recording, P=recording.P * 1.03)
        found, free = checked_calibration(wrong, None, FILE), calibrate(wrong, scale=True)
        said = next(one for one in found.findings if one.code == "image_errs")
        one_step = [said.numbers["scale_u"], said.numbers["scale_v"]]
        np.testing.assert_allclose(1 + np.array(one_step), 1 / 1.03, atol=0.02)
        np.testing.assert_allclose(1 + np.array(one_step), free.scale, atol=0.01)
        exact = simulate_recording(np.random.default_rng(500 + seed), 60, truth=truth, noise=None)[0]
        real = np.sqrt(np.mean(tre(found, exact.A, exact.B, exact.P * 1.03) ** 2))
        assert 0.6 < real / predicted_tre(found, wrong) < 1.6
        silent = predicted_tre(free, wrong)
        assert real > 1.8 * silent


def test_a_small_turn_of_all_directions_is_said():
    """5 deg: too little to scatter, and no noise."""
    recording, _ = drawn(2)
    c, s = np.cos(np.radians(5.0)), np.sin(np.radians(5.0))
    found = checked_calibration(replace(recording, v=recording.v @ [[c, s], [-s, c]]), None, FILE)
    said = next(one for one in found.findings if one.code == "image_errs")
    assert np.degrees(abs(said.numbers["turn"])) == pytest.approx(5.0, abs=1.0)


def test_a_skewed_image_is_said():
    """Axes that are 2 deg from square, the tip's and the direction's alike."""
    recording, _ = drawn(6)
    skew = np.array([[1.0, 0.0], [np.tan(np.radians(2.0)), 1.0]])
    found = checked_calibration(replace(recording, P=recording.P @ skew, v=recording.v @ skew), None, FILE)
    said = next(one for one in found.findings if one.code == "image_errs")
    assert np.degrees(said.numbers["skew"]) == pytest.approx(-2.0, abs=0.6)
