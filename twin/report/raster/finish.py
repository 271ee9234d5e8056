"""The pixels of a picture, from the triangles that its samples show: lit, and blended from back to front; compiled.

A pixel whose samples show the same smooth surfaces is lit and blended once. What is computed is rounded where what
moves is drawn by way of arrays (`shade_nearest`, `shade_shells`, `recompose`): both make the same pixels.
"""

# numba infers the types
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.twin.report.raster.compositing import SAMPLES, byte
from puncture_twin.twin.report.raster.shading import all_alike, lit

ALL = SAMPLES * SAMPLES
"""Samples of a pixel."""


@allocation_free(nogil=True, error_model="numpy")
def finish(solid, glass, light, grid, corner, behind, shells, background, held, pixels):
    """Light and blend every pixel of a part of a picture.

    Args:
        solid: Of the opaque layer, points (n, 3), faces (m, 3), bodies (m,), normals (n, 3), flats (m, 3), colours
            (b, 3), alphas (b,) and rims (b,), as `shade_shells` takes them.
        glass: The same of the see-through layer.
        light: Three numbers, unit, toward the lamp, camera's frame.
        grid: Samples per unit of x and y, rows, columns of the whole picture.
        corner: Row and column of the picture at which the part begins, in samples; multiples of ``SAMPLES``.
        behind: Shape (1, h, w), the triangle of ``solid`` that each sample shows, -1 for none.
        shells: Shape (k, h, w), those of ``glass`` before it, nearest first.
        background: Three float32, the colour where nothing is.
        held: Shape (k + 1, ALL, 4), float32, to work in.
        pixels: Shape (h / SAMPLES, w / SAMPLES, 3), uint8, written to.
    """
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            place = i * SAMPLES, j * SAMPLES
            for s in range(ALL):
                held[0, s, 0], held[0, s, 1], held[0, s, 2] = background
            used = _shade(held, 0, solid, light, grid, corner, behind, 0, place)
            count = 0
            while count < len(shells):
                found = _shade(held, count + 1, glass, light, grid, corner, shells, count, place)
                if found == 0:
                    break
                used, count = max(used, found), count + 1
            red, green, blue = _blended(held, count, used)
            pixels[i, j, 0], pixels[i, j, 1], pixels[i, j, 2] = byte(red), byte(green), byte(blue)


@allocation_free(nogil=True, error_model="numpy", forceinline=True)
def _shade(held, layer, look, light, grid, corner, triangle, k, place):
    """Colour and opacity of what a pixel shows of a layer.

    Returns:
        0 where it shows nothing, 1 where all samples show one smooth surface, and else 2.
    """
    top, left = place
    scale, height, width = grid
    if all_alike(triangle[k], top, top + SAMPLES, left, left + SAMPLES, look[2], look[4]):
        x = (corner[1] + 0.5 * (left + left + SAMPLES) - width / 2) / scale
        y = (height / 2 - corner[0] - 0.5 * (top + top + SAMPLES)) / scale
        _shade_one(held, layer, 0, look, light, triangle[k, top, left], x, y)
        for s in range(1, ALL):
            for c in range(4):
                held[layer, s, c] = held[layer, 0, c]
        return 1
    found = 0
    for s in range(ALL):
        row, column = top + s // SAMPLES, left + s % SAMPLES
        f = triangle[k, row, column]
        if f >= 0:
            x = (corner[1] + column + 0.5 - width / 2) / scale
            y = (height / 2 - (corner[0] + row) - 0.5) / scale
            _shade_one(held, layer, s, look, light, f, x, y)
            found = 2
        elif layer > 0:
            held[layer, s, 3] = 0.0
    return found


@allocation_free(nogil=True, error_model="numpy", forceinline=True)
def _shade_one(held, layer, s, look, light, f, x, y):
    """Colour and opacity of one sample."""
    points, faces, bodies, normals, flats, colours, alphas, rims = look
    tone, shine, facing = lit(points, normals, flats, faces, f, x, y, light)
    body, edge_on = bodies[f], 1.0 - facing
    # A shell seen edge-on is thicker along the ray: glass-like outlines help to read its shape.
    held[layer, s, 3] = min(1.0, alphas[body] * (1.0 + rims[body] * edge_on * edge_on * edge_on))
    for c in range(3):
        held[layer, s, c] = min(colours[body, c] * tone + shine, 255.0)


@allocation_free(nogil=True, error_model="numpy", forceinline=True)
def _blended(held, count, used):
    """The sums over a pixel's samples of what so many shells leave of the layer behind them."""
    red, green, blue = 0.0, 0.0, 0.0
    samples = ALL if used == 2 else 1
    for s in range(samples):
        x, y, z = held[0, s, 0], held[0, s, 1], held[0, s, 2]
        for k in range(count, 0, -1):
            alpha = held[k, s, 3]
            x += alpha * (held[k, s, 0] - x)
            y += alpha * (held[k, s, 1] - y)
            z += alpha * (held[k, s, 2] - z)
        red, green, blue = red + x, green + y, blue + z
    often = ALL / samples
    return often * red, often * green, often * blue
