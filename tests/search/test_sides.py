"""From which sides of a body a needle can come, what `init` makes of it, and what a search says of it."""

from types import SimpleNamespace

import pytest
from case_world import write_case

from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.sides import BACK, FRONT, Side, grid_of, sides_of, sides_text


def side(name, is_open, why="lies on the table"):
    return Side(name, float(is_open), 1.0, 50.0, "" if is_open else why)


@pytest.mark.parametrize(
    ("closed", "theta", "frame"),
    [
        ((), (0.0, 180.0), FRONT),
        (("back",), (0.0, 90.0), FRONT),
        (("front",), (0.0, 90.0), BACK),
        (("front", "back"), (0.0, 180.0), FRONT),
        (("front", "left", "right"), (0.0, 90.0), BACK),
        (("front", "back", "left", "right"), (0.0, 90.0), FRONT),
    ],
)
def test_the_grid_covers_the_sides_that_are_open(closed, theta, frame):
    """Front or back with what is beside it; all around where both are open, or a side alone."""
    sides = [side(name, name not in closed) for name in ("front", "back", "right", "left", "feet", "head")]
    assert grid_of(sides) == (theta, frame)


def test_it_is_said_in_words():
    opened = [side("front", True), side("back", False), side("right", True), side("left", True)]
    assert sides_text(opened) == "front and sides; the back lies on the table"
    oblique = side("left", False, "is met too obliquely")
    closed = [side("front", False), side("back", False), side("right", True), oblique]
    assert sides_text(closed) == "right; the front and back lie on the table; the left is met too obliquely"


SHAFT, DEEP = "shaft_mm = 150.0", "position_mm = [0.0, 0.0, 0.0]"


@pytest.mark.parametrize(
    ("place", "near"), [((0.0, 70.0, 0.0), {"back"}), ((0.0, -70.0, 0.0), {"front"}), ((70.0, 0.0, 0.0), {"left"})]
)
def test_a_side_is_open_as_far_as_the_needle_reaches(tmp_path, place, near):
    """A ball of 90 mm and a shaft of 24: of a target 20 mm below its skin only that side is within reach."""
    organ = ("position_mm = [0.0, 0.0, 0.0]", f"position_mm = {list(place)}\nhit_radius_mm = 5.0")
    path = write_case(tmp_path, organ, ('structure = "organ"\n', ""), (SHAFT, "shaft_mm = 24.0"))
    path.write_text(path.read_text() + '\n[ct]\ntable = "none"\n')
    sides = {one.name: one for one in prepare(path, arm=False).sides}
    assert {name for name, one in sides.items() if one.is_open} == near
    (name,) = near
    assert sides[name].nearest_mm == pytest.approx(20.0, abs=1.0)
    assert all("needle's longest path" in one.why for one in sides.values() if one.name not in near)


def test_what_is_searched_is_what_the_grid_holds(tmp_path):
    wide, narrow = (prepare(write_case(tmp_path, ("[0, 10]", f"[0, {most}]")), arm=False).sides for most in (180, 90))
    assert all(one.searched == pytest.approx(1.0) for one in wide)
    assert sides_text(wide, searched=True) == "front and sides; the back is where the image does not show the body"
    assert sides_text(narrow, searched=True).startswith("front and sides; the back")
    closed = [one._replace(open=0.0, why="is far away") if one.name == "left" else one for one in wide]
    assert sides_text(closed, searched=True).startswith("front and right; ")  # no side is named twice
    opened = [one._replace(open=1.0, why="") for one in narrow]
    assert sides_text(opened, searched=True) == "front and sides; not the back, where the skin is 88 mm away"
    searched = {one.name: one.searched for one in narrow}
    assert searched["front"] == pytest.approx(1.0) and searched["back"] == 0.0


def test_without_a_ct_the_back_lies_on_something_and_a_local_place_has_no_sides(tmp_path):
    path = write_case(tmp_path)
    backs = []
    for more in ("", '\n[ct]\ntable = "none"\n'):
        path.write_text(path.read_text() + more)
        backs.append({one.name: one.is_open for one in prepare(path, arm=False).sides}["back"])
    assert backs == [False, True]
    assert sides_of(SimpleNamespace(space=Space.LOCAL), SimpleNamespace()) == ()
