"""The tip from poses that share its place: found exactly, with the spread and the residual that the noise leaves."""

import numpy as np
import pytest
from places import ROOT
from refusals import refused
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import ErringArm, flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.points import NamedPoints, write_points
from puncture_twin.twin.guidance.ct.pivot import check_one_place, pivot_calibration
from puncture_twin.twin.jobs.experiment.pivot_job import PivotRun, pivot_case, pivot_text

TIP = np.array([1.5, -0.8, 210.0])
PLACE = np.array([350.0, 60.0, 40.0])
CARTON = load_case(ROOT / "meshes" / "carton" / "case_m.toml")


def poses(count, tilt_deg, noise_mm, rng):
    """Flanges that put the tip on its place but for a touch's noise, tilted to all sides, at any roll."""
    tilt, side = np.radians(tilt_deg) * np.sqrt(rng.uniform(0.3, 1, count)), rng.uniform(0, 2 * np.pi, count)
    lean = tilt[:, None] * np.column_stack([np.cos(side), np.sin(side), np.zeros(count)])
    roll = Rotation.from_rotvec(np.column_stack([np.zeros((count, 2)), rng.uniform(-1, 1, count)]))
    R = (Rotation.from_rotvec(lean) * Rotation.from_rotvec([np.pi, 0, 0]) * roll).as_matrix()
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, PLACE + rng.normal(0, noise_mm, (count, 3)) - R @ TIP
    return T


def test_without_noise_the_tip_is_found():
    """And its place."""
    found = pivot_calibration(poses(5, 45, 0.0, np.random.default_rng(0)), 0.1)
    np.testing.assert_allclose(found.tip_flange, TIP, atol=1e-9)
    np.testing.assert_allclose(found.place_base, PLACE, atol=1e-9)
    assert found.residual_mm < 1e-9 and not found.large


def test_eight_poses_find_it_within_two_tenths():
    """Touch noise .1 mm, tilts up to 45 degrees: rms over many calibrations, as the covariance says."""
    rng = np.random.default_rng(1)
    found = [pivot_calibration(poses(8, 45, 0.1, rng), 0.1) for _ in range(400)]
    errors = np.array([one.tip_flange - TIP for one in found])
    rms = np.sqrt(np.mean(np.sum(errors**2, axis=1)))
    assert rms < 0.2
    assert rms == pytest.approx(np.sqrt(np.mean([np.trace(one.cov_tip) for one in found])), rel=0.1)


@pytest.mark.parametrize("count", [4, 8, 20])
def test_the_residual_is_what_the_noise_leaves(count):
    """residual^2 = noise^2 (3 n - 6) / n, within 10 %, over many calibrations."""
    rng = np.random.default_rng(count)
    found, left = [pivot_calibration(poses(count, 45, 0.1, rng), 0.1) for _ in range(400)], (3 * count - 6) / count
    assert np.mean([one.residual_mm**2 for one in found]) == pytest.approx(0.1**2 * left, rel=0.1)
    assert found[0].expected_mm == pytest.approx(0.1 * np.sqrt(left))


def test_an_arms_own_errors_are_noticed():
    """Links .3 mm, twists .05 and zeros .05 degrees off: the residual is far above touch noise, and flagged."""
    rng, model = np.random.default_rng(3), ur_model("ur3")
    wanted = poses(20, 30, 0.02, rng)
    q = inverse(model, wanted)
    keep = ~np.isnan(q[:, 0]).any(axis=1)
    q, d = q[keep, 0], np.array(model.d)
    true = ErringArm(np.array(model.a) + rng.normal(0, 0.3, 6), d, np.array(model.alpha) + 1e-3, np.full(6, 1e-3))
    flange = true.link_poses(q)[:, 6]
    nominal = flange_pose(model, q)
    nominal[:, :3, 3] -= (flange @ np.append(TIP, 1.0))[:, :3] - PLACE  # the true tip is held on its place
    found = pivot_calibration(nominal, 0.02)
    assert found.large and found.residual_mm > 2 * found.expected_mm


def test_poses_that_leave_the_tip_free_are_refused():
    """Too few, or all alike."""
    for count, tilt_deg, said in ((2, 45, "too_few_poses"), (8, 0.5, "poses_too_alike")):
        with refused(said):
            pivot_calibration(poses(count, tilt_deg, 0.0, np.random.default_rng(0)), 0.1)


def test_the_command_reads_a_list_of_touches(tmp_path):
    """Of the embedded carton: needle of 401 mm, touches of one place at several tilts."""
    model, rng = ur_model("ur3"), np.random.default_rng(4)
    at = np.array([420.0, -290.0, 530.0])
    R = (Rotation.from_rotvec(rng.normal(0, 0.25, (30, 3)))).as_matrix()
    T = np.tile(np.eye(4), (30, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, at - 401.0 * R[:, :, 2]
    q = inverse(model, T).reshape(-1, 6)
    q = q[~np.isnan(q).any(axis=1)][:12]
    names = tuple(f"P{number}" for number in range(len(q)))
    write_points(tmp_path / "pivot.csv", NamedPoints(names, np.tile(at, (len(q), 1)), None, joints=q))
    run = pivot_case(CARTON, tmp_path / "pivot.csv")
    np.testing.assert_allclose(run.pivot.tip_flange, [0.0, 0.0, 401.0], atol=1e-3)
    assert "+0.000 mm" in pivot_text(run) or "-0.000 mm" in pivot_text(run)
    assert run.summary()["poses"] == len(q)
    (tmp_path / "bare.csv").write_text("name,x_mm,y_mm,z_mm\nA,0,0,0\n")
    with refused("missing_column"):
        pivot_case(CARTON, tmp_path / "bare.csv")


def test_touches_of_several_places_are_named(tmp_path):
    """What `touch` writes of three markers is no pivot: said by names and distance, whatever the tilts."""
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.3, 0, 0], [0, 0.3, 0], [-0.3, 0.2, 0]]).as_matrix()
    at = np.array([420.0, -290.0, 530.0]) + [[0, 0, 0], [0, 60, 0], [0, 0, 0], [0, 0, 0]]
    T[:, :3, 3] = at - 401.0 * T[:, :3, 2]
    q = np.array([rows[~np.isnan(rows).any(axis=1)][0] for rows in inverse(ur_model("ur3"), T)])
    write_points(tmp_path / "touch.csv", NamedPoints(("A", "B", "C", "D"), at, None, joints=q))
    with refused("touches_apart", "60"):
        pivot_case(CARTON, tmp_path / "touch.csv")


@pytest.mark.parametrize("off_mm", [[0.0, 0.0, 45.0], [30.0, -30.0, 0.0]])
def test_a_tip_that_is_far_off_is_still_one_place(off_mm):
    """Another needle than the case states: its touches lie centimetres apart by the stated length."""
    rng = np.random.default_rng(8)
    T = poses(12, 45, 0.3, rng)
    stated = T[:, :3, 3] + (T[:, :3, :3] @ (TIP - off_mm))
    check_one_place([f"P{row}" for row in range(12)], stated, T[:, :3, :3], where="pivot")


def test_one_touch_that_slipped_is_named():
    """It misses by more than twice what the others do; where all miss alike the arm is named."""
    T = poses(10, 45, 0.02, np.random.default_rng(5))
    T[3, :3, 3] += [0.0, 4.0, 0.0]
    names = tuple(f"P{row}" for row in range(10))
    slipped = pivot_text(PivotRun(CARTON, pivot_calibration(T, 0.02), names, ()))
    assert "P3 misses by" in slipped and "the tip slipped there" in slipped
    all_off = pivot_calibration(poses(10, 45, 0.5, np.random.default_rng(6)), 0.02)
    alike = pivot_text(PivotRun(CARTON, all_off, names, ()))
    assert "all touches alike: arm errors larger than declared" in alike
