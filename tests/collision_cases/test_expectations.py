"""Least clearance, chance to touch, windows, plans: each passes where it is so and fails in a few lines where not."""

import re
import shutil

import numpy as np
import pytest
from case_world import coarse_carton

from puncture_twin.meshes import folder
from puncture_twin.planning.collision_cases.checks_file import CheckSection, WindowSection
from puncture_twin.planning.collision_cases.collector import (
    direction_finding,
    plan_finding,
    unique_names,
    window_finding,
)
from puncture_twin.planning.collision_cases.session import MOST_LINES
from puncture_twin.planning.plan.plan_document import write_plan
from puncture_twin.planning.plan.planner import make_plan
from puncture_twin.planning.search.candidates import find_windows
from puncture_twin.planning.search.context import prepare


@pytest.fixture(scope="module")
def carton(tmp_path_factory):
    """The carton with a grid of 12°, and its search."""
    context = prepare(coarse_carton(tmp_path_factory.mktemp("carton") / "carton"))
    return context, context.search()


def check(explained, **keys):
    """The lines of a check's finding; "" where it holds."""
    at = {"theta_deg": explained.candidates.at(0)["theta_deg"], "beta_deg": explained.candidates.at(0)["beta_deg"]}
    section = CheckSection(**at, verdict=explained.verdict, **keys)
    return "\n".join(one.line for one in direction_finding(section, explained).differences)


@pytest.mark.parametrize("mm", [1e9, 10.1])
def test_a_tolerance_that_checks_nothing_is_refused(mm):
    """A clearance may be off by 10 mm at most."""
    stated = {"theta_deg": 0.0, "beta_deg": 0.0, "verdict": "safe", "clearance_mm": {"liver": 3.0}}
    assert CheckSection(**stated, tolerance_mm=10.0).tolerance_mm == 10.0
    with pytest.raises(ValueError, match="less than or equal to 10"):
        CheckSection(**stated, tolerance_mm=mm)


def test_least_clearance_is_of_what_demands_a_margin(carton):
    """The target's own clearance, -1 mm, does not count."""
    context, _ = carton
    found = context.explain(0.0, 0.0)
    demanding = {s.name for s in context.anatomy.checked if s.demands_margin}
    least = min(mm for name, mm in found.clearances().items() if name in demanding)
    assert check(found, min_clearance_mm=least - 0.001) == ""
    assert f"found {least:.4f} mm, bolt_h" in check(found, min_clearance_mm=least + 0.001)


def test_the_chance_to_touch_is_that_of_the_search(carton):
    """The limit itself passes, less fails; without arm or [errors] nothing is known, and that fails."""
    context, search = carton
    row = search.ranked[0]
    found = context.explain(search.theta[row], search.beta[row])
    chance = float(found.candidates.chances.touch_any[0])
    assert 0 < chance < 1
    assert check(found, max_touch=chance) == ""
    assert "max_touch: expected at most" in check(found, max_touch=chance / 2)
    organs = prepare(context.case.path, arm=False).explain(search.theta[row], search.beta[row])
    assert "not known; it needs arm = true" in check(organs, max_touch=1.0)


def test_a_case_without_errors_has_no_chance_to_touch(tmp_path):
    """It fails, and says what is missing."""
    shutil.copytree(folder() / "carton", tmp_path / "carton")
    case = tmp_path / "carton" / "case_m.toml"
    case.write_text(re.sub(r"(?ms)^\[errors\].*?(?=^\[robot\])", "", case.read_text()))
    found = prepare(case, arm=False).explain(0.0, 0.0)
    assert found.case.errors is None
    assert "declares no [errors]" in check(found, max_touch=1.0)


def window(carton, theta, beta, least):
    """What differs of the window that holds a direction (degrees)."""
    context, search = carton
    section = WindowSection(theta_deg=theta, beta_deg=beta, min_square_deg=least)
    finding = window_finding(section, context.check(*np.radians([theta, beta])), search)
    return "\n".join(one.line for one in finding.differences)


def test_a_window_has_the_area_that_the_search_lists(carton):
    """Of the window of its nearest direction; a little more is too much. A rejected direction is in none."""
    _, search = carton
    first = find_windows(search).windows[0]
    at = search.at(first.best)
    angles = at["theta_deg"] + 0.01, at["beta_deg"]
    assert window(carton, *angles, first.square_deg - 0.1) == ""
    assert f"its window 1: expected at least {first.square_deg + 1:g}" in window(carton, *angles, first.square_deg + 1)
    assert "the direction is rejected: unreachable" in window(carton, 0, 0, 1)


def test_a_plan_holds_until_its_case_changes(carton, tmp_path):
    """The same plan, held against a case whose bytes changed, fails with the reason."""
    context, search = carton
    plan = make_plan(context, search, seed=1).plan
    write_plan(plan, tmp_path / "plan.json")
    assert plan_finding(tmp_path / "plan.json", context).differences == ()
    shutil.copytree(context.case.folder, tmp_path / "other")
    case = tmp_path / "other" / "case_m.toml"
    case.write_text(case.read_text() + "\n# one byte more\n")
    found = plan_finding(tmp_path / "plan.json", prepare(case))
    assert "the plan is not valid any more: " in found.differences[0].line
    assert "no such file" in plan_finding(tmp_path / "no.json", context).differences[0].line


def test_a_failure_is_at_most_fifteen_lines_and_ends_with_what_shows_more(carton):
    """However much differs, and the nearest structures are still there."""
    context, _ = carton
    found = context.explain(0.0, 0.0)
    many = {f"no_{number}": 1.0 for number in range(30)}
    section = CheckSection(theta_deg=0, beta_deg=0, verdict="safe", clearance_mm=many)
    lines = direction_finding(section, found).text("a\nlong reason " * 100).splitlines()
    assert len(lines) <= MOST_LINES
    assert max(map(len, lines)) <= 300
    assert any("bolt_m" in line for line in lines)
    assert any("more that differ" in line for line in lines)
    assert lines[-1].startswith("full explanation: run-twin check ")


def test_names_stay_when_others_are_added():
    """The same wish gets the next free number; no two are equal."""
    assert unique_names(["a", "b", "a", "a-2", "a"]) == ["a", "b", "a-2", "a-2-2", "a-3"]
    before = ["theta0-beta0-safe", "theta1-beta0-safe"]
    assert unique_names(["new", *before])[1:] == unique_names(before)
