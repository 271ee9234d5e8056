"""Poses that cannot show the answer: each set is refused, its free motion named, and the proposed poses cure it."""

import numpy as np
import pytest
from refusals import refused
from selfcal_world import DEGENERATE, as_estimate, cured, degenerate_set, joined, tre

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import exp_rotation, pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import active_columns
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import tip_residuals
from puncture_twin.twin.guidance.ultrasound.axp_ybq.observability import LEAST_RATIO, observe, scaled_jacobian
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE, Recording
from puncture_twin.twin.plant.simulated_recording import PoseRanges, exact_recording, simulate_recording, with_noise

ALL = active_columns(tip=True, scale=False, direction=False)


@pytest.mark.parametrize("name", DEGENERATE)
def test_every_degenerate_set_is_refused_and_named(name):
    """As bad input that names the one motion that is free; noisy ones are refused below."""
    with refused("poses_too_alike") as caught:
        calibrate(exact_recording(*degenerate_set(name)), noise=SPEC_NOISE)
    assert isinstance(caught.value, InputError)
    assert [(m.cause, m.dimensions) for m in caught.value.motions] == [DEGENERATE[name]]
    assert caught.value.motions[0].text in str(caught.value)
    assert caught.value.suggestion.text in str(caught.value)


def test_the_words_are_those_of_a_person():
    """The commonest case, a needle guide, is told in full: what does not vary, what can slide, what to do."""
    with refused("poses_too_alike") as caught:
        calibrate(exact_recording(*degenerate_set("constant insertion angle")))
    text = str(caught.value)
    assert "the insertion angle in the image hardly varies: the tip can shift along the needle" in text
    assert "add 4 poses, each from pose" in text
    assert "change the insertion angle in the image by +25 deg (2 poses)" in text


@pytest.mark.parametrize("name", DEGENERATE)
def test_the_proposed_poses_cure_it(name):
    """The same recording with the proposed poses added is accepted, and its answer is near the truth."""
    truth, A, seen = degenerate_set(name, 3)
    recording = exact_recording(truth, A, seen)
    rng = np.random.default_rng(3)
    noisy = with_noise(rng, recording, SPEC_NOISE)
    with refused("poses_too_alike") as caught:
        calibrate(noisy, noise=SPEC_NOISE)
    more = with_noise(rng, cured(truth, noisy, seen, caught.value.suggestion), SPEC_NOISE)
    found = calibrate(joined(noisy, more), noise=SPEC_NOISE)
    assert found.condition >= LEAST_RATIO
    held, _ = simulate_recording(rng, 100, truth, noise=None)
    assert np.sqrt(np.mean(tre(found, held.A, held.B, held.P) ** 2)) < 1.2


@pytest.mark.parametrize("name", DEGENERATE)
def test_the_counts_are_the_null_spaces(name):
    """An independent count: singular values of the Jacobian at the truth that are (nearly) zero."""
    truth, A, seen = degenerate_set(name)
    values = np.linalg.svd(scaled_jacobian(as_estimate(truth), exact_recording(truth, A, seen), ALL), compute_uv=False)
    assert int((values < LEAST_RATIO * values[0]).sum()) == DEGENERATE[name][1]


def test_a_constant_insertion_angle_slides_by_the_formula():
    truth, A, seen = degenerate_set("constant insertion angle")
    recording, estimate = exact_recording(truth, A, seen), as_estimate(truth)
    d = np.append(recording.v[0], 0.0)
    slid = estimate._replace(t_X=estimate.t_X + 7 * estimate.R_X @ d, t_Q=estimate.t_Q + 7 * truth.direction_end2)
    assert np.abs(tip_residuals(slid, recording)).max() < 1e-9


def test_usual_poses_are_accepted():
    """Of 40 recordings with usual poses none is refused, and the least ratio is far from the limit."""
    ratios = []
    for seed in range(40):
        recording, truth = simulate_recording(np.random.default_rng(seed), 20, noise=None)
        ratios.append(observe(as_estimate(truth), recording, ALL).ratio)
    assert min(ratios) > 2 * LEAST_RATIO


@pytest.mark.parametrize("distance_mm", [1350.0, 5000.0])
def test_where_the_second_base_stands_does_not_matter(distance_mm):
    """Six usual recordings whose base 2 has its origin elsewhere: none is refused, and the ratio is the same."""
    for seed in range(6):
        recording, _ = simulate_recording(np.random.default_rng(seed), 20)
        away = pose(exp_rotation(np.array([0.2, -0.4, 1.0])), [distance_mm, 0.0, 0.0])
        moved = Recording(recording.A, away @ recording.B, recording.P, recording.v)
        here, there = calibrate(recording, noise=SPEC_NOISE), calibrate(moved, noise=SPEC_NOISE)
        assert there.condition == pytest.approx(here.condition, rel=1e-4)
        np.testing.assert_allclose(there.Y @ away, here.Y, atol=1e-2)
        np.testing.assert_allclose(there.tip_end2, here.tip_end2, atol=1e-3)


def test_a_base_far_away_does_not_hide_a_degenerate_set():
    """A needle guide's poses are refused by the same name with base 2 at 5 m, and their ratio is the same."""
    truth, A, seen = degenerate_set("insertion angle 45 +- 1 deg")
    recording = exact_recording(truth, A, seen)
    away = pose(np.eye(3), [5000.0, 0.0, 0.0])
    ratios = []
    for B in (recording.B, away @ recording.B):
        with refused("poses_too_alike") as caught:
            calibrate(Recording(recording.A, B, recording.P, recording.v), noise=SPEC_NOISE)
        ratios.append(caught.value.ratio)
        assert caught.value.motions[0].cause == "insertion_angle"
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-5)


def test_the_ratio_grows_with_the_range_of_angles():
    """45 +- w deg: the ratio is about proportional to w, and crosses the limit between 1 and 8 deg."""
    ratios = []
    for width in (1, 2, 4, 8):
        ranges = PoseRanges(insertion=(np.radians(45 - width), np.radians(45 + width)))
        recording, truth = simulate_recording(np.random.default_rng(8), 40, noise=None, ranges=ranges)
        ratios.append(observe(as_estimate(truth), recording, ALL).ratio)
    assert ratios[0] < LEAST_RATIO < ratios[3]
    np.testing.assert_allclose(np.array(ratios[1:]) / ratios[:-1], 2, rtol=0.35)


def test_a_known_tip_still_needs_a_probe_that_turns():
    """With the needle's tip known the sliding along the needle is gone; a probe that never turns is still refused."""
    truth, A, seen = degenerate_set("constant insertion angle")
    found = calibrate(exact_recording(truth, A, seen), known_tip=truth.tip_end2)
    np.testing.assert_allclose(found.X, truth.X, atol=1e-6)
    truth, A, seen = degenerate_set("probe never turns")
    with refused("poses_too_alike"):
        calibrate(exact_recording(truth, A, seen), known_tip=truth.tip_end2)


def test_poses_that_outliers_alone_make_good_are_refused():
    """The judgement is made on the poses that are used: two wrong ones do not make the others vary."""
    truth, A, seen = degenerate_set("constant insertion angle")
    recording = with_noise(np.random.default_rng(0), exact_recording(truth, A, seen), SPEC_NOISE)
    P = np.array(recording.P)
    P[:2] += 30
    with refused("poses_too_alike"):
        calibrate(type(recording)(recording.A, recording.B, P, recording.v), noise=SPEC_NOISE)
