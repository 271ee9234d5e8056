"""Lines of tables in a TOML file."""

import tomllib

import pytest

from puncture_twin.planning.collision_cases.checks_file import line_of, table_lines

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
