"""Collision cases as pytest cases: collected, judged, and explained when they fail."""

import shutil

import pytest

from puncture_twin.meshes import folder
from puncture_twin.planning.search.context import prepare

pytest_plugins = ["pytester"]

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


@pytest.fixture(autouse=True, scope="module")
def kernels_loaded():
    """Run compiled code once: pytester forgets modules that it saw imported, and numba's register only once."""
    prepare(CARTON, arm=False).check(0.0, 0.0)


def run(pytester, text):
    """Write one file of checks and run pytest on it."""
    pytester.path.joinpath("some.collision.toml").write_text(text)
    return pytester.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:xdist")


def test_a_check_that_holds_passes(pytester):
    """One [[check]], one test."""
    run(pytester, GOOD).assert_outcomes(passed=1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('verdict = "safe"', 'verdict = "rejected"', "*verdict: expected 'rejected', found 'safe'*"),
        ("bolt_h = 5.0", "bolt_h = 5.1", "*clearance of bolt_h: expected 5.1*found 5.0*"),
        ("bolt_h = 5.0", "bolt_x = 5.0", "*clearance of 'bolt_x': no such structure; there are bolt_l*"),
        ('verdict = "safe"', 'verdict = "safe"\nreason = "too_close"', "*reason: expected 'too_close', found ''*"),
        ('verdict = "safe"', 'verdict = "safe"\nstructure = "bolt_l"', "*structure: expected 'bolt_l', found ''*"),
    ],
)
def test_a_failing_check_prints_what_check_prints(pytester, old, new, message):
    """What differs comes first, then the candidate in full."""
    result = run(pytester, GOOD.replace(old, new))
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [message, "*theta 0 deg, beta 0 deg: safe*", "*path length*84.00 mm*", "*bolt_h*avoid*"]
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[check]", "*some.collision.toml: is not TOML*"),
        (GOOD.replace("theta_deg", "theta"), "*unknown key 'theta'; did you mean 'theta_deg'*"),
        (GOOD.replace('"safe"', '"free"'), "*check.0.verdict*"),
        (f'case = "{CARTON}"', "*check: Field required*"),
    ],
)
def test_a_broken_file_says_what_is_allowed(pytester, text, message):
    """A file that cannot be read is an error of collection, in one line."""
    result = run(pytester, text)
    assert result.ret != 0
    result.stdout.fnmatch_lines([message])


def test_a_check_without_a_case_is_an_error(pytester):
    """No case for the file and none for the check."""
    result = run(pytester, GOOD.replace(f'case = "{CARTON}"', ""))
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*no case; allowed: case = FILE*"])


@pytest.fixture
def carton_without_base(tmp_path):
    """The carton, in a case that does not say where the robot's base is."""
    folder_ = tmp_path / "carton"
    shutil.copytree(CARTON.parent, folder_)
    text = (folder_ / "case_m.toml").read_text()
    start, end = text.index("[registration]"), text.index("[robot]")
    (folder_ / "case_m.toml").write_text(text[:start] + text[end:])
    return folder_ / "case_m.toml"


def test_a_check_of_the_arm_fails_where_the_case_does_not_say_where_it_is(pytester, carton_without_base):
    """``arm = true`` never passes without an arm: the check fails with one line."""
    text = GOOD.replace(str(CARTON), str(carton_without_base))
    run(pytester, text).assert_outcomes(passed=1)
    result = run(pytester, text.replace("[[check]]", "[[check]]\narm = true"))
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*the arm is to be checked, but the case does not say where the robot's base is*"])


def test_the_fixture_judges_in_python(collision_check):
    """The same in Python: returns the explanation, raises what differs."""
    found = collision_check(CARTON, theta_deg=0, beta_deg=0, verdict="safe")
    assert found.clearances()["bolt_h"] == pytest.approx(5, abs=0.02)
    with pytest.raises(AssertionError, match=r"(?s)expected 'rejected'.*bolt_h"):
        collision_check(CARTON, theta_deg=0, beta_deg=0, verdict="rejected")
