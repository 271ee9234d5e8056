"""Dynamics by least squares: PyBullet's torques, known parameters found again, what their error moves the tip by."""

import json
from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import numpy as np
import pytest
from control_world import DOWN, UR3, WithFriction, along_needle, bench, follow, impedance
from refusals import refused, refused_command
from scipy.spatial.transform import Rotation

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.arm import dynamics
from puncture_twin.planning.arm.dynamics import (
    N_PARAMETERS,
    JointMotion,
    TorqueRecording,
    base_parameters,
    condition_of,
    identify,
    joint_motion,
    read_torques,
    regressor,
)
from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS, link_poses, slowed
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.motion.exciting import PERIOD_S, exciting_motion
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK
from puncture_twin.twin.jobs.experiment.dynamics_job import tip_covariances
from puncture_twin.twin.plant.torque_recording import recording_text
from puncture_twin.twin.world.client import pybullet

CARTON = folder() / "carton" / "case_m.toml"
HOME = np.radians([0.0, -90, 0, -90, 0, 0])
STEP_S = 0.05


def pybullets_parameters(body, client):
    """phi of the loaded arm, shape (78,): every link's mass and inertia as PyBullet has them, in the frames of ours."""
    phi, moving = np.zeros(N_PARAMETERS), 0
    T_base_link = link_poses(UR3, np.zeros(6))
    for link in range(pybullet.getNumJoints(body, physicsClientId=client)):
        moving += pybullet.getJointInfo(body, link, physicsClientId=client)[2] == pybullet.JOINT_REVOLUTE
        mass, _, diagonal = pybullet.getDynamicsInfo(body, link, physicsClientId=client)[:3]
        centre, turn = pybullet.getLinkState(body, link, computeForwardKinematics=1, physicsClientId=client)[:2]
        if moving == 0:
            continue
        T = T_base_link[moving]
        c = T[:3, :3].T @ (np.array(centre) - T[:3, 3] / 1000.0)
        R = T[:3, :3].T @ Rotation.from_quat(turn).as_matrix()
        inertia = R @ np.diag(diagonal) @ R.T + mass * (c @ c * np.eye(3) - np.outer(c, c))
        phi[10 * moving - 10 : 10 * moving] += [mass, *(mass * c), *inertia[np.triu_indices(3)]]
    return phi


@pytest.fixture(scope="module")
def phi():
    with bench(DOWN) as world:
        world.arm.place(np.zeros(6))
        return pybullets_parameters(world.arm.body, world.client)


@pytest.fixture(scope="module")
def series():
    return exciting_motion(slowed(UR3, DEFAULT_SPEEDS), DOWN, HOME, lambda _: True, 1)


@pytest.mark.parametrize("down", [[0, 0, -1.0], [1.0, 0, 0], [0, 0.6, 0.8]])
def test_the_regressor_times_pybullets_parameters_is_its_torque(rng, down, phi):
    """At 50 random motions of three mounts, to a millionth of the torque."""
    motion = JointMotion(*rng.uniform(-3.0, 3.0, (3, 50, 6)))
    with bench(np.array(down)) as world:
        own = np.array([world.model.inverse_dynamics(*row) for row in zip(*motion, strict=True)])
    np.testing.assert_allclose(regressor(UR3, motion, np.array(down)) @ phi, own, atol=1e-6 * np.abs(own).max())


@pytest.mark.parametrize(("down", "count"), [([0, 0, -1.0], 52), ([1.0, 0, 0], 54)])
def test_base_parameters_are_all_that_torques_show(rng, down, count):
    """As many as the rank; of other motions too. Gravity along the first axis hides two of its link."""
    base = base_parameters(UR3, np.array(down))
    Y = regressor(UR3, JointMotion(*rng.uniform(-2.0, 2.0, (3, 80, 6))), np.array(down))
    assert np.linalg.matrix_rank(Y.reshape(-1, N_PARAMETERS)) == len(base.columns) == count
    np.testing.assert_allclose(Y[..., base.columns] @ base.K, Y, atol=1e-11)


def test_the_exciting_motion_keeps_the_limits_and_starts_and_ends_at_rest(series):
    """Well conditioned, where any one sinusoid a joint is not; its slopes are those of its angles."""
    model, columns = slowed(UR3, DEFAULT_SPEEDS), base_parameters(UR3, DOWN).columns
    times = np.linspace(0.0, PERIOD_S, 4001)
    motion = series.at(times)
    for q in motion.q[[0, -1]]:
        np.testing.assert_allclose(q, HOME, atol=1e-12)
    for rate in (*motion.speed[[0, -1]], *motion.acceleration[[0, -1]]):
        np.testing.assert_allclose(rate, 0.0, atol=1e-12)
    assert model.within_limits(motion.q).all()
    assert (np.abs(motion.speed) <= model.max_speeds).all()
    assert (np.abs(motion.acceleration) <= model.max_acceleration).all()
    assert condition_of(regressor(UR3, motion, DOWN)[..., columns]) < 30
    one = JointMotion(*(np.tile(part, (6, 1)).T for part in (np.sin(times), np.cos(times), -np.sin(times))))
    assert condition_of(regressor(UR3, one, DOWN)[..., columns]) > 1e4
    np.testing.assert_allclose(np.gradient(motion.q, times, axis=0)[1:-1], motion.speed[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(motion.speed, times, axis=0)[1:-1], motion.acceleration[1:-1], atol=1e-4)


def test_a_motion_that_touches_is_not_taken(series):
    """The next one that is free is; where none is, it is said."""
    seen = []
    other = exciting_motion(slowed(UR3, DEFAULT_SPEEDS), DOWN, HOME, lambda q: seen.append(q) or len(seen) > 1, 1)
    assert len(seen) == 2 and not np.array_equal(other.a, series.a)
    with refused("no_exciting_motion", "home_deg", by=NoAnswerError):
        exciting_motion(slowed(UR3, DEFAULT_SPEEDS), DOWN, HOME, lambda _: False, 1)


def test_quintics_give_the_motions_slopes(series):
    """Of the recorded angles alone; encoders to .001 degrees included."""
    motion = series.at(np.arange(0.0, 20.0, 0.008))
    q = np.radians(np.round(np.degrees(motion.q), 3))
    found = joint_motion(TorqueRecording(0.008, q, np.zeros_like(q)))
    assert np.abs(found.speed - motion.speed).max() < 1e-3
    assert np.abs(found.acceleration - motion.acceleration)[12:-12].max() < 2e-2


@pytest.fixture(scope="module")
def moved(series, phi):
    """A recording without noise, of PyBullet's masses with friction and drives, and its parameters."""
    phi = phi.copy()
    phi[60:] = np.concatenate([np.full(6, 0.02), np.linspace(1.0, 0.2, 6), np.linspace(3.0, 0.5, 6)])
    return recording(series, phi, STEP_S), phi


def recording(series, phi, step_s):
    q = series.at(np.arange(0.0, PERIOD_S, step_s)).q
    still = TorqueRecording(step_s, q, np.zeros_like(q))
    return still._replace(torque_nm=regressor(UR3, joint_motion(still), DOWN) @ phi)


def noisy(recorded, rng):
    sd = 0.002 * UR3.max_torques
    return recorded._replace(torque_nm=recorded.torque_nm + sd * rng.normal(size=recorded.q.shape))


def test_known_parameters_are_found_within_their_regions(series, moved, monkeypatch):
    """PyBullet's masses, friction and drives, in 300 recordings of noisy torques; without noise exactly.

    Of half as many rows as elsewhere, twenty a parameter; what follows from the motion alone is computed once.
    """
    phi = moved[1]
    recorded = recording(series, phi, 2 * STEP_S)
    exact = identify(UR3, recorded, DOWN)
    truth = exact.base.K @ phi
    np.testing.assert_allclose(exact.values, truth, atol=1e-9)
    np.testing.assert_allclose(exact.friction[..., 0], phi[66:].reshape(2, 6), atol=1e-9)
    motion = joint_motion(recorded)
    known = {"base_parameters": exact.base, "joint_motion": motion, "regressor": regressor(UR3, motion, DOWN)}
    for name, value in known.items():
        monkeypatch.setattr(dynamics, name, Mock(return_value=value))
    rng, inside, within, sizes = np.random.default_rng(1), [], [], []
    for _ in range(300):
        found = identify(UR3, noisy(recorded, rng), DOWN)
        e = found.values - truth
        inside.append(e @ np.linalg.solve(found.covariance, e) <= found.region_limit())
        within.append(np.abs(e) <= 1.96 * np.sqrt(np.diag(found.covariance)))
        sizes.append(found.torque_sd_nm)
    assert 0.92 <= np.mean(inside) <= 0.98  # of 300 its own deviation is 1.3 %
    assert 0.94 <= np.mean(within) <= 0.96
    np.testing.assert_allclose(np.mean(sizes, axis=0), 0.002 * UR3.max_torques, rtol=0.01)


def test_what_the_model_lacks_is_said_and_widens_the_deviations(moved, rng):
    """A slow ripple of a gear in joint 2: a warning, and deviations that grow."""
    recorded, _ = moved
    plain = identify(UR3, noisy(recorded, rng), DOWN)
    ripple = np.zeros((len(recorded.q), 6))
    ripple[:, 1] = 0.5 * np.sin(np.arange(len(recorded.q)) / 5.0)
    found = identify(UR3, noisy(recorded._replace(torque_nm=recorded.torque_nm + ripple), rng), DOWN)
    assert [one.code for one in found.findings()] == ["residuals_correlated"] and not plain.findings()
    assert found.correlated[1] > 0.8
    assert (found.friction[:, 1, 1] > 5.0 * plain.friction[:, 1, 1]).all()


def test_motions_that_show_nothing_and_torques_of_another_motion_are_refused(moved, rng):
    recorded, _ = moved
    q = recorded.q.copy()
    q[:, 4] = 0.3
    with refused("not_exciting", "joint 5"):
        identify(UR3, recorded._replace(q=q), DOWN)
    times = np.arange(0.0, PERIOD_S, STEP_S)
    with refused("not_exciting", "condition"):
        identify(UR3, recorded._replace(q=np.tile(np.sin(times), (6, 1)).T), DOWN)
    with refused("torques_unexplained", "torques"):
        identify(UR3, recorded._replace(torque_nm=rng.permutation(recorded.torque_nm)), DOWN)


def test_the_tip_is_off_its_path_as_the_covariance_says(moved, rng):
    """The controller of the rehearsal, its dynamics off by one draw: the simulated tip is as far off as G db."""
    recorded = moved[0]._replace(torque_nm=moved[0].torque_nm - 0.02 * joint_motion(moved[0]).acceleration)  # no drives
    case, insertion = load_case(CARTON), along_needle(60.0, 4.0, 10.0)
    found, spread = identify(UR3, recorded, DOWN), identify(UR3, noisy(recorded, rng), DOWN).covariance
    wrong = 100.0 * np.linalg.cholesky(spread) @ rng.normal(size=len(found.values))

    @cache
    def errors(reference):  # where it is to be: it is within a ten thousandth of a radian of that
        motion = JointMotion(reference.q, reference.speed, reference.acceleration)
        return regressor(UR3, motion, DOWN)[:, :, found.base.columns] @ wrong

    class Erring(WithFriction):
        def act(self, measured, reference, row):
            action = self._controller.act(measured, reference, row)
            return action + errors(reference)[row]

    with bench() as world:
        _, error_mm = follow(world, Erring(impedance(world), None), insertion, settle_s=1.5, hold_s=0.3)
    one = np.outer(wrong, wrong)
    told = np.sqrt(np.trace(tip_covariances(case, replace(found, covariance=one), insertion, DOWN), axis1=1, axis2=2))
    rows = np.arange(0, len(error_mm), 16)  # of .5 ms; a sample of the reference is 8 ms
    told = told[: len(rows)]
    assert error_mm.max() > 0.05
    assert np.abs(told - error_mm[rows]).max() < 0.06 * error_mm.max()


def test_the_command_identifies_what_it_recorded(tmp_path, capsys):
    """Friction within its deviations, the budget's row beside the others; the file is read again to the same answer."""
    path = tmp_path / "torques.csv"
    assert main(["calibrate", "dynamics", str(CARTON), "--record", str(path), "--json"]) == OK
    found = json.loads(capsys.readouterr().out)
    for joint, most in zip(found["joints"], UR3.max_torques, strict=True):
        assert abs(joint["coulomb_nm"] - 0.05 * most) < 4.5 * joint["coulomb_sd_nm"]
        assert abs(joint["viscous_nm_s"] - 0.05 * most) < 4.5 * joint["viscous_sd_nm_s"]
        assert joint["torque_sd_nm"] == pytest.approx(0.002 * most, rel=0.05)
    assert 0.0 < found["tip_end_mm"] < found["tip_path_mm"] < found["tip_path_95_mm"] < 0.01
    assert found["budget"][0] == {"text": "the identified dynamics", "alone_mm": found["tip_end_mm"]}
    assert found["expected_mm"] == pytest.approx(np.linalg.norm([one["alone_mm"] for one in found["budget"]]))
    assert main(["calibrate", "dynamics", str(CARTON), "--recording", str(path)]) == OK
    assert f"{found['tip_path_mm']:.4f} mm" in capsys.readouterr().out
    again = pt.calibrate_dynamics(pt.prepare(CARTON), path)
    assert again.summary() == found
    assert "54" in repr(again) and "base parameters" in again._repr_html_()


@pytest.mark.parametrize(
    ("edit", "code", "says"),
    [
        (lambda t: t.replace("tau6_nm", "tau7_nm"), "missing_column", "no torques"),
        (lambda t: "\n".join(t.splitlines()[:30]), "too_few_rows", "29 rows"),
        (lambda t: "\n".join([*t.splitlines()[:50], *t.splitlines()[52:]]), "times_uneven", "uneven"),
        (lambda t: t.replace("time_s", "when"), "missing_column", "time_s"),
        (lambda t: t[:-5] + "x\n", "not_a_number", "tau6_nm"),
    ],
)
def test_a_bad_recording_is_refused_in_one_line(tmp_path, moved, edit, code, says):
    recorded, _ = moved
    times = STEP_S * np.arange(len(recorded.q))
    path = tmp_path / "bad.csv"
    path.write_text(edit(recording_text(times, JointMotion(recorded.q, recorded.q, recorded.q), recorded.torque_nm)))
    with refused(code, says, path):
        read_torques(path)


def test_one_recording_is_named(capfd, tmp_path):
    refused_command(["calibrate", "dynamics", CARTON], capfd, "missing_option", "--record FILE")
    both = ["--recording", tmp_path / "a.csv", "--record", tmp_path / "b.csv"]
    refused_command(["calibrate", "dynamics", CARTON, *both], capfd, "missing_option")
    assert not (tmp_path / "b.csv").exists()
