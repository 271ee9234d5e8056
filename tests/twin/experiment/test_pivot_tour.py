"""A pivot calibration executed in the twin: the tip is found back, with the error and residual that are declared."""

import dataclasses
import json
from itertools import combinations

import numpy as np
import pytest
from places import ROOT
from refusals import refused
from typer.testing import CliRunner

from puncture_twin.planning.arm.kinematics import PARAMETERS, flange_pose
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import uncounted
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.touch.touch_planner import plan_pivot, spread_poses
from puncture_twin.run_twin import app
from puncture_twin.twin.jobs.experiment.pivot_job import calibrated, pivot_case, pivot_tour, pivot_tour_text
from puncture_twin.twin.plant import true_needle
from puncture_twin.twin.plant.true_needle import draw_pivot_truth

CASE = ROOT / "meshes" / "carton" / "case_m.toml"


@pytest.fixture(scope="module")
def context():
    return prepare(CASE)


@pytest.fixture(scope="module")
def tour(context):
    return plan_pivot(context, 8, place_base=None, seed=0, progress=uncounted)


def test_every_pose_has_the_tip_on_the_place(tour):
    """By nominal kinematics, tilted by 45 degrees at most, and turned about the needle."""
    for touch in tour.touches:
        T = flange_pose(tour.model, touch.q_touch)
        np.testing.assert_allclose(T[:3, 3] + tour.tip_mm * T[:3, 2], touch.point_base, atol=1e-6)
    axes = flange_pose(tour.model, np.array([touch.q_touch for touch in tour.touches]))[:, :3, 2]
    assert np.degrees(np.arccos((axes @ axes.T).min())) > 60


def test_the_poses_taken_tell_the_tip_nearly_as_well_as_any():
    """Against every set of four of nine: what is left uncertain is at most a fifth more than of the best."""
    rng = np.random.default_rng(2)
    R = exp_rotation(rng.normal(0, 0.5, (9, 3)))

    def spread(rows):
        A = np.concatenate([R[list(rows)], np.broadcast_to(-np.eye(3), (len(rows), 3, 3))], axis=2).reshape(-1, 6)
        return np.linalg.det(A.T @ A) ** (-1 / 12)

    best = min(spread(rows) for rows in combinations(range(9), 4))
    assert spread(spread_poses(R, 4)) <= 1.2 * best


def test_a_place_that_cannot_be_touched_is_refused(context):
    """Far beyond the arm's reach."""
    with refused("too_few_poses", by=NoAnswerError):
        plan_pivot(context, 6, place_base=np.array([3000.0, 0.0, 0.0]), seed=0, progress=uncounted)


def drawn(context, tour, errors, seed):
    names = tuple(touch.name for touch in tour.touches)
    T, place = context.placement.T_base_ct, tour.touches[0].point_base
    truth = draw_pivot_truth(T, names, place, errors, seed)
    q = np.array([truth.q_contact(tour.model, tour.tip_mm, touch) for touch in tour.touches])
    case = dataclasses.replace(context.case, errors=errors)
    tip = truth.eta[PARAMETERS["tip_offset"]] + np.array([0.0, 0.0, tour.tip_mm])
    return calibrated(case, names, q, where="drawn"), tip


@pytest.mark.parametrize(("link_mm", "joint_deg"), [(0.05, 0.005), (0.5, 0.05)])
def test_errors_and_residuals_are_those_declared(context, tour, link_mm, joint_deg):
    """Squared errors of the tip are those of its covariance, residuals likewise: known to 11 % where one axis errs."""
    off = np.radians(joint_deg)
    arm = dataclasses.replace(context.case.errors.arm, link_mm=link_mm, joint=off, twist=off)
    errors = dataclasses.replace(context.case.errors, arm=arm)
    found = [drawn(context, tour, errors, seed) for seed in range(100)]
    squared = np.mean([np.sum((pivot.tip_flange - tip) ** 2) for pivot, tip in found])
    assert squared == pytest.approx(np.mean([np.trace(pivot.cov_tip) for pivot, _ in found]), rel=0.2)
    residual = np.mean([pivot.residual_mm**2 for pivot, _ in found])
    assert residual == pytest.approx(np.mean([pivot.expected_whole_mm**2 for pivot, _ in found]), rel=0.2)
    assert not any(pivot.large for pivot, _ in found) or link_mm > 0.1


def test_the_twin_finds_the_tip_of_its_arm(context, tmp_path, monkeypatch):
    """Executed until contact is felt, an arm whose tip is off and nothing else: found within what contact costs."""
    off = np.array([1.2, -0.7, 0.9])

    def without_noise(T_base_ct, names, place_base, errors, seed):
        truth = draw_pivot_truth(T_base_ct, names, place_base, errors, seed)
        eta, place = np.zeros(28), np.linalg.inv(T_base_ct) @ np.append(place_base, 1.0)
        eta[PARAMETERS["tip_offset"]] = off
        still = dict.fromkeys(names, np.zeros(6))
        return dataclasses.replace(truth, eta=eta, aim_ct=dict.fromkeys(names, place[:3]), arrival=still)

    monkeypatch.setattr(true_needle, "draw_pivot_truth", without_noise)
    run = pivot_tour(context, tmp_path, 4, None, 0)
    np.testing.assert_allclose(run.calibration.pivot.tip_flange, off + [0.0, 0.0, 401.0], atol=0.06)
    assert run.calibration.pivot.residual_mm < 0.05
    assert "4 poses touched about" in pivot_tour_text(run)
    again = pivot_case(context.case, tmp_path / "pivot.csv")
    np.testing.assert_allclose(again.pivot.tip_flange, run.calibration.pivot.tip_flange, atol=1e-6)
    assert json.loads((tmp_path / "pivot.json").read_text())["tip_error_mm"] == pytest.approx(run.error_mm)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--poses", "3"], "3 poses; allowed: 4 to 12"),
        (["--at", "1,2"], "--at: 2 numbers"),
        (["touch.csv", "--poses", "8"], "JOINTS.csv, or the options of the twin"),
    ],
)
def test_wrong_options_are_refused(arguments, said, tmp_path):
    """In one line, before anything is computed."""
    out = [] if arguments[0] == "touch.csv" else ["--out", str(tmp_path)]
    done = CliRunner().invoke(app, ["pivot", str(CASE), *arguments, *out])
    assert said in str(done.exception)
