"""How well the answer is known: covariances that hold, the error at the tip, and what the data cannot show."""

import numpy as np
import pytest
from refusals import refused
from scipy.stats import binom
from selfcal_world import as_estimate, tre

from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import SHAFT_BIAS, calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import linearised_tip, tip_residuals
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE, Recording
from puncture_twin.twin.plant.simulated_recording import simulate_recording

RUNS = 30


@pytest.fixture(scope="module", params=[True, False], ids=["known noise", "found spread"])
def runs(request):
    """Calibrations of 30 poses with their truths and held-out poses."""
    found = []
    for seed in range(RUNS):
        rng = np.random.default_rng([17, seed])
        recording, truth = simulate_recording(rng, 30)
        held, _ = simulate_recording(rng, 60, truth, noise=None)
        found.append((calibrate(recording, noise=SPEC_NOISE if request.param else None), truth, held))
    return found


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_confidence_regions_hold_what_they_promise(runs, level):
    """The truth lies inside as often as promised, as far as 30 runs can tell (99.9 % of the binomial distribution)."""
    inside = 0
    for found, truth, _ in runs:
        e = found.parameter_error(as_estimate(truth))
        inside += e @ np.linalg.solve(found.covariance, e) <= found.region_limit(level)
    allowed = 0.07 if level == 0.5 else 0.02  # what the F distribution only approximates
    assert binom.ppf(0.0005, RUNS, level - allowed) <= inside <= binom.ppf(0.9995, RUNS, min(level + allowed, 1.0))


def test_the_predicted_error_is_the_real_one(runs):
    """Over the runs the rms error at the tip is what each calibration predicted for those image points, to 10 %."""
    real = [np.mean(tre(found, held.A, held.B, held.P) ** 2) for found, _, held in runs]
    predicted = [np.mean(found.predicted_tre_mm(held.P, held.A) ** 2) for found, _, held in runs]
    assert np.sqrt(np.mean(real)) == pytest.approx(np.sqrt(np.mean(predicted)), rel=0.1)


def test_the_prediction_is_the_mean_over_the_needles_orientations(rng):
    """One by one over the recorded orientations, with the full Jacobian of a pose, gives the same number."""
    recording, _ = simulate_recording(rng, 20)
    found = calibrate(recording, noise=SPEC_NOISE, direction=False)
    A, p = recording.A[4], np.array([7.0, 33.0])
    squared = []
    for M in found.orientations:
        B = np.eye(4)
        B[:3, :3] = found.Y[:3, :3].T @ A[:3, :3] @ found.X[:3, :3] @ M
        target = (A @ found.X @ np.array([*p, 0, 1]))[:3]
        B[:3, 3] = found.Y[:3, :3].T @ (target - found.Y[:3, 3]) - B[:3, :3] @ found.tip_end2
        J = linearised_tip(found.estimate, Recording(A[None], B[None], p[None])).jacobian[0][:, :15]
        squared.append(np.trace(J @ found.covariance @ J.T))
    assert found.predicted_tre_mm(p, A)[0] == pytest.approx(np.sqrt(np.mean(squared)), rel=1e-9)


def test_the_error_grows_away_from_what_was_recorded(rng):
    """Outside the recorded field the tip is known worse; far away the prediction grows with the distance."""
    recording, _ = simulate_recording(rng, 30)
    found = calibrate(recording, noise=SPEC_NOISE)
    points = np.array([[0.0, 35.0], [0.0, 120.0], [0.0, 5000.0], [0.0, 10000.0]])
    near, beyond, far, twice = found.predicted_tre_mm(points, recording.A[0])
    assert beyond > 1.2 * near
    assert twice / far == pytest.approx(2, rel=0.05)


def test_the_noise_ratio_says_when_the_noise_is_larger_than_told(rng):
    """Told a third of the noise, the residuals are three times as large as expected."""
    recording, _ = simulate_recording(rng, 60)
    small = SPEC_NOISE._replace(**{key: value / 3 for key, value in SPEC_NOISE._asdict().items()})
    assert calibrate(recording, noise=SPEC_NOISE, direction=False).noise_ratio == pytest.approx(1, abs=0.2)
    told_less = calibrate(recording, noise=small, direction=False)
    assert told_less.noise_ratio == pytest.approx(3, rel=0.2)
    assert told_less.outliers == ()


def test_a_bias_along_the_shaft_leaves_no_residual(rng):
    """Every tip seen 2 mm too far along the shaft: residuals stay zero, t_Q moves by 2 mm along V, and it is said."""
    exact, truth = simulate_recording(rng, 24, noise=None)
    biased = Recording(exact.A, exact.B, exact.P + 2.0 * exact.v, exact.v)
    found = calibrate(biased)
    assert np.abs(found.residuals).max() < 1e-8
    np.testing.assert_allclose(found.tip_end2 - truth.tip_end2, 2.0 * truth.direction_end2, atol=1e-6)
    assert SHAFT_BIAS in found.cannot_show
    np.testing.assert_allclose(tip_residuals(found.estimate, biased), 0, atol=1e-8)


def test_the_needle_length_holds_the_bias(rng):
    """With the length known the bias is measured, t_Q is right, and nothing is left to say about it."""
    exact, truth = simulate_recording(rng, 24, noise=None)
    biased = Recording(exact.A, exact.B, exact.P + 2.0 * exact.v, exact.v)
    length = float(truth.tip_end2 @ truth.direction_end2)
    found = calibrate(biased, needle_length_mm=length)
    assert found.tip_bias_mm == pytest.approx(2.0, abs=1e-6)
    np.testing.assert_allclose(found.tip_end2, truth.tip_end2, atol=1e-6)
    assert SHAFT_BIAS not in found.cannot_show


@pytest.mark.parametrize("bad", [0.0, -5.0, np.nan])
def test_an_impossible_needle_length_is_refused(rng, bad):
    recording, _ = simulate_recording(rng, 20)
    with refused("not_positive"):
        calibrate(recording, needle_length_mm=bad)


def test_without_directions_the_axis_comes_from_the_plane(rng):
    """No v: V is found, taken to point from flange to tip, and that is said."""
    recording, truth = simulate_recording(rng, 30)
    found = calibrate(Recording(recording.A, recording.B, recording.P), noise=SPEC_NOISE)
    assert found.needle_direction_end2 @ truth.direction_end2 > np.cos(np.radians(0.5))
    assert any("no directions were measured" in words for words in found.cannot_show)
