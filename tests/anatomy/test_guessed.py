"""What a rule guesses of an image is said with how much, where, the picture and the line that overrules it."""

import numpy as np
import pytest

from puncture_twin.planning.anatomy.anatomy import ball, body_side, guessed
from puncture_twin.planning.anatomy.skin import skin_from_mesh
from puncture_twin.planning.base.errors import Severity
from puncture_twin.planning.geometry.mesh import joined


def test_a_guess_says_how_much_where_and_what_overrules_it():
    """In numbers for a program, in one sentence for a person."""
    found = guessed("attached_limb", "a limb seems to be pressed", 6900.0, "left", '[ct] arms = "none"')
    assert found.severity is Severity.WARNING and found.code == "attached_limb"
    assert found.numbers == {"volume_ml": 6900.0, "side": "left", "overruled_by": '[ct] arms = "none"'}
    assert "6.9 l at its left side" in found.sentence and "slices.png" in found.sentence
    assert found.sentence.endswith('[ct] arms = "none"')


@pytest.mark.parametrize(
    ("places", "side"),
    [
        ([((120, 10, 400), 10)], "left"),
        ([((-120, 0, 0), 10)], "right"),
        ([((30, 90, 0), 10)], "back"),
        ([((-30, -90, 0), 10)], "front"),
        ([((100, 0, 0), 30), ((60, 400, 0), 1)], "left"),
    ],
)
def test_a_side_is_that_of_most_of_it_in_the_bodys_width_and_depth(places, side):
    """Also where a speck lies far back. A volume is what a surface encloses, wherever it lies."""
    balls = [ball(np.array(middle, float), radius) for middle, radius in places]
    assert body_side(joined(balls), skin_from_mesh(ball(np.zeros(3), 100.0))) == side
    volume = sum(4.0 / 3.0 * np.pi * radius**3 for _, radius in places)
    assert joined(balls).volume == pytest.approx(volume, rel=0.01)
