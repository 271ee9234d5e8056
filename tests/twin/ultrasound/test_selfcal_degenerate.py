"""What poses can show: too little is refused, named and cured; tips with three coordinates show more."""

import numpy as np
import pytest
from refusals import refused
from selfcal_world import DEGENERATE, as_estimate, cured, degenerate_set, joined, tre

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import exp_rotation, pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import active_columns, closed_form, tip_residuals
from puncture_twin.twin.guidance.ultrasound.axp_ybq.observability import LEAST_RATIO, observe, scaled_jacobian
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE, Noise, Recording
from puncture_twin.twin.guidance.ultrasound.recording_file import checked_calibration, read_recording, write_recording
from puncture_twin.twin.plant.simulated_recording import (
    PoseRanges,
    draw_image_poses,
    draw_probe_poses,
    draw_truth,
    exact_recording,
    simulate_recording,
    with_noise,
)

ALL = active_columns(scale=False, direction=False)


@pytest.mark.parametrize("name", DEGENERATE)
def test_every_degenerate_set_is_refused_named_and_cured(name):
    """As bad input that names the one motion that is free, as many ways as singular values of the Jacobian vanish.

    With the proposed poses added the recording is accepted, and its answer is near the truth.
    """
    truth, A, seen = degenerate_set(name)
    recording, rng = exact_recording(truth, A, seen), np.random.default_rng(3)
    values = np.linalg.svd(scaled_jacobian(as_estimate(truth), recording, ALL), compute_uv=False)
    assert int((values < LEAST_RATIO * values[0]).sum()) == DEGENERATE[name][1]
    noisy = with_noise(rng, recording, SPEC_NOISE)
    for some in (recording, noisy):
        with refused("poses_too_alike") as caught:
            calibrate(some, noise=SPEC_NOISE)
        assert isinstance(caught.value, InputError)
        assert caught.value.motions[0].text in str(caught.value)
        assert caught.value.suggestion.text in str(caught.value)
        if some is recording:
            assert [(m.cause, m.dimensions) for m in caught.value.motions] == [DEGENERATE[name]]
    more = with_noise(rng, cured(truth, noisy, seen, caught.value.suggestion), SPEC_NOISE)
    found = calibrate(joined(noisy, more), noise=SPEC_NOISE)
    assert found.condition >= LEAST_RATIO
    held, _ = simulate_recording(rng, 100, truth, noise=None)
    assert np.sqrt(np.mean(tre(found, held.A, held.B, held.P) ** 2)) < 1.2


def test_the_words_are_those_of_a_person():
    """The commonest case, a needle guide, is told in full: what does not vary, what can slide, what to do."""
    with refused("poses_too_alike") as caught:
        calibrate(exact_recording(*degenerate_set("constant insertion angle")))
    text = str(caught.value)
    assert "the insertion angle in the image hardly varies: the tip can shift along the needle" in text
    assert "add 4 poses, each from pose" in text
    assert "change the insertion angle in the image by +25 deg (2 poses)" in text


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
    """Usual recordings whose base 2 has its origin elsewhere are as well conditioned, a needle guide's as ill."""
    away = pose(exp_rotation(np.array([0.2, -0.4, 1.0])), [distance_mm, 0.0, 0.0])
    for seed in range(3):
        recording, _ = simulate_recording(np.random.default_rng(seed), 20)
        moved = Recording(recording.A, away @ recording.B, recording.P, recording.v)
        here, there = calibrate(recording, noise=SPEC_NOISE), calibrate(moved, noise=SPEC_NOISE)
        assert there.condition == pytest.approx(here.condition, rel=1e-4)
        np.testing.assert_allclose(there.Y @ away, here.Y, atol=1e-2)
        np.testing.assert_allclose(there.tip_end2, here.tip_end2, atol=1e-3)
    guided, ratios = exact_recording(*degenerate_set("insertion angle 45 +- 1 deg")), []
    for B in (guided.B, away @ guided.B):
        with refused("poses_too_alike") as caught:
            calibrate(Recording(guided.A, B, guided.P, guided.v), noise=SPEC_NOISE)
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


def test_poses_that_outliers_alone_make_good_are_refused():
    """The judgement is made on the poses that are used: two wrong ones do not make the others vary."""
    truth, A, seen = degenerate_set("constant insertion angle")
    recording = with_noise(np.random.default_rng(0), exact_recording(truth, A, seen), SPEC_NOISE)
    P = np.array(recording.P)
    P[:2] += 30
    with refused("poses_too_alike"):
        calibrate(type(recording)(recording.A, recording.B, P, recording.v), noise=SPEC_NOISE)


NOISE = Noise(robot_mm=0.1, robot_rad=5e-4, image_mm=0.3, direction_rad=0.0)
DEEP_MM = 20.0
"""Tips lie so far out of the plane, either way."""


def lifted(recording, w, truth):
    """The same flanges with the tip out of the plane by w (n,): the probe's flange stands so much aside."""
    A = np.array(recording.A)
    A[:, :3, 3] -= w[:, None] * (A[:, :3, :3] @ truth.X[:3, 2])
    return Recording(A, recording.B, np.column_stack([recording.P, w]))


def in_space(rng, n, truth=None):
    truth = draw_truth(rng) if truth is None else truth
    flat = exact_recording(truth, draw_probe_poses(rng, truth, n), draw_image_poses(rng, n))
    return lifted(flat, rng.uniform(-DEEP_MM, DEEP_MM, n), truth), truth


def noisy(rng, exact):
    shaken = with_noise(rng, Recording(exact.A, exact.B, exact.P[:, :2]), NOISE)
    return Recording(shaken.A, shaken.B, exact.P + rng.normal(0.0, NOISE.image_mm, exact.P.shape))


@pytest.mark.parametrize("n", [17, 40])
def test_the_closed_form_is_exact_without_noise(rng, n):
    """51 unknowns from 17 poses."""
    exact, truth = in_space(rng, n)
    found = closed_form(exact)
    assert np.abs(tip_residuals(found, exact)).max() < 1e-5
    np.testing.assert_allclose(found.R_X, truth.X[:3, :3], atol=1e-7)
    np.testing.assert_allclose(found.t_Q, truth.tip_end2, atol=1e-5)


def test_a_plane_with_a_third_coordinate_is_the_plane(rng):
    """w = 0 in every row gives the answer of two coordinates; noise of w is how far off the slice a tip lies."""
    recording, _ = simulate_recording(rng, 30)
    flat = Recording(recording.A, recording.B, recording.P)
    space = Recording(recording.A, recording.B, np.column_stack([recording.P, np.zeros(30)]))
    for noise in (None, NOISE._replace(off_plane_mm=NOISE.image_mm)):
        one, other = (calibrate(some, noise=noise) for some in (flat, space))
        np.testing.assert_allclose(one.parameter_error(other.estimate), 0.0, atol=1e-6)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-15)


def test_the_region_holds_the_truth():
    """In 100 rooms the 95 % region of all unknowns holds them about as often."""
    inside = 0
    for seed in range(100):
        rng = np.random.default_rng([3, seed])
        exact, truth = in_space(rng, 24)
        found = calibrate(noisy(rng, exact), noise=NOISE)
        e = found.parameter_error(as_estimate(truth))
        inside += e @ np.linalg.solve(found.covariance, e) <= found.region_limit()
    assert 90 <= inside <= 99


SHOWN = {"tip never moves in the image": 2, "tip moves on a line": 1}
"""Motions that a plane leaves free and a volume shows, by the set of poses."""


@pytest.mark.parametrize("name", DEGENERATE)
def test_what_a_third_coordinate_shows(name, rng):
    """Tips off the plane show rotations of the image about tips and lines; what hangs on the arms' stays free."""
    truth, A, seen = degenerate_set(name)
    flat = exact_recording(truth, A, seen)
    active = active_columns(scale=False, direction=False)
    volume = lifted(flat, rng.uniform(-DEEP_MM, DEEP_MM, len(A)), truth)
    plane, space = (
        observe(as_estimate(truth), some, active).dimensions for some in (Recording(A, flat.B, flat.P), volume)
    )
    assert plane - space == SHOWN.get(name, 0)


def test_a_mirrored_volume_is_named_and_pixels_are_not_read(rng, tmp_path):
    """A third coordinate of the other sign does not fit, and the refusal says so; scale is a plane's."""
    exact, truth = in_space(rng, 30)
    recording = noisy(rng, exact)
    mirrored = Recording(recording.A, recording.B, recording.P * [1, 1, -1])
    with refused("recording_slip", "P_w"):
        checked_calibration(mirrored, None, tmp_path)
    with refused("wrong_unit"):
        Recording(exact.A, exact.B, exact.P, pixels=True)
    with refused("wrong_unit"):
        calibrate(recording, scale=True)
    with refused("too_few_poses"):
        calibrate(recording.subset(slice(0, 16)))
    write_recording(recording, tmp_path / "recording.csv")
    np.testing.assert_array_equal(read_recording(tmp_path).P, recording.P)
    found = checked_calibration(read_recording(tmp_path), None, tmp_path)
    assert np.linalg.norm(found.tip_end2 - truth.tip_end2) < 1.0
    assert found.predicted_tre_mm(exact.P, exact.A).max() < 1.0
