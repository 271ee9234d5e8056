"""What a stand of the arm is worth beside its reach: the tip's expected error, of markers touched anew from there."""

from dataclasses import replace

import numpy as np
import pytest

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import farthest_from_singular
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.planning.place.search import _worth, expected_tip_error_mm, pose_error_from
from puncture_twin.planning.registration.placement import load_placement


@pytest.fixture(scope="module")
def abdomen():
    case = load_case(folder() / "abdomen")
    placement = load_placement(case)
    T_base_ct = placement.T_base_ct
    outward = T_base_ct[:3, :3] @ case.T_ct_entry[:3, 2]
    target, rolls = apply(T_base_ct, case.target_ct), np.radians(np.arange(0, 360, 30))
    model = case.robot.model
    q = inverse(model, flange_poses(target, outward, case.needle.length_mm, rolls)).reshape(-1, 6)
    return case, placement, farthest_from_singular(model, q, outward)[None]


def test_it_is_the_cases_own_where_the_arm_stands_and_turns_with_both(abdomen):
    case, placement, q = abdomen
    own = placement.registration.uncertainty
    unknown = replace(own, noise=replace(own.noise, touches_known=False))
    error = replace(pose_error_from(case, placement.registration, placement.T_base_ct), fit=unknown)
    expected = float(np.sqrt(np.trace(error.covariance(q)[0, :3, :3])))
    assert expected_tip_error_mm(case, placement, placement.T_base_ct, q) == pytest.approx(expected, rel=0.02)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = pose(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    turned = q + np.array([0.7, 0, 0, 0, 0, 0])
    here = expected_tip_error_mm(case, placement, placement.T_base_ct, q)
    assert expected_tip_error_mm(case, placement, turn @ placement.T_base_ct, turned) == pytest.approx(here, rel=0.02)
    readings = replace(case.errors, arm=case.errors.arm.scaled(0.0))
    exact = expected_tip_error_mm(replace(case, errors=readings), placement, placement.T_base_ct, q)
    assert exact < 0.7 * here
    T = placement.T_base_ct
    assert expected_tip_error_mm(replace(case, errors=None), placement, T, q) is None
    assert expected_tip_error_mm(case, None, T, q) is None
    assert expected_tip_error_mm(case, replace(placement, registration=None), T, q) is None
    assert expected_tip_error_mm(case, placement, T, q[:0]) is None


def test_equal_shares_are_told_apart_by_the_error_then_by_the_margin():
    """A share to three digits comes first, an error to a hundredth of a mm second."""

    def rated(fraction, expected, margin):
        verdict = type("Verdict", (), {"fraction": fraction, "margin": margin})()
        return type("Rated", (), {"verdict": verdict, "expected_mm": expected})()

    best = [rated(0.9, 2.0, 0.1), rated(0.8001, 0.61, 0.1), rated(0.8002, 0.612, 0.05), rated(0.8, 0.7, 0.9)]
    assert sorted([best[row] for row in (3, 1, 0, 2)], key=_worth) == best
    plain = [rated(0.9, None, 0.1), rated(0.8, None, 0.9), rated(0.8, None, 0.5)]
    assert sorted([plain[row] for row in (2, 0, 1)], key=_worth) == plain
