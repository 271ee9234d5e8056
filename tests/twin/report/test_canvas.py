"""What is drawn without a plotter: lines as wide as asked, areas as large as they are, words where they belong."""

import numpy as np
import pytest
from hypothesis import example, given, strategies as st

from puncture_twin.twin.report.canvas import Canvas, Halo, Words, circle, dashed, rounded, star, ticks

ANGLES = st.floats(0, 2 * np.pi)


def covered(canvas):
    """The area of what was drawn on a transparent canvas, pixels."""
    return canvas.pixels[..., 3].sum() / 255


def rotation(angle):
    """Shape (2, 2)."""
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


@given(ANGLES, st.floats(1.0, 6.0))
@example(3 * np.pi / 4, 1.0)
def test_a_line_is_as_wide_as_asked(angle, width):
    """In every direction: length times width, and a disc for both round ends, which alone are not exact."""
    canvas, along = Canvas(100, 100, None), 30 * np.array([np.cos(angle), np.sin(angle)])
    canvas.line(np.array([50 - along, 50 + along]), width, (0, 0, 0))
    assert covered(canvas) == pytest.approx(60 * width + np.pi * width**2 / 4, abs=2.0)


def test_a_line_thinner_than_a_pixel_is_pale():
    """Half a pixel wide covers half."""
    canvas = Canvas(50, 50, None)
    canvas.line(np.array([(5, 20.5), (45, 20.5)]), 0.5, (0, 0, 0))
    assert canvas.pixels[20, 25, 3] == 128 and canvas.pixels[18, 25, 3] == 0


@given(ANGLES, st.integers(3, 40))
def test_an_area_is_filled_as_far_as_it_reaches(angle, corners):
    """A polygon that is turned covers its area, by the shoelace formula."""
    points = 50 + circle((0, 0), 30, corners)[:-1] @ rotation(angle)
    canvas = Canvas(100, 100, None)
    canvas.fill(points, (0, 0, 0))
    x, y = points.T
    area = abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2
    assert covered(canvas) == pytest.approx(area, rel=2e-3)


def test_an_area_may_be_dented_and_reach_beyond_the_picture():
    """A star's notches are free; of what lies beyond the edges nothing is drawn, and nothing fails."""
    canvas = Canvas(40, 40, None)
    canvas.fill(star((20, 20), 18), (1, 2, 3))
    assert canvas.pixels[20, 20].tolist() == [1, 2, 3, 255] and canvas.pixels[36, 20, 3] == 0
    wide = Canvas(40, 40, None)
    wide.fill(rounded((-50, -50, 100, 100), 5), (1, 2, 3))
    assert covered(wide) == 1600
    for points in (rounded((60, 60, 90, 90), 5), rounded((-90, 5, -60, 30), 5)):
        wide.fill(points, (9, 9, 9))
        wide.line(points, 3, (9, 9, 9))
    wide.write((200, -100), "far", Words(12))
    assert (wide.pixels == [1, 2, 3, 255]).all()


def test_colours_lie_over_one_another():
    """Half of black over white is grey; on nothing it is black, half opaque."""
    points = np.array([(0, 0), (8, 0), (8, 8), (0, 8)])
    for ground, shown in (((255, 255, 255), [128, 128, 128, 255]), (None, [0, 0, 0, 128])):
        canvas = Canvas(8, 8, ground)
        canvas.fill(points, (0, 0, 0), opacity=0.5)
        assert np.abs(canvas.pixels[4, 4].astype(int) - shown).max() <= 1


@given(ANGLES, st.floats(1.0, 3.0), st.floats(4.0, 9.0), st.floats(2.0, 6.0))
def test_dashes_lie_on_the_line_in_their_lengths(angle, width, drawn, left_out):
    """Also around corners; with their round ends they are as long as asked."""
    points = np.array([(0, 0), (40, 0), (40, 30), (0, 30)]) @ rotation(angle)
    parts = dashed(points, width, drawn, left_out)
    length = np.linalg.norm(parts[:, 1] - parts[:, 0], axis=1).sum()
    whole = 110 // (drawn + left_out)
    assert whole * (drawn - width) - 1e-6 <= length <= (whole + 1) * (drawn - width) + 1e-6


def test_words_stand_where_they_belong():
    """At their anchor, line below line, with a halo, and turned by a quarter."""
    canvas = Canvas(200, 100, None)
    canvas.write((100, 50), "HHHH\nHHHH", Words(20, halo=Halo(2, (255, 0, 0))), anchor="mm")
    rows, columns = np.nonzero(canvas.pixels[..., 3])
    assert abs(rows.mean() - 50) < 2 and abs(columns.mean() - 100) < 2
    red = canvas.pixels[..., 0] == 255
    assert red.any() and (canvas.pixels[..., :3].sum(axis=-1) == 0)[canvas.pixels[..., 3] == 255].any()
    shapes = []
    for turned in (0, 1, -1):
        one = Canvas(200, 200, None)
        one.write((100, 100), "HHHH", Words(20), anchor="ls", turned=turned)
        shapes.append([(int(line.min()) - 100, int(line.max()) - 100) for line in np.nonzero(one.pixels[..., 3])])
    (flat_rows, flat_columns), (up_rows, _), (down_rows, _) = shapes
    assert flat_rows[1] <= 0 <= flat_columns[0]
    assert up_rows[1] <= 0 and down_rows[0] >= -1
    assert up_rows[1] - up_rows[0] == pytest.approx(flat_columns[1] - flat_columns[0], abs=2)


@given(st.floats(-1e4, 1e4), st.floats(0.1, 1e4), st.integers(2, 10))
def test_ticks_are_round_and_few(low, extent, most):
    """Within the axis, evenly apart by 1, 2 or 5 times a power of ten, no more than asked."""
    found = ticks(low, low + extent, most)
    assert len(found) + 1 >= 1 and len(found) <= most + 1
    assert ((found >= low - 1e-6 * extent) & (found <= low + extent * (1 + 1e-6))).all()
    if len(found) > 1:
        step = found[1] - found[0]
        assert any(np.isclose(step, factor * 10.0 ** np.floor(np.log10(step * 1.0001))) for factor in (1, 2, 5))
