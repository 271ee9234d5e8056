"""How much of each pixel a line covers, and colours laid over a picture by that; compiled, pixel by pixel."""

# numba infers the types
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb

LINES = 4
"""In a row of pixels, along which areas are filled."""


HALF_DIAGONAL = 0.7072
"""Of a pixel, rounded up."""


@nb.njit(nogil=True, error_model="numpy")
def _within(beyond, nx, ny):
    """The share of a pixel on one side of a line: exactly, the square's shadow on the normal is a trapezoid.

    Args:
        beyond: How far the line lies beyond the pixel's middle, along the normal.
        nx: Of the normal, of length 1.
        ny: Of it.
    """
    if beyond >= HALF_DIAGONAL:
        return 1.0
    long, short = max(abs(nx), abs(ny)), min(abs(nx), abs(ny))
    if short < 1e-6:
        return min(max(beyond / max(long, 0.5) + 0.5, 0.0), 1.0)
    far, near = 0.5 * (long + short), 0.5 * (long - short)
    corners = max(beyond + far, 0.0) ** 2 + max(beyond - far, 0.0) ** 2
    return (corners - max(beyond + near, 0.0) ** 2 - max(beyond - near, 0.0) ** 2) / (2.0 * long * short)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cover_segments(cover, segments, width):
    """Draw segments with round ends; where several cover a pixel, the most counts.

    Args:
        cover: Shape (h, w), float32, 0..1; written to.
        segments: Shape (n, 4): column and row of both ends; (0, 0) is the upper left corner of the array.
        width: Pixels; below 1 a line is as wide as a pixel, and paler.
    """
    rows, columns = cover.shape
    half, most = 0.5 * max(width, 1.0), min(width, 1.0)
    reach = half + HALF_DIAGONAL
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s, 0], segments[s, 1], segments[s, 2], segments[s, 3]
        dx, dy = bx - ax, by - ay
        length = np.sqrt(dx * dx + dy * dy)
        if length > 0.0:
            dx, dy = dx / length, dy / length
        for i in range(int(max(0.0, min(ay, by) - reach)), int(min(rows - 1.0, max(ay, by) + reach)) + 1):
            y = i + 0.5 - ay
            low, high = min(ax, bx) - reach, max(ax, bx) + reach
            if dy != 0.0:  # nearer than the reach to the endless line
                middle, aside = ax + y * dx / dy, reach / abs(dy)
                low, high = max(low, middle - aside), min(high, middle + aside)
            for j in range(int(max(0.0, low - 1.0)), int(min(columns - 1.0, high)) + 1):
                x = j + 0.5 - ax
                t = min(max(x * dx + y * dy, 0.0), length)
                nx, ny = x - t * dx, y - t * dy
                far = np.sqrt(nx * nx + ny * ny)
                if far > 0.0:
                    nx, ny = nx / far, ny / far
                else:
                    nx, ny = dy, dx
                value = most * (_within(half - far, nx, ny) - _within(-half - far, nx, ny))
                if value > cover[i, j]:
                    cover[i, j] = value


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cover_area(cover, corners):
    """Fill what a closed outline holds: exactly along each of `LINES` lines in every row of pixels.

    Args:
        cover: Shape (h, w), float32, with nothing covered; written to.
        corners: Shape (n, 2), column and row; the last is joined to the first.
    """
    crossed = np.empty(len(corners))
    for i in range(cover.shape[0]):
        for line in range(LINES):
            y, count = i + (line + 0.5) / LINES, 0
            for k in range(len(corners)):
                ax, ay = corners[k - 1, 0], corners[k - 1, 1]
                bx, by = corners[k, 0], corners[k, 1]
                if (ay <= y) != (by <= y):
                    x, place = ax + (y - ay) / (by - ay) * (bx - ax), count
                    while place > 0 and crossed[place - 1] > x:
                        crossed[place] = crossed[place - 1]
                        place -= 1
                    crossed[place] = x
                    count += 1
            for k in range(0, count - 1, 2):
                left, right = max(crossed[k], 0.0), min(crossed[k + 1], float(cover.shape[1]))
                for j in range(int(left), int(np.ceil(right))):
                    cover[i, j] += max(0.0, min(j + 1.0, right) - max(float(j), left)) / LINES


@nb.njit(cache=True, nogil=True, error_model="numpy")
def lay_over(pixels, cover, colour, opacity):
    """Lay one colour over pixels, in place: the "over" operator of Porter and Duff (SIGGRAPH 1984).

    Args:
        pixels: Shape (h, w, 4), uint8: RGB and opacity.
        cover: Shape (h, w), float32, 0..1: how much of each pixel is covered.
        colour: Three numbers, 0..255.
        opacity: Of what covers, 0..1.
    """
    for i in range(cover.shape[0]):
        for j in range(cover.shape[1]):
            over = cover[i, j] * opacity
            if over <= 0.0:
                continue
            under = pixels[i, j, 3] / 255.0 * (1.0 - over)
            for k in range(3):
                pixels[i, j, k] = np.uint8(np.round((colour[k] * over + pixels[i, j, k] * under) / (over + under)))
            pixels[i, j, 3] = np.uint8(np.round(255.0 * (over + under)))
