"""An arm of the e-Series from the case to a checked plan."""

import numpy as np

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.plan.plan_check import check_plan
from puncture_twin.planning.plan.planner import make_plan
from puncture_twin.planning.search.context import prepare


def test_a_ur3e_plans_to_the_abdomens_lesion(tmp_path):
    """Search, reach and approach with its own shapes; the plan is checked as a loaded one, and home is free."""
    for file in (folder() / "abdomen").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    touch = (tmp_path / "touch.csv").read_text(encoding="utf-8").splitlines()
    named = [",".join(line.split(",")[:4]) for line in touch]  # the joints of each touch are those of a UR3
    (tmp_path / "touch.csv").write_text("\n".join(named) + "\n", encoding="utf-8")
    case = tmp_path / "case.toml"
    text = case.read_text(encoding="utf-8").replace('model = "ur3"', 'model = "ur3e"\ninsertion_speed_mm_s = 40.0')
    case.write_text(text.replace("step_deg = 2.0", "step_deg = 15.0"), encoding="utf-8")
    context = prepare(case)
    plan = make_plan(context, context.search(), seed=1).plan
    assert plan.model.name == "ur3e" and check_plan(plan, context, tmp_path / "plan.json").safe.all()
    assert context.reach is not None
    checker = context.reach.checker
    assert checker.model is ur_model("ur3e")
    for q in (plan.approach.q[0], *plan.approach.q[:: max(1, len(plan.approach.q) // 20)]):
        assert CellChecker.contact(checker, np.asarray(q), needle_may_touch_patient=False) is None
