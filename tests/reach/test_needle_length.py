"""What the needle's length and the target's place say before and after a search."""

import json

import pytest
from case_world import write_case
from refusals import refused

from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main


@pytest.mark.parametrize(("shaft", "warned"), [(80.0, True), (95.0, False)])
def test_a_needle_shorter_than_the_shortest_way_is_a_warning(tmp_path, shaft, warned):
    """The skin is 90 mm away in every direction: a shaft of 80 mm reaches it nowhere."""
    path = write_case(tmp_path, ("shaft_mm = 150.0", f"shaft_mm = {shaft}"))
    found = [warning for warning in prepare(path, arm=False).anatomy.warnings if "every path is too long" in warning]
    assert len(found) == warned
    assert all("the needle's longest path is 80 mm, and the skin is 8" in warning for warning in found)


def test_a_standoff_too_short_for_the_way_is_the_same(tmp_path):
    """With a fixed standoff the tip must still wait outside of the skin."""
    path = write_case(tmp_path, ("diameter_mm = 1.2", "diameter_mm = 1.2\nstandoff_mm = 90.0"))
    assert any("longest path is 80 mm" in warning for warning in prepare(path, arm=False).anatomy.warnings)


def test_a_needle_too_short_for_most_directions_is_said_after_the_search(tmp_path, capfd):
    off = ("position_mm = [0.0, 0.0, 0.0]", "position_mm = [0.0, 15.0, 0.0]")
    path = write_case(tmp_path, off, ("shaft_mm = 150.0", "shaft_mm = 80.0"), ("[0, 10]", "[0, 180]"))
    command = ["search", str(path), "--no-arm", "--no-pictures", "--out", str(tmp_path / "out")]
    main(command)
    said = capfd.readouterr().out
    assert "the needle is too short for " in said
    main([*command, "--json"])
    found = json.loads(capfd.readouterr().out)
    assert found["counts"]["too_long"] > found["directions"] / 2
    text = f"the needle is too short for {found['counts']['too_long']} of {found['directions']} directions"
    assert any(text in warning for warning in found["warnings"])


def test_check_says_how_deep_the_target_lies_in_its_structure(tmp_path, capfd):
    """A ball of 20 mm about a target 15 mm from its middle: 5 mm below the surface, as its triangles have it."""
    path = write_case(tmp_path, ("position_mm = [0.0, 0.0, 0.0]", "position_mm = [0.0, 15.0, 0.0]"))
    main(["check", str(path), "--theta", "0", "--beta", "0", "--no-arm", "--json"])
    assert json.loads(capfd.readouterr().out)["target_depth_mm"] == pytest.approx(5, abs=0.5)
    main(["check", str(path), "--theta", "0", "--beta", "0", "--no-arm"])
    assert "mm below the surface of organ" in capfd.readouterr().out


def test_a_target_outside_says_by_how_much(tmp_path):
    """Ten mm beyond a ball of 20 mm."""
    path = write_case(tmp_path, ("position_mm = [0.0, 0.0, 0.0]", "position_mm = [0.0, 30.0, 0.0]"))
    with refused("target_misplaced", "organ"):
        prepare(path, arm=False)
