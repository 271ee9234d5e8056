"""How well the answer is known: covariances that hold, wrong poses set aside, slips of recordings and images named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from scipy.stats import binom
from selfcal_world import as_estimate, tre

from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.guidance.ultrasound.axp_ybq import equation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import SHAFT_BIAS, calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fit import plain_fit
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE, Recording
from puncture_twin.twin.guidance.ultrasound.pose_choice import predicted_tre
from puncture_twin.twin.guidance.ultrasound.recording_file import checked_calibration
from puncture_twin.twin.plant.simulated_recording import PoseRanges, simulate_recording

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
        J = equation.linearised_tip(found.estimate, Recording(A[None], B[None], p[None])).jacobian[0][:, :15]
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
    for noise, ratio in ((SPEC_NOISE, 1.0), (small, 3.0)):
        told = calibrate(recording, noise=noise, direction=False)
        assert told.noise_ratio == pytest.approx(ratio, rel=0.2)
    assert told.outliers == ()


def test_a_bias_along_the_shaft_leaves_no_residual(rng):
    """Every tip 2 mm too far along the shaft: t_Q moves by that along V, and it is said; a known length finds it."""
    exact, truth = simulate_recording(rng, 24, noise=None)
    biased = Recording(exact.A, exact.B, exact.P + 2.0 * exact.v, exact.v)
    found = calibrate(biased)
    assert np.abs(found.residuals).max() < 1e-8
    np.testing.assert_allclose(found.tip_end2 - truth.tip_end2, 2.0 * truth.direction_end2, atol=1e-6)
    assert SHAFT_BIAS in found.cannot_show
    np.testing.assert_allclose(equation.tip_residuals(found.estimate, biased), 0, atol=1e-8)
    held = calibrate(biased, needle_length_mm=float(truth.tip_end2 @ truth.direction_end2))
    assert held.tip_bias_mm == pytest.approx(2.0, abs=1e-6)
    np.testing.assert_allclose(held.tip_end2, truth.tip_end2, atol=1e-6)
    assert SHAFT_BIAS not in held.cannot_show
    for bad in (0.0, -5.0, np.nan):
        with refused("not_positive"):
            calibrate(biased, needle_length_mm=bad)


def test_without_directions_the_axis_comes_from_the_plane(rng):
    """No v: V is found, taken to point from flange to tip, and that is said."""
    recording, truth = simulate_recording(rng, 30)
    found = calibrate(Recording(recording.A, recording.B, recording.P), noise=SPEC_NOISE)
    assert found.needle_direction_end2 @ truth.direction_end2 > np.cos(np.radians(0.5))
    assert any("no directions were measured" in words for words in found.cannot_show)


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
        active = equation.active_columns(scale=False, direction=False)
        left = plain_fit(equation.Problem(broken, noise or equation.UNWEIGHTED, active), equation.closed_form(broken))
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


@pytest.mark.parametrize("seed", range(2))
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
    for seed in range(2):
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
    for seed in range(4):
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


def test_a_small_turn_of_all_directions_and_a_skew_are_said():
    """5 deg: too little to scatter, and no noise; axes that are 2 deg from square, of tip and direction alike."""
    recording, _ = drawn(2)
    c, s = np.cos(np.radians(5.0)), np.sin(np.radians(5.0))
    found = checked_calibration(replace(recording, v=recording.v @ [[c, s], [-s, c]]), None, FILE)
    said = next(one for one in found.findings if one.code == "image_errs")
    assert np.degrees(abs(said.numbers["turn"])) == pytest.approx(5.0, abs=1.0)
    recording, _ = drawn(6)
    skew = np.array([[1.0, 0.0], [np.tan(np.radians(2.0)), 1.0]])
    found = checked_calibration(replace(recording, P=recording.P @ skew, v=recording.v @ skew), None, FILE)
    said = next(one for one in found.findings if one.code == "image_errs")
    assert np.degrees(said.numbers["skew"]) == pytest.approx(-2.0, abs=0.6)
