"""Tips with three coordinates, of a 3-D probe or a camera: the plane's answer where they lie in a plane, and more."""

import numpy as np
import pytest
from refusals import refused
from selfcal_world import DEGENERATE, as_estimate, degenerate_set

from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import active_columns, closed_form
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import linearised_tip, tip_residuals
from puncture_twin.twin.guidance.ultrasound.axp_ybq.observability import observe
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.recording_file import read_recording, write_recording
from puncture_twin.twin.guidance.ultrasound.slips import checked_calibration
from puncture_twin.twin.plant.simulated_recording import (
    draw_image_poses,
    draw_probe_poses,
    draw_truth,
    exact_recording,
    simulate_recording,
    with_noise,
)

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
    """51 unknowns from 17 poses; and with a known tip 24 from 8."""
    exact, truth = in_space(rng, n)
    for given, some in (({}, exact), ({"known_tip": truth.tip_end2}, exact.subset(slice(0, 8)))):
        found = closed_form(some, **given)
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


def test_derivatives_are_central_differences(rng):
    """Of the tip's residuals by all fifteen unknowns, with tips in a volume."""
    exact, truth = in_space(rng, 6)
    estimate = as_estimate(truth)
    J, h = linearised_tip(estimate, exact).jacobian, 1e-6
    for column in range(15):
        step = np.zeros(19)
        step[column] = h
        slope = (tip_residuals(estimate.moved(step), exact) - tip_residuals(estimate.moved(-step), exact)) / (2 * h)
        np.testing.assert_allclose(J[:, :, column], slope, atol=1e-5)


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
    active = active_columns(tip=True, scale=False, direction=False)
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
