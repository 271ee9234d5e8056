"""The needle's covariance: against rooms drawn with exact kinematics, against published formulas, and by its laws."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtri
from uncertainty_world import NO_ARM, SLICES, declared, world

from puncture_twin.planning.arm.kinematics import FREE_D, N_PARAMETERS, error_jacobian, flange_pose
from puncture_twin.planning.arm.ur import UR_MODELS, ur_model
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, log_rotation, pose
from puncture_twin.planning.registration.marker_noise import reading_noise
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import leverage, register
from puncture_twin.planning.uncertainty.pose_error import choose_touches, error_budget
from puncture_twin.twin.plant.true_needle import joints_at_points, true_needle
from puncture_twin.twin.rehearsal.trials import draw_trials

ROOMS = 6_000
"""A ratio's deviation is .009 at most, coverage's .003: a ratio off by .05, or coverage by .02, is hardly missed."""

NOMINAL = {"arm": "nominal", "tip_offset_mm": 1.0, "needle_direction_deg": 0.5}
CASES = [
    ("abdomen/case.toml", "rigid", NO_ARM),
    ("abdomen/case.toml", "rigid", {}),
    ("abdomen/case.toml", "weighted", NOMINAL),
    ("carton/case_m.toml", "weighted", SLICES | NO_ARM),
    ("carton/case_m.toml", "rigid", SLICES | NO_ARM),
    ("carton/case_m.toml", "triad", SLICES | NO_ARM),
    ("carton/case_m.toml", "weighted", SLICES | NOMINAL),
    ("carton/case_m.toml", "corrected", SLICES | NOMINAL),
]


@pytest.mark.parametrize(("case", "method", "keys"), CASES)
def test_rooms_err_as_predicted(case, method, keys):
    """Realised over predicted .97 to 1.03, in the tip and in the direction; the 95 % ellipsoid holds 94 to 96 %."""
    w = world(case, method, declared(**keys))
    rooms = draw_trials(w.puncture, w.errors, ROOMS, np.random.default_rng(0))
    assert rooms.reached.all()
    error, q = rooms.tip_ct - rooms.target_ct, w.puncture.q_insertion[None]
    cov = w.error.tip_covariance_ct(q)[0]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1)) / np.trace(cov)) == pytest.approx(1.0, abs=0.03)
    square = np.einsum("na,ab,nb->n", error, np.linalg.inv(cov), error)
    assert 0.94 <= np.mean(square <= chdtri(3, 0.05)) <= 0.96
    turned = np.cross(w.puncture.outward_ct, rooms.outward_ct)
    across = np.eye(3) - np.outer(w.puncture.outward_ct, w.puncture.outward_ct)
    predicted = np.trace(across @ w.error.covariance_ct(q)[0, 3:, 3:] @ across)
    assert np.sqrt(np.mean(np.sum(turned**2, axis=1)) / predicted) == pytest.approx(1.0, abs=0.03)


def test_a_declaration_that_is_wrong_by_two_is_seen():
    w = world("abdomen/case.toml", "rigid", declared())
    rooms = draw_trials(w.puncture, w.errors.scaled(2.0), ROOMS, np.random.default_rng(0))
    error = rooms.tip_ct - rooms.target_ct
    cov = w.error.tip_covariance_ct(w.puncture.q_insertion[None])[0]
    assert np.mean(np.einsum("na,ab,nb->n", error, np.linalg.inv(cov), error) <= chdtri(3, 0.05)) < 0.6


def test_isotropic_noise_without_an_arm_is_fitzpatricks_formula():
    """<TRE^2> of Fitzpatrick, West, Maurer 1998, Eq. 46, to 1e-9."""
    errors = declared(ct_in_plane_mm=0.5, ct_slice_mm=0.5, touch_mm=0.1, target_mm=0.0, **NO_ARM)
    w = world("abdomen/case.toml", "rigid", errors)
    trace = np.trace(w.error.covariance(w.puncture.q_insertion[None])[0, :3, :3])
    lever = leverage(w.puncture.points_ct, w.puncture.target_ct[None])[0]
    assert trace == pytest.approx(3 * (0.5**2 + 0.1**2) * lever**2, rel=1e-9)


def test_touching_as_it_inserts_cancels_tip_offset_and_arm():
    errors = declared(**(NO_ARM | {"tip_offset_mm": 1.0}))
    left = []
    for alike in (True, False):
        w = world("abdomen/case.toml", "rigid", errors, touch_like_insertion=alike)
        left.append(np.trace(w.error.parts(w.puncture.q_insertion[None])["tip_offset"][0, :3, :3]))
    assert left[0] < 0.02 * left[1]
    errors = declared(**(NO_ARM | {"link_mm": 0.5, "twist_deg": 0.05, "joint_deg": 0.1}))
    left = []
    for alike in (True, False):
        w = world("abdomen/case.toml", "rigid", errors, touch_like_insertion=alike)
        parts = w.error.parts(w.puncture.q_insertion[None])
        left.append(sum(np.trace(parts[source][0, :3, :3]) for source in ("link", "twist", "joint")))
    assert left[0] < 0.5**2 * left[1]


def test_no_errors_leave_no_doubt_and_a_moved_base_changes_nothing():
    errors = declared(ct_in_plane_mm=0.0, ct_slice_mm=0.0, touch_mm=1e-9, target_mm=0.0, **NO_ARM)
    w = world("abdomen/case.toml", "rigid", errors)
    assert np.abs(w.error.tip_covariance(w.puncture.q_insertion[None])).max() < 1e-15
    T = pose(exp_rotation(np.array([0.0, 0.0, 0.4])), np.array([20.0, -15.0, 30.0]))
    errors = declared(**(SLICES | NO_ARM))
    one, other = (world("carton/case_m.toml", "weighted", errors, moved=moved) for moved in (None, T))
    covs = [w.error.tip_covariance_ct(w.puncture.q_insertion[None])[0] for w in (one, other)]
    np.testing.assert_allclose(covs[0], covs[1], rtol=1e-9)
    w = world("carton/case_m.toml", "weighted", declared(**SLICES))
    budget = error_budget(w.error, w.puncture.q_insertion, w.puncture.T_base_ct[:3, :3] @ w.puncture.outward_ct)
    assert sum(budget.fraction.values()) == pytest.approx(1.0, abs=1e-12)
    assert np.hypot(budget.lateral_mm, budget.depth_mm) == pytest.approx(budget.rms_mm, rel=1e-12)
    assert min(budget.fraction.values()) >= 0


@pytest.mark.parametrize("method", ["rigid", "weighted", "joint"])
@pytest.mark.parametrize("axes", [(1, 2, 0), (2, 0, 1)])
def test_ct_axes_in_another_order_change_nothing_for_the_robot(method, axes):
    """Markers, target and declared reading in axes that are named otherwise: the same pose and the same doubt."""
    w = world("carton/case_m.toml", "weighted", declared(**(SLICES | NOMINAL)))
    P, rng = np.eye(3)[list(axes)], np.random.default_rng(5)
    noise, points, target = w.puncture.noise, w.puncture.points_ct, w.puncture.target_ct
    there = apply(w.puncture.T_base_ct, points) + rng.normal(0, 0.5, points.shape)
    names, told = tuple("ABC"), []
    for turn in (np.eye(3), P):
        turned = replace(noise, cov_ct=turn @ noise.cov_ct @ turn.T)
        markers = MarkerPairs(names, points @ turn.T, there)
        fitted = register(markers, method=method, target_ct=turn @ target, noise=turned, accept_residuals=True)
        at = apply(fitted.T_base_ct, turn @ target)
        told.append((at, fitted.uncertainty.cov_at(at)))
    np.testing.assert_allclose(told[0][0], told[1][0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(told[0][1], told[1][1], rtol=1e-7, atol=1e-12)


ARM = {"arm": "nominal", "tip_offset_mm": 0.0, "needle_direction_deg": 0.0, "joint_drift_deg": 0.0}


def tip_rms(w, q_touch):
    noise = reading_noise(w.errors, w.error.model, w.error.tip_mm, q_touch, known=True)
    error = replace(w.error, fit=replace(w.error.fit, noise=noise))
    return np.sqrt(np.trace(error.covariance(w.puncture.q_insertion[None])[0, :3, :3]))


@pytest.mark.parametrize(
    ("case", "method", "keys"), [("abdomen/case.toml", "rigid", ARM), ("carton/case_m.toml", "weighted", ARM | SLICES)]
)
def test_the_choice_of_touches_leaves_least(case, method, keys):
    w = world(case, method, declared(**keys))
    there = apply(w.puncture.T_base_ct, w.puncture.points_ct)
    q = choose_touches(w.error, there, w.puncture.q_insertion)
    like = world(case, method, declared(**keys), touch_like_insertion=True).puncture.q_touch
    chosen, alike, apart = (tip_rms(w, touches) for touches in (q, like, w.puncture.q_touch))
    assert chosen <= alike + 1e-9
    assert chosen < 0.7 * apart
    T = flange_pose(w.error.model, q)
    np.testing.assert_allclose(T[:, :3, 3] + w.error.tip_mm * T[:, :3, 2], there, atol=1e-6)


def test_without_an_arm_s_errors_any_touch_will_do():
    w = world("abdomen/case.toml", "rigid", declared(**NO_ARM))
    there = apply(w.puncture.T_base_ct, w.puncture.points_ct)
    q = choose_touches(w.error, there, w.puncture.q_insertion)
    assert tip_rms(w, q) == pytest.approx(tip_rms(w, w.puncture.q_touch))


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
