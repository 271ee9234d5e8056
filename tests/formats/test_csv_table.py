"""One way to read a table: what is no row is passed over in all of them, and a line keeps its number in the file."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from refusals import refused

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.export.exporter import COLUMNS, read_csv
from puncture_twin.planning.formats.csv_table import (
    Layout,
    columns_fault,
    csv_lines,
    parse_table,
    pose_columns,
    pose_values,
    table_text,
)
from puncture_twin.planning.formats.labels.naming import names_for
from puncture_twin.planning.formats.points import parse_joint_recording, parse_points
from puncture_twin.twin.guidance.ultrasound.recording_file import LAYOUT

FILE = Path("table.csv")
POSES = Layout({letter: pose_columns(letter) for letter in "AB"}, (frozenset("A"), frozenset("B")))
"""Columns of a list of pairs of poses."""
ANGLES = ["0.1,-1.2,1.3,-1,1.5,0.2", "0.2,-1.3,1.4,-1,1.5,0.3", "0.3,-1.4,1.5,-1,1.5,0.4"]
IN_RAD = ",".join(f"q{joint}_rad" for joint in range(1, 7))


def rows_of_poses():
    A, B = np.tile(np.eye(4), (2, 3, 1, 1))
    values = np.hstack([pose_values(A), pose_values(B)]).tolist()
    header = ("name", *pose_columns("A"), *pose_columns("B"))
    return table_text(header, [[f"p{i}", *row] for i, row in enumerate(values)]).splitlines()


def points(text):
    return parse_points(text.encode(), FILE).points


def joints(text):
    return parse_joint_recording(text.encode(), FILE, timed=True).q


def poses(text):
    return parse_table(text.encode(), FILE, POSES, ("A", "B")).poses["A"]


def motion(text):
    return np.vstack([part.q for part in read_csv(text, where=FILE)])


TIMED = [f"{0.1 * row:.1f},{angles}" for row, angles in enumerate(ANGLES)]
PLAN = [f"{phase},{row}" for phase in ("approach", "insertion") for row in TIMED]
TABLES = {
    "points": (points, ["name,x_mm,y_mm,z_mm", "a,1,2,3", "b,4,5,6", "c,7,8,9"]),
    "joints": (joints, [f"time_s,{IN_RAD}", *TIMED]),
    "joints by blanks": (joints, [one.replace(",", " ") for one in (f"time_s,{IN_RAD}", *TIMED)]),
    "poses": (poses, rows_of_poses()),
    "motion": (motion, [",".join(COLUMNS), *PLAN]),
}
NO_ROW = ("", "  ", "# a comment", '# the "left quote', " # behind a blank")
OF_SHEETS = (",,,,,", " , ,", "# a comment,,,,", '"# quoted, of a sheet",,,')


@pytest.mark.parametrize("table", TABLES)
@given(data=st.data())
def test_what_is_no_row_is_passed_over_and_moves_no_number(table, data):
    """Anywhere, also above the header; an error behind it names the line of the file."""
    read, lines = TABLES[table]
    passed = st.lists(st.sampled_from(NO_ROW if "blanks" in table else NO_ROW + OF_SHEETS), max_size=3)
    said, places = [], []
    for line in lines:
        said += data.draw(passed)
        places.append(len(said))
        said.append(line)
    np.testing.assert_array_equal(read("\n".join(said)), read("\n".join(lines)))
    at = places[data.draw(st.integers(1, len(lines) - 1))]
    broken = [*said[:at], said[at][:-1] + "x", *said[at + 1 :]]
    with pytest.raises(InputError) as caught:
        read("\n".join(broken))
    assert f"line {at + 1}" in caught.value.where.split(", ")
    assert caught.value.code == "not_a_number"


def test_a_comment_within_quotes_is_text():
    """A name may have line breaks, and the next of its lines may start with #."""
    found = list(csv_lines(b'name,x\n"two\n# lines",1\n# a comment\nb,2\n', "t", ""))
    assert found == [(1, ["name", "x"]), (3, ["two\n# lines", "1"]), (5, ["b", "2"])]


def test_what_may_be_a_point_or_a_comment_is_refused():
    """A point of that name would be lost, or one that was taken out be used; in quotes it is a name."""
    head = "name,x_mm,y_mm,z_mm\na,1,2,3\n"
    with refused("comment_or_row", "line 3"):
        points(head + "#1,4,5,6\n")
    assert parse_points((head + '"#1",4,5,6\n').encode(), FILE).names == ("a", "#1")
    assert len(points(head + "# b, c and\n# d,,,\n")) == 1
    commented = rows_of_poses()  # a pose is taken out
    assert len(poses("\n".join([*commented[:2], "#" + commented[2], commented[3]]))) == 2


@pytest.mark.parametrize("text", ["\n,\nid,name\n\n1,liver\n , \n2,bone\n", "id;name\n;\n1;liver\n2;bone\n"])
def test_names_of_labels_pass_over_empty_rows(text):
    assert names_for("a.csv", Path(), lambda _: text.encode(), None) == {1: "liver", 2: "bone"}


def without(columns, *names):
    return [name for name in columns if name not in names]


WHOLE = ("name", *pose_columns("A"), *pose_columns("B"))


@pytest.mark.parametrize(
    ("header", "said"),
    [
        (without(WHOLE, "A_r13"), "lacks A_r13"),
        (without(WHOLE, "name", "B_z_mm"), "lacks name, B_z_mm"),
        ([*WHOLE, "quality"], "has the unknown 'quality' (column 26)"),
        ([one.replace("B_x_mm", "B_x_m") for one in WHOLE], "lacks B_x_mm; has the unknown 'B_x_m' (column 23)"),
        ([*WHOLE, "A_r11"], "repeats 'A_r11' (column 26)"),
        ([*WHOLE[:3], WHOLE[4], WHOLE[3], *WHOLE[5:]], "has 'A_r21' (column 4) where A_r13 belongs"),
        (WHOLE[:13], f"lacks {', '.join(pose_columns('B')[:7])} .. B_z_mm"),
    ],
)
def test_a_refused_header_names_its_columns(header, said):
    """What is missing, what is unknown, and where."""
    with pytest.raises(InputError) as caught:
        poses(",".join(header) + "\n" + ",".join("0" * len(header)) + "\n")
    assert (caught.value.code, caught.value.what, caught.value.where) == (
        "wrong_columns",
        f"the header {said}",
        str(FILE),
    )


@pytest.mark.parametrize(
    ("groups", "said"),
    [
        (("A", "B"), "lacks P_u_mm, P_v_mm or P_u_px, P_v_px or picture"),
        (("P_px",), "lacks A_r11, A_r12, A_r13, A_r21, A_r22, A_r23, A_r31 .. A_z_mm or A_q1_deg"),
        (("P_px", "picture", "q"), "has P_u_px, P_v_px and picture at once"),
        (("P_px", "shaft", "q"), "lacks v_x, v_y"),
        (("P_px", "v", "q"), ""),
    ],
)
def test_groups_that_do_not_belong_together_are_named(groups, said):
    found = LAYOUT.fault(groups)
    assert found.startswith(said) and bool(found) == bool(said)


@given(st.permutations(WHOLE[:6]), st.lists(st.sampled_from([*WHOLE[:8], "z"]), max_size=8))
def test_no_fault_is_the_wanted_header_alone(wanted, header):
    assert (columns_fault(header, wanted) == "") == (header == wanted)
    assert columns_fault(wanted, wanted) == ""


def test_a_table_that_is_empty_has_no_header():
    with refused("wrong_columns", "header"):
        poses("# nothing\n,,,\n")
