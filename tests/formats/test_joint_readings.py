"""Joint angles and times of files: those of a device that exists, in the unit that is stated; nothing else."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from refusals import refused

from puncture_twin.planning.arm.kinematics import check_arm, check_flanges, flange_pose
from puncture_twin.planning.arm.ur import UR_MODELS, ur_model
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.tables import RobotSection
from puncture_twin.planning.formats.points import JOINTS_RAD, joint_readings, parse_joint_recording, parse_points

START = np.array([20.0, -100.0, -95.0, -75.0, 90.0, 10.0])
POSES = START + 8.0 * np.random.default_rng(0).normal(size=(9, 6))
FILE = Path("joints.csv")
NEEDLE = np.array([0.0, 0.0, 210.0])


def written(header, rows, comma=","):
    return "\n".join([comma.join(header), *(comma.join(f"{value:.9f}" for value in row) for row in rows), ""]).encode()


def rtde(model, q):
    T = flange_pose(ur_model(model), q)
    place = T[:, :3, 3] / 1000.0
    header = ["timestamp", *(f"actual_q_{k}" for k in range(6)), *(f"actual_TCP_pose_{k}" for k in range(6))]
    return header, np.column_stack([0.008 * np.arange(len(q)), q, place, np.zeros((len(q), 3))])


@given(st.lists(st.floats(-359.0, 359.0), min_size=6, max_size=6), st.integers(1, 4))
def test_what_an_arm_can_read_passes_in_both_units(angles, rows):
    """Every pose but one that is nearly stretched out along its zero, as degrees."""
    table = np.tile(angles, (rows, 1))
    q = joint_readings(np.radians(table), "rad", where="here")
    np.testing.assert_array_equal(q, np.radians(table))
    if np.abs(table).max() > 7.0 or not table.any():
        np.testing.assert_array_equal(joint_readings(table, "deg", where="here"), q)


def test_angles_in_the_other_unit_are_refused():
    """Degrees under rad are beyond any joint; radians under deg all lie within 6.3."""
    with refused("joints_beyond"):
        joint_readings(POSES, "rad", where="here")
    with refused("joints_unit"):
        joint_readings(np.radians(POSES), "deg", where="here")
    q = np.radians(POSES)  # rows are named, and wrist 3 may turn on
    q[3, 5] = np.radians(600.0)
    joint_readings(q, "rad", where="here")
    q[4, 1] = 7.0
    with refused("joints_beyond"):
        joint_readings(q, "rad", where="here", names=tuple("abcdefghi"))
    for wrong in ([[1.0] * 5], [[1j] * 6], [["a"] * 6], [[np.nan] * 6], [[True] * 6], [1.0] * 6, [[400] * 6]):
        with pytest.raises(InputError) as caught:
            joint_readings(wrong, "deg", where="here")
        assert caught.value.code.startswith("joints")


def test_a_recording_is_read_in_every_heading():
    """Rad, deg, RTDE's; commas or spaces; other columns and comments pass; times and tool where they are there."""
    q = np.radians(POSES)
    times = 0.1 * np.arange(len(q))
    rad = parse_joint_recording(
        b"# x\n" + written(["time_s", *JOINTS_RAD], np.column_stack([times, q])), FILE, timed=True
    )
    deg = parse_joint_recording(written([f"q{k}_deg" for k in range(1, 7)], POSES), FILE, timed=False)
    with refused("missing_column"):
        parse_joint_recording(b"name,x_mm\na,1\n", FILE, timed=False)
    header, rows = rtde("ur3", q)
    for comma in (",", " "):
        own = parse_joint_recording(written(header, rows, comma), FILE, timed=True)
        np.testing.assert_allclose(own.q, q, atol=1e-8)
        np.testing.assert_allclose(own.tool_base, flange_pose(ur_model("ur3"), q)[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(rad.q, q, atol=1e-8)
    np.testing.assert_allclose(deg.q, q, atol=1e-9)
    np.testing.assert_allclose(rad.time_s, times, atol=1e-9)
    assert deg.time_s is None and deg.tool_base is None and deg.names[:2] == ("1", "2")


def test_times_that_run_backwards_are_refused():
    q = np.radians(POSES)
    times = 0.1 * np.arange(len(q))
    times[4] = times[3]
    parse_joint_recording(written(["time_s", *JOINTS_RAD], np.column_stack([times, q])), FILE, timed=True)
    times[4] = 0.25
    table = written(["time_s", *JOINTS_RAD], np.column_stack([times, q]))
    with refused("times_not_rising", "line 6"):
        parse_joint_recording(table, FILE, timed=True)


def test_times_begin_again_with_each_phase():
    """As in an exported plan, whose insertion starts when the operator says so; within a phase they rise."""
    q = np.radians(POSES)
    lines = written(["time_s", *JOINTS_RAD], np.column_stack([[0, 1, 2, 3, 0, 1, 2, 3, 4], q])).decode().split()
    phases = ["phase", *["approach"] * 4, *["insertion"] * 5]
    table = "\n".join(f"{phase},{line}" for phase, line in zip(phases, lines, strict=True))
    read = parse_joint_recording(table.encode(), FILE, timed=True)
    np.testing.assert_allclose(read.q, q, atol=1e-8)
    assert read.time_s.tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 4]
    with refused("times_not_rising", "line 6"):
        parse_joint_recording(table.replace("insertion", "approach").encode(), FILE, timed=True)


def test_a_list_of_touches_has_the_same_gate():
    header = ["name", "x_mm", "y_mm", "z_mm", *(f"q{k}_deg" for k in range(1, 7))]

    def table(angles):
        rows = [",".join([f"m{i}", "1", "2", "3", *map(str, row)]) for i, row in enumerate(angles)]
        return "\n".join([",".join(header), *rows, ""]).encode()

    np.testing.assert_allclose(parse_points(table(POSES), FILE).joints, np.radians(POSES))
    with refused("joints_unit"):
        parse_points(table(np.radians(POSES)), FILE)
    with refused("joints_beyond"):
        parse_points(table(5 * POSES), FILE)


def test_a_home_in_radians_is_refused_and_one_of_zeros_is_not():
    assert RobotSection(home_deg=tuple(START)).home_deg == tuple(START)
    assert RobotSection(home_deg=(0.0,) * 6).home_deg == (0.0,) * 6
    with pytest.raises(ValueError, match="not in degrees"):
        RobotSection(home_deg=tuple(np.radians(START)))


@pytest.mark.parametrize("tool", [np.zeros(3), NEEDLE, np.array([30.0, -12.0, 95.0])])
@pytest.mark.parametrize("recorded", UR_MODELS)
def test_joints_of_another_arm_are_named(recorded, tool):
    """Whatever the controller's tool is: the tool stays where one arm's joints put it, and moves with another's."""
    q = np.radians(POSES)
    T = flange_pose(ur_model(recorded), q)
    points = T[:, :3, 3] + T[:, :3, :3] @ tool
    for name, model in UR_MODELS.items():
        stated = {"names": [str(i) for i in range(9)], "where": "here", "any_tool": True}
        if name == recorded:
            check_arm(model, q, points, [np.zeros(3), NEEDLE], **stated)
        else:
            with refused("joints_of_another_arm", recorded):
                check_arm(model, q, points, [np.zeros(3), NEEDLE], **stated)


def test_a_controller_s_own_calibration_passes():
    """Lengths and zeros that differ as those of a calibrated arm do: 1 mm and .1 degrees."""
    rng = np.random.default_rng(3)
    model, q = ur_model("ur3"), np.radians(POSES)
    for _ in range(30):
        T = flange_pose(model, q + np.radians(rng.normal(0.0, 0.1, 6)))
        points = T[:, :3, 3] + rng.normal(0.0, 0.7, 3)
        check_arm(model, q, points, [np.zeros(3)], names=[str(i) for i in range(9)], where="here")


def test_flanges_are_held_against_their_axes_too():
    model, q = ur_model("ur3"), np.radians(POSES)
    T = flange_pose(model, q)
    check_flanges(model, q, T, names=[str(i) for i in range(9)], where="here")
    off = q.copy()
    off[:, 5] += np.radians(10.0)
    with refused("joints_of_another_arm"):
        check_flanges(model, off, T, names=[str(i) for i in range(9)], where="here")
