"""Hand-eye: exact without noise, no worse than Park and Martin, regions that hold, and refusals that name why."""

import json

import numpy as np
import pytest
from hand_eye_world import hand_eye_problem, write_pairs
from refusals import refused, refused_command

from puncture_twin.planning.geometry.rigid import inverse, log_rotation, pose
from puncture_twin.planning.registration.hand_eye import (
    HandEyeNoise,
    PosePairs,
    calibrate_hand_eye,
    noise_of,
    read_pose_pairs,
)
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK

NOISE = HandEyeNoise(0.1, 5e-4, 0.2, 1e-3)


def park_martin(A, B):
    """X of motions A X = X B (Park and Martin, IEEE Trans. Robot. Autom. 10, 1994, equations 26 and 29)."""
    a, b = log_rotation(A[:, :3, :3]), log_rotation(B[:, :3, :3])
    M = b.T @ a
    values, vectors = np.linalg.eigh(M.T @ M)
    R = vectors @ np.diag(values**-0.5) @ vectors.T @ M.T
    C, d = A[:, :3, :3] - np.eye(3), B[:, :3, 3] @ R.T - A[:, :3, 3]
    return pose(R, np.linalg.lstsq(C.reshape(-1, 3), d.ravel(), rcond=None)[0])


def all_motions(pairs):
    i, j = np.triu_indices(len(pairs.names), 1)
    return inverse(pairs.A[i]) @ pairs.A[j], inverse(pairs.B[i]) @ pairs.B[j]


@pytest.mark.parametrize("motions", [False, True])
def test_problems_without_noise_are_solved_exactly(motions):
    for seed in range(60):  # of each equation
        rng = np.random.default_rng([1, seed])
        pairs, X, Z = hand_eye_problem(rng, 6, motions=motions)
        found = calibrate_hand_eye(pairs, NOISE if seed else None)  # a spread that is found is that of rounding
        own = park_martin(*((pairs.A, pairs.B) if motions else all_motions(pairs)))
        np.testing.assert_allclose(found.X, X, atol=1e-8)
        np.testing.assert_allclose(own, X, atol=1e-7)
        assert (found.Z is None) if motions else np.abs(found.Z - Z).max() < 1e-8
        assert not found.outliers


def test_with_noise_it_is_nearer_than_the_closed_form():
    """Over 150 problems: rotation and place of the camera, rms."""
    errors = []
    for seed in range(150):
        rng = np.random.default_rng([2, seed])
        pairs, X, _ = hand_eye_problem(rng, 12, NOISE)
        ways = calibrate_hand_eye(pairs, NOISE).X, park_martin(*all_motions(pairs))
        turns = [np.linalg.norm(log_rotation(T[:3, :3].T @ X[:3, :3])) for T in ways]
        errors.append(list(zip(turns, [np.linalg.norm(T[:3, 3] - X[:3, 3]) for T in ways], strict=True)))
    (rad, mm), (their_rad, their_mm) = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rad < 1.02 * their_rad and mm < 1.02 * their_mm


@pytest.mark.parametrize("motions", [False, True])
@pytest.mark.parametrize("noise", [NOISE, None])
def test_region_and_intervals_hold_the_truth(motions, noise):
    """95 % of both in 100 problems, with a noise that is stated and with one that is found; few poses stand out."""
    inside, within, aside = [], [], 0
    for seed in range(100):
        pairs, X, Z = hand_eye_problem(np.random.default_rng([3, seed]), 15, NOISE, motions=motions)
        found = calibrate_hand_eye(pairs, noise)
        e = found.error(X, Z)
        inside.append(e @ np.linalg.solve(found.covariance, e) <= found.region_limit())
        within.append(np.abs(e) <= found.intervals())
        aside += bool(found.outliers)
    assert 0.91 <= np.mean(inside) <= 0.99  # its deviation is 2.2 %
    assert 0.92 <= np.mean(within) <= 0.98
    assert aside <= 6


def test_a_noise_that_is_too_small_and_a_pose_that_is_wrong_are_said():
    pairs, _, _ = hand_eye_problem(np.random.default_rng(4), 15, NOISE)
    assert [one.code for one in calibrate_hand_eye(pairs, NOISE).findings()] == []
    small = calibrate_hand_eye(pairs, HandEyeNoise(*(value / 2 for value in NOISE)))
    assert "residuals_large" in [one.code for one in small.findings()]
    A = np.array(pairs.A)
    A[6, :3, 3] += [0.0, 2.0, 0.0]
    assert calibrate_hand_eye(PosePairs(A, pairs.B), NOISE).outliers == ("7",)


@pytest.mark.parametrize("motions", [False, True])
@pytest.mark.parametrize("noise", [None, NOISE])
def test_rotations_that_cannot_show_the_camera_are_refused(rng, motions, noise):
    """None, or all about one axis, which is named: what slides along it no pose shows."""
    axis = np.array([0.6, 0.0, 0.8])
    none, one = np.zeros((12, 3)), np.outer(rng.uniform(-0.6, 0.6, 12), axis)
    for turns, says in ((none, "hardly rotates"), (one, "0.60"), (one, "0.80")):
        with refused("poses_too_alike", says):
            calibrate_hand_eye(hand_eye_problem(rng, 12, noise, motions=motions, turns=turns)[0])
    both = np.concatenate([one, np.outer(rng.uniform(-0.2, 0.2, 12), [0.0, 1.0, 0.0])])
    assert calibrate_hand_eye(hand_eye_problem(rng, 24, noise, motions=motions, turns=both)[0]).condition > 9e-3


def test_another_reading_is_named(rng):
    """Inverse poses and metres; what fits in no reading is refused too, and so are too few."""
    pairs, _, Z = hand_eye_problem(rng, 12, NOISE)
    metres = np.array(pairs.B)
    metres[:, :3, 3] /= 1000.0
    for A, B, says in (
        (inverse(pairs.A), pairs.B, "A and B is inverse"),
        (pairs.A, inverse(pairs.B), "A and B is inverse"),
        (pairs.A, metres, "metres"),
    ):
        with refused("recording_slip", says):
            calibrate_hand_eye(PosePairs(A, B))
    exchanged = calibrate_hand_eye(PosePairs(inverse(pairs.A), inverse(pairs.B)))
    np.testing.assert_allclose(exchanged.X, Z, atol=2.0)  # the same equation: no residual shows it
    far = [one.code for one in exchanged.findings()]
    assert ("both_inverse" in far) == (np.linalg.norm(exchanged.X[:3, 3]) > 1000.0)
    with refused("residuals_too_large"):
        calibrate_hand_eye(PosePairs(pairs.A, np.roll(pairs.B, 1, axis=0)))
    with refused("too_few_poses"):
        calibrate_hand_eye(PosePairs(pairs.A[:2], pairs.B[:2]))
    small = np.array(pairs.A)
    small[:, :3, 3] /= 1000.0
    with refused("wrong_unit", "metres"):
        calibrate_hand_eye(PosePairs(small, pairs.B))
    for stated in ((0.1, 0.1, 0.1), (0.1, 0.0, 0.1, 0.0), (-0.1, 0.1, 0.1, 0.1), (np.nan, 1, 1, 1)):
        with refused("not_positive"):
            noise_of(stated)


def test_by_the_command(rng, tmp_path, capfd):
    """A CSV in, X with its intervals out, in mm and degrees; a matrix that is none is refused with its line."""
    pairs, X, _ = hand_eye_problem(rng, 15, NOISE)
    path = tmp_path / "pairs.csv"
    write_pairs(path, pairs)
    np.testing.assert_array_equal(read_pose_pairs(path).A, pairs.A)
    noise = ["--noise", "0.1,0.0286,0.2,0.0573"]
    assert main(["calibrate", "hand-eye", "--recording", str(path), *noise, "--json"]) == OK
    facts = json.loads(capfd.readouterr().out)
    half = facts["interval_95"]["T_flange_camera"]
    error = np.abs(np.array(facts["T_flange_camera"]) - X)[:3, 3]
    assert (error < 2 * np.array(half["translation_mm"])).all() and max(half["rotation_deg"]) < 0.2
    assert facts["equation"] == "AX = ZB" and facts["findings"] == []
    assert main(["calibrate", "hand-eye", "--recording", str(path)]) == OK
    assert "T_flange_camera" in capfd.readouterr().out
    command = ["calibrate", "hand-eye", "--recording", path]
    refused_command([*command, "--motions"], capfd, "residuals_too_large")
    refused_command([*command, "--noise", "1,x"], capfd, "not_a_number")
    text = path.read_text()
    path.write_text(text.replace("A_r11", "A_r"))
    refused_command(command, capfd, "wrong_columns", "pairs.csv")
    path.write_text(text.replace("\n1,", "\n1,9", 1))
    refused_command(command, capfd, "not_rigid", "pairs.csv", "pose 1")
