"""Two paths side by side: each side is what `check` says of it, whichever way it was chosen."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from uncertainty_world import ball

from puncture_twin.planning.plan.plan_document import write_plan
from puncture_twin.planning.plan.planner import make_plan
from puncture_twin.planning.search.candidates import find_windows
from puncture_twin.planning.search.choice import Choice
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.choosing.compare_job import BEST_OF_ALL, compare_choices, parse_two, two_plans
from puncture_twin.twin.jobs.exit_codes import ANSWER_IS_NO, BAD_INPUT, OK

NONE = [], [], [], [], []


def test_each_side_is_what_check_says_of_it(context):
    """A rank and an entry typed in the case's space; distance and angle between them by hand."""
    found = context.search()
    first, second = found.ranked[0], found.ranked[-1]
    typed = ",".join(f"{mm:.9f}" for mm in found.path.entry_ct[second] * [-1, -1, 1])
    done = compare_choices(context, parse_two([], [], [1], [], [typed]))
    for side, row in ((done.a, first), (done.b, second)):
        alone = context.explain(found.theta[row], found.beta[row]).summary()
        told = side.summary()["check"]
        np.testing.assert_allclose(told["entry_mm"], alone["entry_mm"], atol=1e-6)
        assert told["clearance_mm"] == pytest.approx(alone["clearance_mm"], abs=1e-6)
        assert told["verdict"] == alone["verdict"]
    assert done.a.grid["rank"] == 1 and done.b.grid["window"] is not None
    cosine = float(found.outward_ct[first] @ found.outward_ct[second])
    assert done.apart_deg == pytest.approx(np.degrees(np.arccos(cosine)), abs=1e-4)
    apart = np.linalg.norm(found.path.entry_ct[first] - found.path.entry_ct[second])
    assert done.entries_apart_mm == pytest.approx(apart, abs=1e-6)
    windows = find_windows(found)
    assert done.a.summary()["search"]["window_square_deg"] == windows.windows[0].square_deg


def test_a_rejected_side_is_said_with_its_reason_and_exit_code_1(context, run, capfd):
    found = context.search()
    row = int(np.flatnonzero(~found.safe)[0])
    at = found.at(row)
    arguments = ["--theta", str(at["theta_deg"]), "--beta", str(at["beta_deg"]), "--no-arm"]
    assert main(["compare", str(context.case.path), *arguments]) == ANSWER_IS_NO
    text = capfd.readouterr().out
    assert f"B is rejected: {found.verdict.reason[row]}" in text
    assert "rank 1" in text and "safe for the organs" in text
    code, told = run("compare", context.case.path, "--rank", 1, "--rank", 2, "--no-arm")
    assert code == OK and [told[side]["search"]["rank"] for side in "ab"] == [1, 2]
    assert told["b"]["plan"] is None and told["inputs"]


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (NONE, "wrong_count"),
        (([1.0], [], [], [], []), "one_angle"),
        (([], [], [1, 2, 3], [], []), "wrong_count"),
        (([1.0], [2.0], [1], [1], []), "wrong_count"),
    ],
)
def test_other_than_one_or_two_choices_are_refused(stated, said):
    with refused(said):
        parse_two(*stated)
    assert parse_two([], [], [], [3], [])[0] == BEST_OF_ALL


def test_a_plan_and_a_case_are_not_mixed(tmp_path):
    plan, case = tmp_path / "plan.json", tmp_path / "case.toml"
    for arguments in ((plan, None, None, False), (plan, case, None, False), (plan, plan, None, True)):
        with refused("conflicting_options"):
            two_plans(*arguments)
    assert two_plans(case, None, None, True) is None
    assert two_plans(plan, plan, None, False) == (plan, plan)


def test_two_plans_by_what_they_state_and_with_their_case_by_what_holds(tmp_path, run, capfd):
    """Chances are those of the plans' own configurations; a plan that holds no more is refused."""
    case = ball(tmp_path, errors="touch_mm = 0.2")
    context = prepare(case)
    search, names = context.search(), [tmp_path / "a.json", tmp_path / "b.json"]
    plans = [make_plan(context, search, Choice(rank=k)).plan for k in (1, 2)]
    for plan, name in zip(plans, names, strict=True):
        write_plan(plan, name)
    paths = [str(name) for name in names]
    code, told = run("compare", *paths)
    assert code == OK and told["a"]["check"] is None
    assert [told[side]["plan"]["theta_deg"] for side in "ab"] == [np.degrees(plan.theta) for plan in plans]
    assert main(["compare", *paths]) == OK
    shown = capfd.readouterr().out
    assert "--case CASE checks them again" in shown and "different files" not in shown
    changed = [replace(one, sha256="0" * 64) if one.role == "markers_ct" else one for one in plans[1].inputs]
    write_plan(replace(plans[1], inputs=tuple(changed)), tmp_path / "other.json")
    assert main(["compare", paths[0], str(tmp_path / "other.json")]) == OK
    assert "made from different files (markers_ct): are they of one case?" in capfd.readouterr().out
    code, told = run("compare", *paths, "--case", case)
    assert code == OK
    for side, plan in zip("ab", plans, strict=True):
        breakdown = context.breakdown_at(plan.outward_ct, plan.insertion.q[-1])
        assert told[side]["check"]["chances"]["p_hit"] == pytest.approx(breakdown.p_hit, abs=1e-9)
    case.write_text(case.read_text() + "\n# other\n")
    assert main(["compare", *paths, "--case", str(case)]) == BAD_INPUT
