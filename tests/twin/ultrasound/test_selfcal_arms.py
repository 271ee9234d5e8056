"""Errors of both arms that repeat from pose to pose: in the covariance, in the prediction, and in the aim."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from scipy.linalg import block_diag
from scipy.stats import binom
from selfcal_world import as_estimate, joined

from benchmarks.selfcal_rooms import Kind, outcome, recorded, room_of
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.geometry.gauss_newton import Whitening
from puncture_twin.planning.geometry.rigid import log_rotation
from puncture_twin.twin.guidance.ultrasound.axp_ybq import arm_errors, equation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import PLAY_SIGN, calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fit import plain_fit, weighed, with_spreads
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE, Noise, Recording
from puncture_twin.twin.guidance.ultrasound.pose_choice import aim, drawing
from puncture_twin.twin.guidance.ultrasound.recording_file import read_recording, write_recording
from puncture_twin.twin.plant.simulated_recording import simulate_recording
from puncture_twin.twin.plant.ultrasound_workcell import draw_workcell

ROOMS = 16
"""A covariance that is a third too small, or a half too large, moves the mean of e^T C^-1 e / p out of its bounds: 18
parameters leave a room a standard deviation of .33, the mean of sixteen .08."""
PICTURED = 3
"""Rooms of rendered pictures, a second and a half each: their mean of e^T C^-1 e / p is known to .19."""
ALL = equation.active_columns(scale=False, direction=True)
NOISE = Noise(0.0, 0.0, 0.1, float(np.radians(0.3)), off_plane_mm=0.15)


@pytest.fixture(scope="module")
def room():
    """The embedded case, a true room, and its recording of thirty poses."""
    case, _, candidates, chosen = room_of(0.0)
    rng = np.random.default_rng(5)
    truth = draw_workcell(case, rng)
    recording, _ = recorded(case, candidates, truth, chosen, rng, noise=True)
    return case, candidates, truth, recording


def with_flanges(recording, A, B):
    r = recording
    return Recording(A, B, r.P, r.v, r.names, r.pixels, r.q_probe, r.q_needle)


def test_the_flanges_slopes_are_the_finite_differences(room):
    """Every column, tip and direction, of both arms, agrees with central differences."""
    case, _, _, recording = room
    estimate, v = drawing(case), equation.directions_image(recording, drawing(case))

    def both(A, B):
        moved = with_flanges(recording, A, B)
        return np.hstack([equation.tip_residuals(estimate, moved), equation.direction_residuals(estimate, moved, v)])

    slopes = equation.flange_slopes(estimate, recording, v)
    for which in (0, 1):
        for column in range(6):
            step = np.zeros(6)
            step[column] = 1e-4
            ends = []
            for sign in (1, -1):
                flanges = [recording.A, recording.B]
                flanges[which] = arm_errors.corrected(flanges[which], sign * step)
                ends.append(both(*flanges))
            np.testing.assert_allclose(slopes[which][:, :, column], (ends[0] - ends[1]) / 2e-4, atol=1e-5)


def test_the_declared_errors_move_the_true_arms_flanges(room):
    """An arm of the twin, drawn from the declaration, has its flange where its errors, to first order, carry it."""
    case, _, truth, recording = room
    errors = arm_errors.arm_errors(case.declared_arms, recording)
    arm, sigma = truth.probe_arm, case.declared_arms.probe.deviations()
    true = arm.true
    offsets = (true.a - arm.nominal.a, (true.d - arm.nominal.d)[[0, 2, 3, 4, 5]], true.alpha - arm.nominal.alpha)
    eta = np.concatenate([*offsets, true.zeros]) / sigma
    moved, true = arm_errors.corrected(recording.A, errors.probe.slopes @ eta), arm.flange_pose(recording.q_probe)
    np.testing.assert_allclose(moved[:, :3, 3], true[:, :3, 3], atol=2e-3)
    turned = log_rotation(moved[:, :3, :3].transpose(0, 2, 1) @ true[:, :3, :3])
    assert np.abs(turned).max() < 2e-6
    assert np.linalg.norm(recording.A[:, :3, 3] - true[:, :3, 3], axis=1).min() > 0.02


def test_the_declared_play_is_where_the_true_arm_stops(room):
    """The twin's joints settle from below and from above; the flanges follow to first order, the second arm's too."""
    case, _, truth, recording = room
    rng, half = np.random.default_rng(3), 1e-4
    turn = rng.choice([-1.0, 1.0], recording.q_probe.shape)
    errors = case.content.probe_arm.errors.model_copy(update={"backlash_deg": np.degrees(2 * half)})
    declared = case.declared_arms._replace(probe=case.declared_arms.probe._replace(errors=errors))
    arm = truth.probe_arm._replace(backlash=2 * half, repeatability=0.0)
    told = replace(recording, turn_probe=turn, turn_needle=np.zeros(turn.shape))
    moved = arm_errors.without_play(told, arm_errors.arm_errors(declared, told))
    for q, way, nominal, with_play in zip(recording.q_probe, turn, recording.A, moved.A, strict=True):
        rest = arm.settle(q, q - 0.1 * way, rng)
        np.testing.assert_allclose(with_play, flange_pose(arm.nominal, rest), atol=2e-5)
        assert np.abs(nominal - with_play).max() > 5e-3
    np.testing.assert_array_equal(moved.B, recording.B)


def test_play_of_unknown_sign_is_noise(room):
    """Where no joint's way is known, the flange's covariance grows by half the width squared, as by repeatability."""
    case, _, _, recording = room
    arms = case.declared_arms
    play, noise = (
        arms._replace(probe=arms.probe._replace(errors=arms.probe.errors.model_copy(update=stated)))
        for stated in ({"repeatability_deg": 0.0, "backlash_deg": 0.02}, {"repeatability_deg": 0.01})
    )
    for one in (recording, replace(recording, **{key: np.zeros((30, 6)) for key in ("turn_probe", "turn_needle")})):
        found = arm_errors.arm_errors(play, one)
        np.testing.assert_allclose(found.probe.arrival, arm_errors.arm_errors(noise, one).probe.arrival, rtol=1e-12)
        assert not found.probe.play.any()
        assert not found.probe.slopes[:, :, 23:].any()
    assert PLAY_SIGN in calibrate(recording, noise=NOISE, arms=play).cannot_show


def test_whitening_is_the_inverse_root_of_the_whole_covariance(room):
    """C^-1 of all residuals, written out dense: Omega and N N^T together; and the joint estimate is its margin.

    (J^T C^-1 J)^-1 is the parameters' part of the inverse joint information, and eta's mean is -N^T C^-1 r.
    """
    case, _, _, recording = room
    problem = equation.Problem(
        recording, NOISE, ALL, np.radians(0.5), arm_errors.arm_errors(case.declared_arms, recording)
    )
    fit = plain_fit(problem, drawing(case))
    r, J, sigma, shared = problem.linear_model(fit.estimate)
    N, flat, p = shared.reshape(r.size, -1), J.reshape(r.size, -1), len(ALL)
    C = block_diag(*sigma) + N @ N.T
    whitening = Whitening.of(sigma, shared, np.ones(r.shape))
    white, slopes = whitening.residuals(r), whitening.slopes(J)
    assert white @ white == pytest.approx(r.ravel() @ np.linalg.solve(C, r.ravel()), rel=1e-7)
    information = flat.T @ np.linalg.solve(C, flat)
    scale = np.sqrt(np.outer(np.diag(information), np.diag(information)))
    np.testing.assert_allclose(slopes.T @ slopes / scale, information / scale, atol=1e-9)
    at_fit, margin = weighed(problem, fit), np.linalg.inv(slopes.T @ slopes)
    scale = np.sqrt(np.outer(np.diag(margin), np.diag(margin)))
    np.testing.assert_allclose(at_fit.covariance[:p, :p] / scale, margin / scale, atol=1e-6)
    np.testing.assert_allclose(at_fit.shared, -whitening.slopes(shared).T @ white, atol=1e-5)
    assert at_fit.chi_squared == pytest.approx(white @ white, rel=1e-6)


def test_found_parts_solve_the_likelihood_equation(room):
    """After the last step r^T P D P r = tr(P D) holds for the parts inside and across the image, written out dense."""
    case, _, _, recording = room
    problem = equation.Problem(
        recording, equation.Spread(1.0, 1.0, 1.0), ALL[:-2], arms=arm_errors.arm_errors(case.declared_arms, recording)
    )
    fit = plain_fit(problem, drawing(case))
    for _ in range(6):
        problem = with_spreads(problem, fit)
        fit = plain_fit(problem, fit.estimate)
    r, J, sigma, shared = problem.linear_model(fit.estimate)
    image = recording.A[:, :3, :3] @ fit.estimate.R_X
    N, J = shared.reshape(r.size, -1), J.reshape(r.size, -1)
    V = np.linalg.inv(block_diag(*sigma) + N @ N.T)
    P = V - V @ J @ np.linalg.solve(J.T @ V @ J, J.T @ V)
    for axes in (image[:, :, :2], image[:, :, 2:]):
        D = block_diag(*(axes @ axes.transpose(0, 2, 1)))
        assert r.ravel() @ P @ D @ P @ r.ravel() == pytest.approx(np.trace(P @ D), rel=0.03)


@pytest.fixture(scope="module")
def outcomes():
    kinds = {
        "told": Kind(),
        "uniform, play, found": Kind(uniform=True, play_deg=0.02, told=False),
        "outliers, found": Kind(outliers=3, told=False),
    }
    return {name: [outcome(kind, 1000 + seed) for seed in range(ROOMS)] for name, kind in kinds.items()}


KINDS = ("told", "uniform, play, found", "outliers, found")


@pytest.mark.parametrize("name", KINDS)
def test_the_region_holds_the_truth(outcomes, name):
    """The 95 % region of all parameters, in every room: as often as the binomial distribution allows (99.9 %).

    Real and predicted rms at held-out poses agree, and the 95 % ellipsoids of single tips hold what they say.
    """
    rooms = outcomes[name]
    assert max(binom.ppf(0.001, ROOMS, 0.95), 0.85 * ROOMS - 1) <= sum(one.inside for one in rooms) <= ROOMS
    assert np.mean([one.mahalanobis for one in rooms]) == pytest.approx(1.0, abs=0.25)
    real, predicted = (np.concatenate([getattr(one, key) for one in rooms]) for key in ("errors_mm", "predicted_mm"))
    assert np.sqrt(np.mean(real**2)) == pytest.approx(np.sqrt(np.mean(predicted**2)), rel=0.12)
    assert 0.91 < np.mean([one.held for one in rooms]) < 0.98


def test_a_direction_counts_by_how_much_of_the_shaft_shows():
    """Directions that err as the power -3/2 of the shaft: their one size is found, and the region holds the truth."""
    sizes, inside, narrower = [], 0, []
    for seed in range(ROOMS):
        rng = np.random.default_rng([31, seed])
        recording, truth = simulate_recording(rng, 30, noise=SPEC_NOISE._replace(direction_rad=0.0))
        recording = replace(recording, shaft_mm=np.exp(rng.uniform(np.log(8.0), np.log(60.0), 30)))
        spread = recording.direction_spread * SPEC_NOISE.direction_rad
        assert np.sqrt(np.mean(spread**2)) == pytest.approx(SPEC_NOISE.direction_rad)
        angle = np.arctan2(*recording.v.T[::-1]) + rng.normal(0.0, spread)
        recording = replace(recording, v=np.column_stack([np.cos(angle), np.sin(angle)]))
        found, same = calibrate(recording), calibrate(replace(recording, shaft_mm=None))
        e = found.parameter_error(as_estimate(truth))
        inside += e @ np.linalg.solve(found.covariance_counts, e) <= found.region_limit()
        sizes.append(found.noise.direction_rad)
        narrower.append(np.trace(found.covariance[15:, 15:]) < np.trace(same.covariance[15:, 15:]))
    assert np.sqrt(np.mean(np.square(sizes))) == pytest.approx(SPEC_NOISE.direction_rad, rel=0.15)
    assert inside >= binom.ppf(0.001, ROOMS, 0.95)
    assert np.mean(narrower) > 0.8


def test_the_region_holds_the_truth_of_rendered_pictures():
    """Detected tips and directions, play, and noise found: as often as the binomial distribution allows (99.9 %)."""
    kind = Kind(told=False, rendered=True, play_deg=0.02)
    rooms = [outcome(kind, seed) for seed in range(PICTURED)]
    assert sum(one.inside for one in rooms) >= binom.ppf(0.001, PICTURED, 0.95)
    assert np.mean([one.mahalanobis for one in rooms]) < 1.35


def test_the_arms_errors_take_a_third_off_the_held_out_error(outcomes):
    """Beside the same rooms calibrated as if all errors were noise; whose region holds the truth in hardly any."""
    noise_alone = [outcome(Kind(arms=0.0), 1000 + seed) for seed in range(ROOMS // 2)]
    rms = [
        np.sqrt(np.mean(np.concatenate([one.errors_mm for one in rooms]) ** 2))
        for rooms in (noise_alone, outcomes["told"][: ROOMS // 2])
    ]
    assert rms[1] < 0.72 * rms[0]
    assert sum(one.inside for one in noise_alone) <= 1


def test_arms_declared_too_small_show_in_chi_squared():
    """Declared at a quarter, chi-squared over its freedom is above the limit of the warning on average."""
    small = [outcome(Kind(arms=0.25), 1000 + seed).chi2_per_freedom for seed in range(6)]
    assert np.mean(small) > 1.15


def test_wrong_tips_are_set_aside_with_declared_arms(outcomes):
    """Three tips 5 mm off are found in every room, others hardly ever."""
    rooms = outcomes["outliers, found"]
    assert all(one.lost >= 3 for one in rooms)
    assert np.mean([one.lost for one in rooms]) < 3.5


def test_the_aim_counts_the_needle_arms_errors(room):
    """Sent to 60 places in the image, the tip is nearer to them than without the errors that were found."""
    case, candidates, truth, recording = room
    found = calibrate(recording, noise=NOISE, arms=case.declared_arms)
    others = np.setdiff1d(np.arange(len(candidates.q_probe)), room_of(0.0)[3])[:60]
    missed = {}
    for name, calibration in (("counted", found), ("left", calibrate(recording, noise=NOISE))):
        gaps = []
        for row in others:
            target = candidates.poses.P[row]
            q = aim(candidates, int(row), target, calibration, case.models)
            ended = truth.needle_in_image(candidates.q_probe[row], q).tip_image
            gaps.append(np.linalg.norm(ended - np.append(target, 0.0)))
        missed[name] = np.sqrt(np.nanmean(np.square(gaps)))
    assert missed["counted"] < 0.8 * missed["left"]


def test_the_needle_length_and_declared_arms_go_together(room):
    """The tip's part along the shaft leaves the joint covariance, and predictions stay finite."""
    case, _, truth, recording = room
    length = float(truth.tip_end2 @ truth.V)
    found = calibrate(recording, arms=case.declared_arms, needle_length_mm=length, direction=False)
    V, tip = found.needle_direction_end2, slice(12, 15)
    assert abs(V @ found.covariance[tip, tip] @ V) < 1e-9
    assert np.linalg.eigvalsh(found.tip_covariances(recording)).min() > 0


def test_joints_are_written_and_read(room, tmp_path):
    recording = room[3]
    write_recording(recording, tmp_path / "recording.csv")
    again = read_recording(tmp_path / "recording.csv")
    np.testing.assert_allclose(again.q_probe, recording.q_probe, atol=1e-14)
    np.testing.assert_allclose(again.q_needle, recording.q_needle, atol=1e-14)
    turn = np.random.default_rng(0).integers(-1, 2, (2, 30, 6)).astype(float)
    told = replace(recording, turn_probe=turn[0], turn_needle=turn[1])
    write_recording(told, tmp_path / "turns.csv")
    again = read_recording(tmp_path / "turns.csv").subset(np.arange(4, 20))
    np.testing.assert_array_equal(again.turn_probe, turn[0, 4:20])
    np.testing.assert_array_equal(joined(again, again).turn_needle, np.tile(turn[1, 4:20], (2, 1)))


def test_joints_and_their_turns_belong_to_both_arms(room):
    """Turns are signs; those of one arm alone, and turns or declared arms without joints, are bad input."""
    case, _, _, r = room
    turn = np.ones((30, 6))
    for changes, code in (
        ({"turn_probe": 0.5 * turn, "turn_needle": turn}, "bad_value"),
        ({"turn_probe": turn}, "joints_of_one_arm"),
        ({"q_probe": None, "q_needle": None, "turn_probe": turn, "turn_needle": turn}, "joints_of_one_arm"),
        ({"q_needle": None}, "joints_of_one_arm"),
    ):
        with refused(code):
            replace(r, **changes)
    with refused("missing_column"):
        calibrate(Recording(r.A, r.B, r.P, r.v), arms=case.declared_arms)
