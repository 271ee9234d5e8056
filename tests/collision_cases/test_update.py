"""Rewriting expected numbers: the file says what was found, and nothing else in it changes."""

import tomllib
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal

import pytest
from hypothesis import given, strategies as st
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.collision_cases.checks_file import line_of, table_lines
from puncture_twin.planning.collision_cases.session import Change, NewNumber, rewrite

pytest_plugins = ["pytester"]
CARTON = folder() / "carton" / "case_m.toml"
FILE = f"""\
# What holds of the carton.
case = "{CARTON}"   # five lesions

[[check]]
name = "straight"
theta_deg = 0
beta_deg   = 0   # odd spaces
verdict = "safe"
clearance_mm = {{ bolt_h = 5.100, bolt_l = 27.84 }} # measured on Monday
min_clearance_mm = 6
tolerance_mm = 0.02
why = \"\"\"
[[check]]
is no table here\"\"\"

[[check]]
theta_deg = 0
beta_deg = 0
verdict = "rejected"
clearance_mm = {{ bolt_h = 5.2 }}
"""


@pytest.mark.usefixtures("kernels_loaded")
def test_numbers_are_rewritten_and_verdicts_never(pytester):
    """Afterwards the first check passes, the second fails as before, and the file differs in two numbers."""
    file = pytester.path / "some.collision.toml"
    file.write_text(FILE)
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:xdist", "--collision-update")
    result.assert_outcomes(passed=1, failed=1)
    lines = ["verdict: expected 'rejected', found 'safe'", "--collision-update rewrites only numbers*"]
    lines.append("some.collision.toml: straight: clearance_mm.bolt_h 5.100 -> 5.000")
    result.stdout.fnmatch_lines([*lines, "some.collision.toml: straight: min_clearance_mm 6 -> * (a weaker demand)"])
    text = file.read_text()
    weaker = tomllib.loads(text)["check"][0]["min_clearance_mm"]
    assert 4.99 < weaker <= 5.0001
    assert text == FILE.replace("5.100", "5.000").replace("= 6", f"= {weaker:g}")
    again = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:xdist")
    again.assert_outcomes(passed=1, failed=1)
    assert file.read_text() == text


CHANGE = Change("check", 0, "straight", NewNumber(("clearance_mm", "bolt_h"), 4.0, 0.01))


def test_a_file_that_changed_meanwhile_is_left_alone(tmp_path):
    file = tmp_path / "some.collision.toml"
    file.write_text(FILE + "# edited\n")
    with refused("input_changed"):
        rewrite(file, FILE.encode(), [CHANGE])
    assert file.read_text() == FILE + "# edited\n"


@pytest.mark.parametrize(
    ("text", "old", "new"),
    [
        ("[[check]]\nclearance_mm.bolt_h = {} # a\n", "5", "4"),
        ("[[check]]\r\n[check.clearance_mm]\r\n bolt_h={}\r\n", "5.00", "4.00"),
        ("check = [{{ clearance_mm = {{bolt_h={}}} }}]", "5e0", "4"),
    ],
)
def test_every_way_of_writing_a_table_stays(tmp_path, text, old, new):
    """Dotted keys, sub-tables with Windows' line ends, tables on one line."""
    file, data = tmp_path / "some.collision.toml", text.format(old).encode()
    file.write_bytes(data)
    rewrite(file, data, [CHANGE])
    assert file.read_bytes() == text.format(new).encode()


@pytest.mark.usefixtures("kernels_loaded")
def test_two_processes_do_not_rewrite_one_file(pytester):
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-n", "2", "--collision-update")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*run it in one process, without -n*"])


NUMBERS = st.floats(-1e4, 1e4, allow_nan=False)


@given(NUMBERS, st.sampled_from([1.0, 0.01, 1e-3, 1e-9]), st.sampled_from(["5", "5.000", "-1e-3"]))
def test_what_is_written_is_near_and_on_the_right_side(value, within, old):
    """A least value is never above what was found, a largest one never below; both within what is asked."""
    ways = (), (ROUND_FLOOR,), (ROUND_CEILING,)
    near, least, most = (Decimal(NewNumber(("x",), value, within, *way).written(old)) for way in ways)
    exact = Decimal(repr(value))  # as it is read; a difference of floats rounds, above 1e-9 by 4e-13 at 4096
    assert least <= exact <= most
    assert max(abs(near - exact), exact - least, most - exact) <= Decimal(repr(within))


TEXT = '''case = "x" # [[check]]
[[check]]
why = """
[[check]]
\\""" [[check]]
"""
  [[ check ]] # two
theta_deg = 1
note = "# [[check]]"
[[window]]
theta_deg = 2
[[check]]
why = \'\'\'
[[check]]\'\'\'
'''


def test_only_heads_of_tables_count():
    """Not what stands in strings and comments; as many as TOML's own reader finds."""
    assert table_lines(TEXT, "check") == [2, 7, 12]
    assert len(tomllib.loads(TEXT)["check"]) == 3
    assert table_lines(TEXT, "window") == [10]


@pytest.mark.parametrize(
    ("place", "line"),
    [
        (("check", 1, "theta_deg"), 8),
        (("check", 1, "verdict"), 7),
        (("check", 0), 2),
        (("window", 0, "theta_deg"), 11),
        (("check", 3), None),
        (("case",), 1),
        ((), None),
    ],
)
def test_a_place_has_the_line_of_its_key_or_of_its_table(place, line):
    assert line_of(TEXT, place) == line
