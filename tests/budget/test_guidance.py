"""What plan, check and rehearsal say of each way of guidance: the same numbers, of what the devices see."""

import json
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from uncertainty_world import ball

from puncture_twin import api as pt
from puncture_twin.planning.budget.guidance import Sight, check_ways, sight_of, way_chances, with_ways
from puncture_twin.planning.plan.plan_document import parse_plan, write_plan
from puncture_twin.planning.search.uncertainty_breakdown import WAY_HEAD
from puncture_twin.planning.uncertainty.guided import WAYS
from puncture_twin.planning.visibility.probe import ProbeView
from puncture_twin.twin.rehearsal.distribution import rehearse_trials
from puncture_twin.twin.report import patient
from puncture_twin.twin.report.present import Table

DEVICES = "touch_mm = 0.2\n[motion]\ntarget_sd_mm = [0.4, 0.4, 1.0]\n[stereo]\n[ultrasound]\n"


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    context = pt.prepare(ball(tmp_path_factory.mktemp("ball"), errors=DEVICES))
    return context, pt.plan(context)


def test_a_plan_says_what_the_rehearsal_predicts(planned):
    """Expected error and chance to hit of each way are those of its rooms, by the same line of sight."""
    context, plan = planned
    q, sight = plan.insertion.q[-1], sight_of(context, plan, "all")
    assert [one.way for one in plan.guidance] == list(WAYS)
    for one in plan.guidance:
        found = rehearse_trials(context, plan.outward_ct, q, 1, 0, one.way, sight)
        assert found.predicted_rms_mm == pytest.approx(one.expected_error_mm, rel=1e-9), one.way
        assert found.p_hit == pytest.approx(one.p_hit, abs=1e-9)


def test_a_plan_keeps_it_in_its_file_and_states_no_other(planned, tmp_path):
    context, plan = planned
    path = tmp_path / "plan.json"
    write_plan(plan, path)
    read = parse_plan(path.read_bytes(), path)
    assert read.guidance == plan.guidance
    check_ways(context, read, path)
    better = plan.guidance[2]._replace(p_hit=0.5)
    with refused("plan_of_another"):
        check_ways(context, replace(plan, guidance=(*plan.guidance[:2], better, *plan.guidance[3:])), path)
    document = json.loads(path.read_text())
    document["guidance"][0]["p_miss"] = 0.0
    with refused("unknown_key"):
        parse_plan(json.dumps(document).encode(), path)


def test_a_probe_without_a_place_loses_its_ways_alone(planned):
    """Ultrasound alone has no number and says why; with touches the rest goes on, and says it too."""
    context, plan = planned
    nowhere = Sight(probe=ProbeView(None, None, None, True, np.nan, {"bone": 12}))
    found = {one.way: one for one in way_chances(context, plan.outward_ct, plan.insertion.q[-1], nowhere)}
    assert np.isnan(found["us"].p_hit) and "bone" in found["us"].lost_sight
    assert found["us"].document()["p_hit"] is None
    assert found["ct"].lost_sight == "" and "bone" in found["ct+us"].lost_sight
    assert found["ct+us"].expected_error_mm <= found["ct"].expected_error_mm
    assert found["stereo"].p_hit > 0.0


def test_a_checked_direction_says_the_ways_and_why_there_is_no_window(planned):
    context, plan = planned
    explained = pt.check(context, theta_deg=plan.theta_deg, beta_deg=plan.beta_deg)
    assert [one["way"] for one in explained.summary()["guidance"]] == [one.way for one in plan.guidance]
    assert "by ct+us+tip" in explained.text()
    sight = dict(sight_of(context, plan, "all").sentences())
    assert explained.sight == sight and set(sight) == {"cameras", "probe"} and sight["probe"] in explained.text()
    q = explained.candidates.arm.q_insertion[0]  # the plan may take another configuration of the arm
    other = way_chances(context, plan.outward_ct, q, sight_of(context, plan, "all"))
    assert [(one.way, one.lost_sight) for one in explained.guidance] == [(one.way, one.lost_sight) for one in other]
    np.testing.assert_allclose([one[1:4] for one in explained.guidance], [one[1:4] for one in other], rtol=1e-6)
    bare = replace(context, case=replace(context.case, stereo=None, ultrasound=None))
    assert not {"guidance", "sight"} & set(pt.check(bare, theta_deg=plan.theta_deg, beta_deg=plan.beta_deg).summary())
    assert with_ways(bare, plan).guidance == ()
    with refused("plan_of_another"):
        check_ways(bare, plan, "plan.json")
    shallow = replace(context, case=replace(context.case, ultrasound=replace(context.case.ultrasound, depth_mm=5.0)))
    explained = pt.check(shallow, theta_deg=plan.theta_deg, beta_deg=plan.beta_deg)
    found = {one.way: one for one in explained.guidance}
    assert np.isnan(found["us"].p_hit) and "depth_mm" in explained.sight["probe"] in found["us"].lost_sight
    assert "depth_mm" in explained.text() and "not all in sight" in explained.text()
    assert found["stereo"].lost_sight == "" and explained.summary()["sight"]["cameras"].startswith("both cameras see")


def test_terminal_and_page_show_one_table(planned):
    _, plan = planned
    blind = plan.guidance[1]._replace(expected_error_mm=np.nan, p_hit=np.nan, lost_sight="behind the arm")
    shown = patient.plan(replace(plan, guidance=(plan.guidance[0], blind)), (), declared=True)
    (table,) = [block for block in shown if isinstance(block, Table) and block.head == WAY_HEAD]
    assert table.rows[0][:2] == ("ct", f"{plan.guidance[0].expected_error_mm:.2f}")
    assert table.rows[1] == ("stereo", "-", "-", "-", "behind the arm")
    bare = patient.plan(replace(plan, guidance=()), ())
    assert not [block for block in bare if isinstance(block, Table) and block.head == WAY_HEAD]
