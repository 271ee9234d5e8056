"""The 28 columns of the arm's error Jacobian against central differences of a plain forward kinematics."""

import numpy as np
import pytest

from puncture_twin.planning.arm.kinematics import FREE_D, N_PARAMETERS, error_jacobian
from puncture_twin.planning.arm.ur import UR_MODELS, ur_model
from puncture_twin.planning.geometry.rigid import exp_rotation, log_rotation
from puncture_twin.twin.plant.true_needle import joints_at_points, true_needle

STEP = 1e-5


def plain_needle(model, q, eta, tip_mm):
    a, d = np.array(model.a) + eta[:6], np.array(model.d)
    d[list(FREE_D)] += eta[6:11]
    alpha, q = np.array(model.alpha) + eta[11:17], q + eta[17:23]
    R, p = np.eye(3), np.zeros(3)
    for i in range(6):
        p = p + d[i] * R[:, 2]
        R = R @ exp_rotation(np.array([0.0, 0.0, q[i]]))
        p = p + a[i] * R[:, 0]
        R = R @ exp_rotation(np.array([alpha[i], 0.0, 0.0]))
    tip = p + R @ (np.array([0.0, 0.0, tip_mm]) + eta[23:26])
    return tip, R @ exp_rotation(np.array([eta[26], eta[27], 0.0]))


@pytest.mark.parametrize("name", sorted(UR_MODELS))
def test_every_column_is_the_derivative(name, rng):
    """Lengths, twists, zeros, tip offset and direction; to 1e-7 of numbers up to 1,000."""
    model = ur_model(name)
    for q in rng.uniform(-3, 3, (3, 6)):
        J = error_jacobian(model, q, 210.0)
        for k in range(N_PARAMETERS):
            eta = np.zeros(N_PARAMETERS)
            eta[k] = STEP
            (p1, R1), (p0, R0) = (plain_needle(model, q, sign * eta, 210.0) for sign in (1, -1))
            column = np.concatenate([p1 - p0, log_rotation(R1 @ R0.T)]) / (2 * STEP)
            np.testing.assert_allclose(J[:, k], column, atol=1e-6)


def test_the_twins_needle_is_the_plain_one(rng):
    model, q, eta = ur_model("ur3"), rng.uniform(-3, 3, (20, 6)), rng.normal(0, 0.05, (20, 28))
    found = true_needle(model, q, eta, 210.0)
    for row in range(20):
        tip, R = plain_needle(model, q[row], eta[row], 210.0)
        np.testing.assert_allclose(found.tip_base[row], tip, atol=1e-9)
        np.testing.assert_allclose(found.R_base_needle[row], R, atol=1e-12)


def test_a_true_tip_is_driven_onto_its_point(rng):
    model, eta = ur_model("ur3"), rng.normal(0, 1, (50, 28)) * np.sqrt(np.r_[np.full(11, 0.25), np.full(17, 1e-6)])
    q = np.tile([0.3, -1.2, 1.4, -1.0, -1.5, 0.2], (50, 1)) + rng.normal(0, 0.1, (50, 6))
    points = true_needle(model, q, np.zeros((50, 28)), 210.0).tip_base
    reached = true_needle(model, joints_at_points(model, points, q, eta, 210.0), eta, 210.0).tip_base
    np.testing.assert_allclose(reached, points, atol=1e-3)
