"""What values show of themselves in a notebook: whole HTML, escaped, never an error, never more safe than is safe."""

from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np

from puncture_twin.planning.base.polar_map import Entry, Sectors, polar_map
from puncture_twin.planning.base.text import card, never_raises

LEGEND = (Entry("safe", (0, 158, 115)), Entry("too close", (213, 94, 0)), Entry("undecided", (255, 255, 255)))
HOSTILE = '</td><script>alert("1")</script>&'


class Whole(HTMLParser):
    """Complains where a tag is closed that is not the last one opened."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags = [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        """No part of it comes from outside, none acts."""
        self.open.append(tag)
        self.tags.append(tag)
        assert not any(name in ("src", "href", "onload", "onclick") for name, _ in attrs)

    def handle_startendtag(self, tag, attrs):
        """An element without a content."""
        self.tags.append(tag)

    def handle_endtag(self, tag):
        """The last one opened is closed first."""
        assert self.open.pop() == tag


def grid(step=5.0, last=30.0):
    """Cells of a cap, rad."""
    theta, beta = np.meshgrid(np.arange(0, last, step), np.arange(0, 360, step), indexing="ij")
    lows = np.radians(theta.ravel()), np.radians(beta.ravel())
    return tuple(low[:, None] + np.array([0, np.radians(step)]) for low in lows)


def painted(svg):
    """The colours of a map's shapes."""
    root = ElementTree.fromstring(svg)
    return {path.get("fill") for path in root.iter("{http://www.w3.org/2000/svg}path") if path.get("fill")}


def test_a_card_is_whole_and_escapes_what_it_is_told():
    """No name of a file may become a tag."""
    text = card(HOSTILE, [(HOSTILE, HOSTILE)])
    assert "script" not in Whole(text).tags
    assert text.count("&lt;script&gt;") == 3


def test_what_cannot_be_shown_is_named():
    """The notebook gets the class and the kind of error, not a traceback."""

    class Broken:
        """Fails when it is shown."""

        def __str__(self):
            raise ValueError(HOSTILE)

        __repr__ = __str__

    shown = never_raises(str)(Broken())
    assert "Broken" in shown
    assert "ValueError" in shown
    assert Whole(shown).tags == ["pre"]


def test_the_map_shows_the_verdicts_that_occur():
    """One shape for each, and a line of the legend; without cells there is no map."""
    theta, beta = grid()
    svg = polar_map(Sectors(theta, beta, (theta[:, 0] > 0.3).astype(int)), LEGEND, np.radians(2.5))
    assert Whole(svg).tags[0] == "svg"
    assert painted(svg) == {"#009e73", "#d55e00"}
    assert "too close" in svg
    assert "undecided" not in svg
    assert polar_map(Sectors(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, int)), LEGEND) == ""


def test_a_bin_with_anything_unsafe_in_it_is_not_safe():
    """Cells much smaller than a bin: the one that is not safe shows, whatever the order."""
    fine = np.radians(np.arange(0, 10, 0.05))
    theta = np.stack([fine, fine + np.radians(0.05)], axis=1)
    beta = np.tile([0.0, 2 * np.pi], (len(fine), 1))
    for order in (slice(None), slice(None, None, -1)):
        code = np.zeros(len(fine), int)
        code[3::10] = 1  # one cell in each bin of half a degree
        svg = polar_map(Sectors(theta[order], beta[order], code[order]), LEGEND)
        assert painted(svg) == {"#d55e00"}


def test_a_cell_across_beta_zero_is_painted_on_both_sides():
    """Azimuths count modulo a turn."""
    theta = np.radians([[0.0, 30.0], [0.0, 30.0]])
    beta = np.radians([[-10.0, 10.0], [10.0, 350.0]])
    svg = polar_map(Sectors(theta, beta, np.array([1, 0])), LEGEND, np.radians(10.0))
    assert painted(svg) == {"#009e73", "#d55e00"}
    same = polar_map(Sectors(theta, beta + 2 * np.pi, np.array([1, 0])), LEGEND, np.radians(10.0))
    assert same == svg
