"""The needle turned about the target from outside: never off its point, never where the planner says no."""

import dataclasses

import numpy as np
import pytest
from places import ROOT
from refusals import refused

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import uncounted
from puncture_twin.planning.case.settings import Obstacle
from puncture_twin.planning.case.tables import RehearsalSection
from puncture_twin.planning.search.choice import Choice
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.sweep.sweep_planner import plan_sweep
from puncture_twin.twin.jobs.experiment.sweep_job import parse_angles, sweep_case, sweep_text
from puncture_twin.twin.rehearsal.rehearsal import execute_sweep

CASE = ROOT / "meshes" / "carton" / "case_m.toml"
START, END = np.radians([22.0, 212.0]), np.radians([30.0, 222.0])


@pytest.fixture(scope="module")
def context():
    """Without chances, which no sweep asks for and every direction would compute."""
    return dataclasses.replace(prepare(CASE), chance=None)


@pytest.fixture(scope="module")
def plan(context):
    return plan_sweep(context, tuple(START), tuple(END), seed=1, progress=uncounted)


def test_the_plan_goes_through_every_direction_free_of_contact(context, plan):
    assert plan.stopped == ""
    np.testing.assert_allclose(plan.angles[[0, -1]], [START, END])
    T = flange_pose(plan.model, plan.sweep.q)
    assert plan.off_point_mm(T).max() < 0.01
    out_ct = -T[:, :3, 2] @ context.placement.T_base_ct[:3, :3]
    along = out_ct @ context.case.T_ct_entry[:3, :3]
    theta = np.degrees(np.arccos(along[:, 2]))
    np.testing.assert_allclose(theta[[0, -1]], np.degrees([START[0], END[0]]), atol=1e-6)
    assert (np.diff(theta) > -1e-9).all()
    for q in plan.sweep.q[:: max(1, len(plan.sweep.q) // 20)]:
        assert context.reach.checker.contact(q, needle_may_touch_patient=False) is None
        tip = flange_pose(plan.model, q)
        assert np.linalg.norm(tip[:3, 3] + plan.needle_length_mm * tip[:3, 2] - plan.point_base) == pytest.approx(
            plan.standoff_mm, abs=0.01
        )


@pytest.mark.parametrize("control", ["position", "impedance"])
def test_the_virtual_tcp_stays_on_its_point(context, plan, control):
    case = dataclasses.replace(context.case, rehearsal=RehearsalSection(control=control))
    swept = execute_sweep(plan, case, context.anatomy, context.placement.T_base_ct)
    assert swept.contacts == ()
    assert 0.0 < swept.off_mm.max() < 0.05


def test_a_sweep_stops_where_the_search_says_no(context, tmp_path):
    wanted = np.radians([22.0, 260.0])
    run = sweep_case(context, tmp_path, Choice(angles=tuple(START)), tuple(wanted))
    assert not run.whole
    assert "theta 22.0 deg" in run.plan.stopped and "stopped there" in sweep_text(run)
    passed = run.plan.angles
    assert len(passed) > 1 and not np.allclose(passed[-1], wanted)
    assert all(context.check(theta, beta).safe[0] for theta, beta in passed[[0, -1]])
    assert run.summary()["stopped"] == run.plan.stopped


def test_a_box_on_the_way_stops_the_arm(context, plan):
    """What the checker sees, the sweep does not pass: here the arm's own last pose is blocked."""
    flange = flange_pose(plan.model, plan.sweep.q[-1])[:3, 3]
    T = np.linalg.inv(context.placement.T_base_ct)
    middle = T[:3, :3] @ flange + T[:3, 3]
    box = Obstacle("lamp", "ct", middle, np.array([20.0, 20.0, 20.0]))
    case = dataclasses.replace(context.case, obstacles=(*context.case.obstacles, box))
    from puncture_twin.planning.collision.workcell import case_checker

    checker = case_checker(case, context.anatomy, context.placement.T_base_ct)
    blocked = dataclasses.replace(
        context, case=case, reach=dataclasses.replace(context.reach, own_checker=lambda: checker)
    )
    try:
        stopped = plan_sweep(blocked, tuple(START), tuple(END), seed=1, progress=uncounted)
    except NoAnswerError as error:
        assert "lamp" in str(error) or "rejected" in str(error)
    else:
        assert stopped.stopped and len(stopped.angles) < len(plan.angles)


def test_a_sweep_to_its_start_or_from_a_rejected_one_is_refused(context):
    with refused("sweep_stops", "20.0", "40.0", by=NoAnswerError):
        plan_sweep(context, tuple(np.radians([20.0, 40.0])), tuple(END), seed=1, progress=uncounted)
    with refused("no_motion"):
        plan_sweep(context, tuple(START), tuple(START), seed=1, progress=uncounted)


@pytest.mark.parametrize("text", ["20", "20,30,40", "200,10", "20,400", "a,b"])
def test_angles_are_two_numbers_in_range(text):
    with refused("not_a_number"):
        parse_angles(text)
