"""An arm as it really is, beside its nominal model."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UR_MODELS, ur_model
from puncture_twin.planning.case.errors import ArmErrors
from puncture_twin.twin.plant.truth import draw_true_arm

EXACT = ArmErrors(link_mm=0.0, twist_deg=0.0, joint_deg=0.0, repeatability_deg=0.0)


@pytest.mark.parametrize("name", UR_MODELS)
def test_without_errors_it_is_the_nominal_arm(name):
    """Every link of a perfect arm stands where the compiled kinematics say."""
    rng = np.random.default_rng(1)
    model = ur_model(name)
    arm = draw_true_arm(model, EXACT, rng)
    q = rng.uniform(-np.pi, np.pi, (50, 6))
    assert np.abs(arm.true.link_poses(q) - link_poses(model, q)).max() < 1e-9


def test_true_arm_against_scipy():
    """A drawn arm's flange, against the four elementary motions of each row of its table, composed by SciPy."""
    rng = np.random.default_rng(2)
    arm = draw_true_arm(ur_model("ur3"), ArmErrors(link_mm=1.0, twist_deg=0.6, joint_deg=1.2), rng)
    q = rng.uniform(-np.pi, np.pi, 6)
    T = np.eye(4)
    for i in range(6):
        step = np.eye(4)
        turn = Rotation.from_euler("z", q[i] + arm.true.zeros[i])
        step[:3, :3] = (turn * Rotation.from_euler("x", arm.true.alpha[i])).as_matrix()
        step[:3, 3] = [0, 0, arm.true.d[i]] + turn.apply([arm.true.a[i], 0, 0])
        T = T @ step
    assert np.abs(arm.flange_pose(q) - T).max() < 1e-9


def test_play_follows_only_past_its_edge():
    """A motion smaller than the play moves nothing; turning back costs the whole width."""
    errors = EXACT.model_copy(update={"backlash_deg": np.degrees(0.02)})
    arm, rng, q = (
        draw_true_arm(ur_model("ur3"), errors, np.random.default_rng(3)),
        np.random.default_rng(4),
        np.zeros(6),
    )
    for asked, rest in ((0.009, 0.0), (0.1, 0.09), (0.085, 0.09), (0.05, 0.06)):
        q = arm.settle(np.full(6, asked), q, rng)
        assert np.abs(q - rest).max() < 1e-15


def test_errors_have_the_spread_that_was_asked_for():
    """Standard deviations over many drawn arms; repeatability is drawn at each arrival."""
    rng = np.random.default_rng(5)
    errors = ArmErrors(link_mm=0.3, twist_deg=0.06, joint_deg=0.12, repeatability_deg=0.03)
    model = ur_model("ur3")
    arms = [draw_true_arm(model, errors, rng) for _ in range(2000)]
    assert np.std([arm.true.a - np.array(model.a) for arm in arms]) == pytest.approx(0.3, rel=0.05)
    assert np.std([np.delete(arm.true.d - np.array(model.d), 1) for arm in arms]) == pytest.approx(0.3, rel=0.05)
    assert np.std([arm.true.alpha - np.array(model.alpha) for arm in arms]) == pytest.approx(errors.twist, rel=0.05)
    assert np.std([arm.true.zeros for arm in arms]) == pytest.approx(errors.joint, rel=0.05)
    rests = [arms[0].settle(np.zeros(6), np.zeros(6), rng) for _ in range(2000)]
    assert np.std(rests) == pytest.approx(errors.repeatability, rel=0.05)
