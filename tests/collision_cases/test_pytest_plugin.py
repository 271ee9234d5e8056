"""Collision cases as pytest cases: collected, judged, and explained when they fail."""

import shutil
import subprocess
import sys

import pytest
from places import ROOT

from puncture_twin.meshes import folder

pytest_plugins = ["pytester"]
pytestmark = pytest.mark.usefixtures("kernels_loaded")

CARTON = folder() / "carton" / "case_m.toml"
GOOD = f"""
case = "{CARTON}"
[[check]]
theta_deg = 0
beta_deg = 0
verdict = "safe"
clearance_mm = {{ bolt_h = 5.0 }}
tolerance_mm = 0.02
"""


def run(pytester, text):
    """Write one file of checks and run pytest on it."""
    pytester.path.joinpath("some.collision.toml").write_text(text)
    return pytester.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:xdist")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('verdict = "safe"', 'verdict = "rejected"', "*verdict: expected 'rejected', found 'safe'*"),
        ("bolt_h = 5.0", "bolt_h = 5.1", "*clearance of bolt_h: expected 5.1*found 5.0*"),
        ("bolt_h = 5.0", "bolt_x = 5.0", "*clearance of 'bolt_x': no such structure; available: bolt_l*"),
        ('verdict = "safe"', 'verdict = "safe"\nreason = "too_close"', "*reason: expected 'too_close', found ''*"),
        ('verdict = "safe"', 'verdict = "safe"\nstructure = "bolt_l"', "*structure: expected 'bolt_l', found ''*"),
    ],
)
def test_a_failing_check_prints_the_nearest_structures(pytester, old, new, message):
    """What differs comes first, then verdict and structures, then the command that shows all."""
    result = run(pytester, GOOD.replace(old, new))
    result.assert_outcomes(failed=1)
    explained = ["*theta 0 deg, beta 0 deg: safe*", "*bolt_h*avoid*"]
    result.stdout.fnmatch_lines([message, *explained, "full explanation: run-twin check *case_m.toml*--all"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[check]", "*some.collision.toml: is not TOML*line 1*"),
        (GOOD.replace("theta_deg", "theta"), "*toml:3: check number 1: unknown key 'theta'; did you mean 'theta_deg'*"),
        (GOOD + GOOD[GOOD.index("[[") :].replace('"safe"', '"free"'), "*toml:12: check number 2*.verdict*"),
        (f'case = "{CARTON}"', "*the file expects nothing; it has no*"),
        (GOOD.replace(f'case = "{CARTON}"', ""), "*toml:3: no case; allowed: case = FILE*"),
        (GOOD + "tolerance = 1", "*toml:3: check number 1: unknown key 'tolerance'*"),
        (GOOD + 'name = "a::b"', "*toml:9: check number 1*.name*"),
    ],
)
def test_a_broken_file_says_what_is_allowed(pytester, text, message):
    """A file that cannot be read is an error of collection, in one line, with the line of the file."""
    result = run(pytester, text)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([message])
    result.stdout.no_fnmatch_line("*Traceback*")


@pytest.fixture
def carton_without_base(tmp_path):
    """The carton, in a case that does not say where the robot's base is."""
    shutil.copytree(CARTON.parent, tmp_path / "carton")
    case = tmp_path / "carton" / "case_m.toml"
    text = case.read_text()
    case.write_text(text[: text.index("[registration]")] + text[text.index("[robot]") :])
    return case


def test_a_check_of_the_arm_fails_where_the_case_does_not_say_where_it_is(pytester, carton_without_base):
    """``arm = true`` never passes without an arm: the check fails with one line."""
    text = GOOD.replace(str(CARTON), str(carton_without_base))
    run(pytester, text).assert_outcomes(passed=1)
    result = run(pytester, text.replace("[[check]]", "[[check]]\narm = true"))
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*the case does not state where the robot's base is*"])


def test_a_run_without_an_arm_says_so_though_it_is_green(pytester, carton_without_base):
    """Once for each case, with the reason; a case whose arm was checked is not mentioned."""
    check = GOOD[GOOD.index("[[") :]
    result = run(pytester, f'{GOOD}{check}{check}case = "{carton_without_base}"')
    result.assert_outcomes(passed=3)
    because = "the case does not state where the robot's base is"
    told = [f"{CARTON}: arm not checked: switched off (--no-arm) (2 tests)"]
    told.append(f"{carton_without_base}: arm not checked: {because} (1 test)")
    result.stdout.fnmatch_lines([f"*{line}" for line in told])


def test_the_fixture_judges_in_python(collision_check):
    """The same in Python: returns the explanation, raises what differs."""
    found = collision_check(CARTON, theta_deg=0, beta_deg=0, verdict="safe")
    assert found.clearances()["bolt_h"] == pytest.approx(5, abs=0.02)
    with pytest.raises(AssertionError, match=r"(?s)expected 'rejected'.*bolt_h"):
        collision_check(CARTON, theta_deg=0, beta_deg=0, verdict="rejected")


WINDOW = f"""
case = "{CARTON}"
[[check]]
name = "straight in"
theta_deg = 0
beta_deg = 0
verdict = "rejected"
why = "the plan of Monday"
marks = ["thorough"]
[[window]]
theta_deg = 0
beta_deg = 0
min_square_deg = 100
[[plan]]
file = "no.json"
"""


def test_names_marks_and_reasons(pytester):
    """Tests are called by name or by what they expect, are selected by mark, and say why when they fail."""
    pytester.makeini("[pytest]\nmarkers = thorough: takes long\naddopts = --strict-markers")
    result = run(pytester, WINDOW)
    result.assert_outcomes(failed=2, passed=1)
    result.stdout.fnmatch_lines(["why: the plan of Monday"])
    result.stdout.fnmatch_lines(["*some.collision.toml::straight in*", "*some.collision.toml::plan-no.json*"])
    listed = pytester.runpytest_inprocess("-p", "no:cacheprovider", "--collect-only", "-q", "-m", "not thorough")
    listed.stdout.fnmatch_lines(["some.collision.toml::window-theta0-beta0", "some.collision.toml::plan-no.json"])
    listed.stdout.no_fnmatch_line("*straight in*")


def test_a_mark_that_nobody_registered_is_an_error_where_marks_are_strict(pytester):
    pytester.makeini("[pytest]\naddopts = --strict-markers")
    result = run(pytester, WINDOW.replace("thorough", "nightly"))
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*some.collision.toml:3: marks: 'nightly' not found in `markers`*"])


def test_loading_the_plugin_loads_nothing_heavy():
    """Every run of pytest in that environment pays for it."""
    heavy = {"numpy", "pydantic", "numba", "scipy", "trimesh", "tomlkit"}
    code = "import sys, puncture_twin.planning.collision_cases.pytest_plugin\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    assert "puncture_twin.planning.collision_cases.pytest_plugin" in done.stdout.split()
    assert heavy.isdisjoint(done.stdout.split())


def test_a_users_own_package_named_planning_is_theirs(pytester):
    """It is imported by their tests, while the collision file beside it is checked."""
    pytester.mkpydir("planning").joinpath("own.py").write_text("ANSWER = 42\n")
    pytester.makepyfile(test_own="from planning.own import ANSWER\n\ndef test_own():\n    assert ANSWER == 42\n")
    pytester.path.joinpath("some.collision.toml").write_text(GOOD)
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", "-p", "no:xdist")
    result.assert_outcomes(passed=2)
