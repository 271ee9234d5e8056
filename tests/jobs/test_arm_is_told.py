"""A result that asked no arm says so wherever it is read: terminal, JSON, page; pytest is in tests/collision_cases."""

import numpy as np
import pytest
from case_world import coarse_carton

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK

NOT_CHECKED = "not checked: the case does not state where the robot's base is"
NAMED = "the case states a robot (ur3) but not the position of its base: the arm is not checked"


@pytest.fixture(scope="module")
def nowhere(tmp_path_factory):
    """The carton, coarse, which names a robot and does not say where its base is."""
    case = coarse_carton(tmp_path_factory.mktemp("nowhere") / "carton", 20.0)
    text = case.read_text()
    start, end = text.index("[registration]"), text.index("[robot]")
    case.write_text(text[:start] + text[end:])
    return case


def test_terminal_and_page_say_that_no_arm_was_checked(nowhere, tmp_path, capfd):
    assert main(["search", str(nowhere), "--out", str(tmp_path)]) == OK
    told, page = capfd.readouterr().out, (tmp_path / "report.html").read_text()
    assert f"arm {NOT_CHECKED}" in told and f"warning: {NAMED}" in told
    assert "safe for the organs" in told and "safe for the organs" in page
    for words in ("the case does not state where the robot", NAMED):
        assert words.replace("'", "&#39;") in page


@pytest.mark.parametrize("switch", [[], ["--no-arm"]])
def test_check_says_so_too(nowhere, switch, run, capfd):
    """Verdict and arm stand beside each other in JSON; in text nothing reads "safe" alone."""
    candidate = ["check", str(nowhere), "--theta", "0", "--beta", "0", *switch]
    code, found = run(*candidate)
    assert code == OK
    assert (found["verdict"], found["arm"], found["reachable"]) == ("safe", NOT_CHECKED, None)
    assert switch or any(NAMED in warning for warning in found["warnings"])
    assert main(candidate) == OK
    said = capfd.readouterr().out
    assert "theta 0 deg, beta 0 deg: safe for the organs\n" in said and f"arm {NOT_CHECKED}" in said


def test_both_ends_of_the_needle_are_told_in_the_robots_axes():
    """The tip is where the registration puts the target, the flange on the direction's line, a needle's length off."""
    context = pt.prepare(folder() / "abdomen")
    explained = pt.check(context, 64, 98)
    there, T = explained.summary()["at_target"], context.placement.T_base_ct
    np.testing.assert_allclose(there["tip_base_mm"], apply(T, context.case.target_ct), atol=1e-3)
    away = T[:3, :3] @ explained.candidates.outward_ct[0] * context.case.needle.length_mm
    np.testing.assert_allclose(np.subtract(there["flange_base_mm"], there["tip_base_mm"]), away, atol=1e-3)
    assert "at the target      tip (" in explained.text()
    assert pt.check(pt.prepare(folder() / "abdomen", arm=False), 64, 98).summary()["at_target"] is None
