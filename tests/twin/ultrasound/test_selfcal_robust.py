"""Single wrong poses: found, set aside, and without effect on the others."""

import numpy as np
import pytest
from selfcal_world import tre

from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import active_columns, closed_form
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers import plain_fit
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import UNWEIGHTED, Problem
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE, Recording
from puncture_twin.twin.plant.simulated_recording import simulate_recording


def with_outliers(rng, recording, count, size_mm=5.0):
    rows = rng.choice(len(recording), count, replace=False)
    angle = rng.uniform(0, 2 * np.pi, count)
    P = np.array(recording.P)
    P[rows] += size_mm * np.column_stack([np.cos(angle), np.sin(angle)])
    return Recording(recording.A, recording.B, P, recording.v, recording.names), rows


@pytest.mark.parametrize("count", [22, 30])
def test_of_exact_poses_no_tip_is_set_aside(count):
    """Tips that scatter along the shaft alone: residuals of one dimension, of which a third seemed too large."""
    lost = 0
    for seed in range(10):
        rng = np.random.default_rng([10, seed])
        exact, _ = simulate_recording(rng, count, noise=None)
        P = exact.P + rng.normal(0.0, 0.07, (count, 1)) * exact.v + rng.normal(0.0, 0.005, (count, 2))
        v = exact.v + rng.normal(0.0, 0.0005, (count, 2))
        recording = Recording(exact.A, exact.B, P, v, exact.names)
        lost += len(calibrate(recording).outliers)
        moved, rows = with_outliers(rng, recording, 2, size_mm=2.0)
        assert {moved.names[row] for row in rows} <= set(calibrate(moved).outliers)
    assert lost <= 2


@pytest.mark.parametrize("known_noise", [True, False])
def test_ten_percent_of_outliers_hardly_matter(known_noise):
    """30 poses, three of them 5 mm off: at most .25 mm, where least squares over all has more than twice as much."""
    robust, plain = [], []
    noise = SPEC_NOISE if known_noise else None
    for seed in range(10):
        rng = np.random.default_rng([9, seed])
        recording, truth = simulate_recording(rng, 30)
        held, _ = simulate_recording(rng, 200, truth, noise=None)
        broken, rows = with_outliers(rng, recording, 3)
        found = calibrate(broken, noise=noise, direction=False)
        assert {recording.names[row] for row in rows} <= set(found.outliers)
        robust.append(np.mean(tre(found, held.A, held.B, held.P) ** 2))
        active = active_columns(tip=True, scale=False, direction=False)
        left = plain_fit(Problem(broken, noise or UNWEIGHTED, active), closed_form(broken))
        plain.append(np.mean(tre(left, held.A, held.B, held.P) ** 2))
    assert np.sqrt(np.mean(robust)) <= 0.25
    assert np.sqrt(np.mean(plain)) > 2 * np.sqrt(np.mean(robust))


def test_a_quarter_of_gross_outliers_is_still_found(rng):
    recording, _ = simulate_recording(rng, 40)
    broken, rows = with_outliers(rng, recording, 10, 15.0)
    found = calibrate(broken, noise=SPEC_NOISE)
    assert {recording.names[row] for row in rows} == set(found.outliers)
    np.testing.assert_array_equal(found.weights == 0, np.isin(recording.names, found.outliers))


def test_a_clean_recording_loses_nothing(rng):
    """Nearly every one keeps all of its poses (1 % may lose one), and then each counts in full."""
    found = [calibrate(simulate_recording(rng, 25)[0], noise=SPEC_NOISE) for _ in range(20)]
    whole = [one for one in found if one.outliers == ()]
    assert len(whole) >= 18
    for one in whole:
        np.testing.assert_array_equal(one.weights, 1.0)


def test_directions_that_point_backwards_are_set_aside(rng):
    """A detector that takes the shaft's end for the tip turns v round: V does not follow, the tips still count."""
    recording, truth = simulate_recording(rng, 30)
    v = np.array(recording.v)
    v[[3, 11, 20]] *= -1
    found = calibrate(Recording(recording.A, recording.B, recording.P, v), noise=SPEC_NOISE)
    assert found.outliers == calibrate(recording, noise=SPEC_NOISE).outliers
    assert np.degrees(np.arccos(found.needle_direction_end2 @ truth.direction_end2)) < 0.2


def test_a_recording_that_nobody_can_read_is_refused(rng):
    """Tips at random places: more than half disagree, and the answer is an error, not a number."""
    recording, _ = simulate_recording(rng, 30)
    P = np.array(recording.P)
    P[:20] = rng.uniform([-25, 5], [25, 65], (20, 2))
    try:
        found = calibrate(Recording(recording.A, recording.B, P, recording.v), noise=SPEC_NOISE)
    except InputError as error:
        assert "agree" in str(error) or "ratio" in str(error)
    else:
        assert found.noise_ratio > 3
