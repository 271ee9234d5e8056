"""What values show of themselves in a notebook: whole HTML, escaped, never an error, never more safe than is safe."""

import base64
import io
import re

import numpy as np
from PIL import Image
from whole_html import Whole

from puncture_twin.planning.base.polar_map import Entry, Sectors, polar_map
from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.base.text import Shown, card

LEGEND = (Entry("safe", (0, 158, 115)), Entry("too close", (213, 94, 0)), Entry("undecided", (255, 255, 255)))
HOSTILE = '</td><script>alert("1")</script>&'


def grid(step=5.0, last=30.0):
    theta, beta = np.meshgrid(np.arange(0, last, step), np.arange(0, 360, step), indexing="ij")
    lows = np.radians(theta.ravel()), np.radians(beta.ravel())
    return tuple(low[:, None] + np.array([0, np.radians(step)]) for low in lows)


def painted(shown):
    data = base64.b64decode(re.search(r'base64,([^"]+)"', shown)[1])
    counts = Image.open(io.BytesIO(data)).convert("RGB").getcolors(1 << 24)
    return {css(colour) for count, colour in counts if count > 5000} - {"#ffffff"}


def test_a_card_is_whole_and_escapes_what_it_is_told():
    text = card(HOSTILE, [(HOSTILE, HOSTILE)])
    assert "script" not in Whole(text).tags
    assert text.count("&lt;script&gt;") == 3


def test_what_cannot_be_shown_is_named():
    """The notebook gets the class and the kind of error, not a traceback."""

    class Broken(Shown):
        """Fails when it is shown."""

        def _facts(self):
            raise ValueError(HOSTILE)

    shown = Broken()._repr_html_()
    assert "Broken" in shown
    assert "ValueError" in shown
    assert Whole(shown).tags == ["pre"]


def test_the_map_shows_the_verdicts_that_occur():
    """One shape for each, and a line of the legend; without cells there is no map."""
    theta, beta = grid()
    shown = polar_map(Sectors(theta, beta, (theta[:, 0] > 0.3).astype(int)), LEGEND, np.radians(2.5))._repr_html_()
    assert "img" in Whole(shown).tags
    assert painted(shown) == {css(one.colour) for one in LEGEND[:2]}
    assert "too close" in shown
    assert "undecided" not in shown
    assert polar_map(Sectors(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, int)), LEGEND)._repr_html_() == ""


def test_a_bin_with_anything_unsafe_in_it_is_not_safe():
    """Cells much smaller than a bin: the one that is not safe shows, whatever the order."""
    fine = np.radians(np.arange(0, 10, 0.05))
    theta = np.stack([fine, fine + np.radians(0.05)], axis=1)
    beta = np.tile([0.0, 2 * np.pi], (len(fine), 1))
    for order in (slice(None), slice(None, None, -1)):
        code = np.zeros(len(fine), int)
        code[3::10] = 1  # one cell in each bin of half a degree
        shown = polar_map(Sectors(theta[order], beta[order], code[order]), LEGEND)._repr_html_()
        assert painted(shown) == {css(LEGEND[1].colour)}


def test_a_cell_across_beta_zero_is_painted_on_both_sides():
    theta = np.radians([[0.0, 30.0], [0.0, 30.0]])
    beta = np.radians([[-10.0, 10.0], [10.0, 350.0]])
    shown = polar_map(Sectors(theta, beta, np.array([1, 0])), LEGEND, np.radians(10.0))._repr_html_()
    assert painted(shown) == {css(one.colour) for one in LEGEND[:2]}
    same = polar_map(Sectors(theta, beta + 2 * np.pi, np.array([1, 0])), LEGEND, np.radians(10.0))._repr_html_()
    assert same == shown
