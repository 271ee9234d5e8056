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


def test_a_volume_is_what_a_surface_encloses():
    """A ball of 50 mm, wherever it lies, to what its surface is off."""
    for middle in (np.zeros(3), np.array([300.0, -900.0, 1500.0])):
        assert ball(middle, 50.0).volume / 1e3 == pytest.approx(4.0 / 3.0 * np.pi * 125.0, rel=0.01)


@pytest.mark.parametrize(
    ("place", "side"),
    [((120, 10, 400), "left"), ((-120, 0, 0), "right"), ((30, 90, 0), "back"), ((-30, -90, 0), "front")],
)
def test_a_side_is_that_of_the_body(place, side):
    """Of LPS, measured in the body's own width and depth."""
    skin = skin_from_mesh(ball(np.zeros(3), 100.0))
    assert body_side(ball(np.array(place, float), 10.0), skin) == side


def test_a_side_is_that_of_most_of_it():
    """A large ball at the left and a speck far back are at the left, though the middle of their box is not."""
    both = joined([ball(np.array([100.0, 0.0, 0.0]), 30.0), ball(np.array([60.0, 400.0, 0.0]), 1.0)])
    assert body_side(both, skin_from_mesh(ball(np.zeros(3), 100.0))) == "left"
