# mypy: disable-error-code="no-untyped-def"
"""Headless renderer: triangles drawn into a sample grid with depth, and shaded, by compiled code.

Opaque surfaces give one hit per sample; translucent ones (skin, corridor) are seen through, with up to ``MAX_SHELLS``.
A film keeps the triangles that its samples show of what stands still, and draws what moves over them. Pixels are lit,
and blended from back to front by the "over" operator of Porter and Duff, Compositing Digital Images (SIGGRAPH 1984).
A pixel whose samples show the same smooth surfaces is lit and blended once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats, Ints32, Pixels
from puncture_twin.planning.base.numba_kernels import allocation_free, nb
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.geometry.containment import crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.raster import raster
from puncture_twin.twin.report.raster.camera import ViewCamera

Floats32 = NDArray[np.float32]
T = TypeVar("T")
SAMPLES = 2  # samples per pixel side
MAX_SHELLS = 4  # layers of a translucent surface that are drawn: skin in, skin out, twice
LINE_OF_SIGHT_SLACK_MM = 2.0  # a point so close behind a surface is seen: those of a needle lie in its bar
BACKGROUND = np.array([246.0, 247.0, 249.0], dtype=np.float32)
LIGHT = np.array([-0.45, 0.6, -1.0]) / np.linalg.norm([-0.45, 0.6, -1.0])
"""Over the viewer's left shoulder: right, up, forward."""

BAND = 60_000  # samples that are worked on at once: their arrays stay in the cache, and the bands share the processors
ALL = SAMPLES * SAMPLES  # samples of a pixel


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with its look."""

    mesh: TriangleMesh  # in the frame of the layer it belongs to, mm
    colour: Rgb  # RGB, 0..255
    alpha: float = 1.0  # opacity where one looks straight at it; only translucent surfaces use it
    rim: float = 2.5  # how much more opaque it is where one sees it edge-on


class Layer:
    """Surfaces that move together, in their own frame. Of two in one place the first is seen."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = tuple(surfaces)
        meshes = [s.mesh for s in surfaces]
        shifts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        self.vertices = _joined([m.vertices for m in meshes], np.float64)
        self.faces: Ints32 = _joined([m.faces + k for m, k in zip(meshes, shifts, strict=False)], np.int32)
        self.bodies: Ints32 = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(m.faces) for m in meshes])
        self.colours = np.array([s.colour for s in surfaces], dtype=np.float32).reshape(-1, 3)
        self.alphas = np.array([s.alpha for s in surfaces], dtype=np.float32)
        self.rims = np.array([s.rim for s in surfaces], dtype=np.float32)

    @cached_property
    def normals(self) -> Floats32:
        """Unit normals of the corners, shape (n, 3)."""
        return np.asarray(raster.corner_normals(self.vertices, self.faces))

    def sees(self, eye: Floats, points: Floats) -> Bools:
        """Whether nothing of this layer lies between an eye and each point (n, 3), in the layer's frame."""
        ray = points - eye
        far = np.linalg.norm(ray, axis=1)
        nearest = np.full(len(points), np.inf)
        for surface in self.surfaces:
            hits = crossings(surface.mesh, eye, ray / far[:, None], float(far.max()))
            hit = hits.count > 0
            nearest[hit] = np.minimum(nearest[hit], hits.depth[hits.first[hit]])
        return np.asarray(nearest >= far - LINE_OF_SIGHT_SLACK_MM)


class Drawn(NamedTuple):
    """1/z and triangle of the nearest surfaces of every sample, each (k, h, w); 0 and -1 for none."""

    inverse: Floats32
    triangle: Ints32

    def part(self, where: tuple[slice, slice, slice]) -> Drawn:
        """A copy of some rows and columns."""
        return Drawn(self.inverse[where].copy(), self.triangle[where].copy())

    @staticmethod
    def joined(bands: Sequence[Drawn]) -> Drawn:
        """Bands, one below the other."""
        inverse, triangle = [one.inverse for one in bands], [one.triangle for one in bands]
        return Drawn(np.concatenate(inverse, axis=1), np.concatenate(triangle, axis=1))

    @staticmethod
    def empty(most: int, shape: tuple[int, ...]) -> Drawn:
        """Samples in which nothing is drawn yet, for at most so many surfaces each."""
        return Drawn(np.zeros((most, *shape), dtype=np.float32), np.full((most, *shape), -1, dtype=np.int32))


class Look(NamedTuple):
    """A layer as a camera has it before it, as `finish` takes it; b bodies."""

    points: Floats  # shape (n, 3), of the corners, camera's frame, mm
    faces: Ints32  # shape (m, 3)
    bodies: Ints32  # shape (m,), the body of each triangle; ascending
    normals: Floats32  # shape (n, 3), of the corners
    flats: Floats32  # shape (m, 3), of the triangles
    colours: Floats32  # shape (b, 3), 0..255
    alphas: Floats32  # shape (b,), opacity where one looks straight at them
    rims: Floats32  # shape (b,), how much more opaque where one sees them edge-on

    def with_more(self, other: Look) -> Look:
        """Both looks as one; of two bodies in one place those of this one are seen."""
        faces, bodies = other.faces + np.int32(len(self.points)), other.bodies + np.int32(len(self.colours))
        parts: Any = zip(self, other._replace(faces=faces, bodies=bodies), strict=True)
        return Look(*(np.concatenate(both) for both in parts))


class View:
    """A layer before a camera, whose pixels are samples, and where each of its triangles lies in the picture.

    `T_ct_layer` is the pose of the layer, shape (4, 4), mm; None is the CT frame itself.
    """

    def __init__(self, layer: Layer, camera: ViewCamera, T_ct_layer: Floats | None = None) -> None:
        rotation, eye = camera.axes, np.asarray(camera.eye, dtype=float)
        if T_ct_layer is not None:
            rotation, eye = camera.axes @ T_ct_layer[:3, :3], (eye - T_ct_layer[:3, 3]) @ T_ct_layer[:3, :3]
        self.grid = camera.scale, camera.height, camera.width
        points = raster.rotated(layer.vertices, rotation, eye)
        normals, flats = raster.rotated(layer.normals, rotation, np.zeros(3)), raster.flat_normals(points, layer.faces)
        look = layer.faces, layer.bodies, normals, flats, layer.colours, layer.alphas, layer.rims
        self.look = Look(points, *look)
        self.spans: Ints32 = raster.outlines(points, layer.faces, self.grid)


def picture(opaque: Layer, translucents: Layer, camera: ViewCamera) -> Pixels:
    """A scene in the CT frame in the camera's pixels (h, w, 3): what is opaque, and what is see-through over it.

    Each is the mean of ``SAMPLES`` by ``SAMPLES``.
    """
    fine = camera.finer(SAMPLES)
    solid, glass = View(opaque, fine), View(translucents, fine)
    return np.concatenate(_in_bands(fine, lambda rows: _drawn_band(solid, glass, rows).pixels))


class _Band(NamedTuple):
    """A band of a picture: what its samples show of what is opaque and of what is see-through, and its pixels."""

    behind: Drawn
    shells: Drawn
    pixels: Pixels


def _drawn_band(solid: View, glass: View, rows: slice) -> _Band:
    corner, size = (rows.start, 0), (rows.stop - rows.start, solid.grid[2])
    behind, shells = Drawn.empty(1, size), Drawn.empty(MAX_SHELLS, size)
    nothing = np.zeros(size, dtype=np.float32)
    raster.draw(*solid.look[:3], solid.spans, solid.grid, corner, nothing, *behind)
    raster.draw(*glass.look[:3], glass.spans, glass.grid, corner, behind.inverse[0], *shells)
    return _Band(behind, shells, _finished(solid.look, glass.look, solid.grid, corner, behind, shells.triangle))


def _finished(
    solid: Look, glass: Look, grid: tuple[float, int, int], corner: tuple[int, int], behind: Drawn, shells: Ints32
) -> Pixels:
    """The pixels (h, w, 3) of a part of a picture, from the triangles that its samples show."""
    held = np.zeros((1 + MAX_SHELLS, SAMPLES * SAMPLES, 4), dtype=np.float32)  # what is not there is blended at 0
    height, width = behind.triangle.shape[1:]
    pixels = np.empty((height // SAMPLES, width // SAMPLES, 3), dtype=np.uint8)
    place: Any = tuple(LIGHT), grid, corner, behind.triangle, shells, tuple(BACKGROUND)
    finish(tuple(solid), tuple(glass), *place, held, pixels)
    return pixels


def _in_bands(camera: ViewCamera, work: Callable[[slice], T]) -> list[T]:
    """Call a function with the rows of every band, whole pixels, on several processors, and collect its results."""
    high = max(1, BAND // (camera.width * SAMPLES)) * SAMPLES
    bands = [slice(top, min(top + high, camera.height)) for top in range(0, camera.height, high)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, bands))


def _joined(arrays: Sequence[NDArray[Any]], dtype: type) -> NDArray[Any]:
    """Rows of three, one after the other; also of no array at all."""
    return np.concatenate([np.empty((0, 3), dtype=dtype), *arrays]).astype(dtype, copy=False)


class MovingPicture:
    """One view of a still scene, CT frame, with bodies that move; several threads may use it at once.

    Each layer moves in its own frame. Of two in one place the first is seen, and what stands before all.
    """

    def __init__(self, opaque: Layer, translucents: Layer, layers: Sequence[Layer], camera: ViewCamera) -> None:
        self._camera, self._layers = camera.finer(SAMPLES), tuple(layers)
        solid, glass = View(opaque, self._camera), View(translucents, self._camera)
        bands = _in_bands(self._camera, lambda rows: _drawn_band(solid, glass, rows))
        self._solid, self._glass = solid.look, glass.look
        self._behind = Drawn.joined([one.behind for one in bands])
        self._shells = Drawn.joined([one.shells for one in bands])
        self.still: Pixels = np.concatenate([one.pixels for one in bands])
        """The picture without what moves, shape (h, w, 3)."""

    def at(self, T_ct_layers: Sequence[Floats]) -> Pixels:
        """The picture with what moves at its poses, each (4, 4), mm; shape (h, w, 3)."""
        views = [View(layer, self._camera, T) for layer, T in zip(self._layers, T_ct_layers, strict=True)]
        look = self._solid.with_more(reduce(Look.with_more, (view.look for view in views)))
        first = np.cumsum([len(self._solid.faces), *(len(view.look.faces) for view in views)])
        moved = [view.spans + [[at, 0, 0, 0, 0]] for view, at in zip(views, first, strict=False)]
        spans: Ints32 = np.concatenate(moved).astype(np.int32)
        if len(spans) == 0:
            return self.still
        top, left = (int(one) // SAMPLES for one in spans[:, [1, 3]].min(axis=0))
        bottom, right = (int(one) // SAMPLES + 1 for one in spans[:, [2, 4]].max(axis=0))
        rows, columns = slice(top * SAMPLES, bottom * SAMPLES), slice(left * SAMPLES, right * SAMPLES)
        part = slice(None), rows, columns
        behind, shells = self._behind.part(part), self._shells.part(part)
        grid, corner = views[0].grid, (top * SAMPLES, left * SAMPLES)
        nothing = np.zeros(behind.inverse.shape[1:], dtype=np.float32)
        raster.draw(*look[:3], spans, grid, corner, nothing, *behind)
        before = shells.inverse > behind.inverse + raster.TIE * shells.inverse**2  # as `draw` hides what is behind
        seen = np.where(before, shells.triangle, np.int32(-1))
        picture = self.still.copy()
        picture[top:bottom, left:right] = _finished(look, self._glass, grid, corner, behind, seen)
        return picture


@allocation_free(nogil=True, error_model="numpy")
def finish(solid, glass, light, grid, corner, behind, shells, background, held, pixels):
    """Light and blend every pixel of a part of a picture.

    Solid and glass are the parts of the `Look` of the opaque and of the see-through layer; light, three numbers, unit,
    toward the lamp, camera's frame; grid, samples per unit of x and y, rows, columns of the whole picture; corner, its
    row and column at which the part begins, in samples, multiples of ``SAMPLES``; behind (1, h, w), the triangle of
    ``solid`` that each sample shows, -1 for none; shells (k, h, w), those of ``glass`` before it, nearest first;
    background, three float32; held (k + 1, ALL, 4), float32, to work in. Written to are the pixels (h / SAMPLES, w /
    SAMPLES, 3), uint8.
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
    top, left = place
    scale, height, width = grid
    if raster.all_alike(triangle[k], top, top + SAMPLES, left, left + SAMPLES, look[2], look[4]):
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
    points, faces, bodies, normals, flats, colours, alphas, rims = look
    tone, shine, facing = raster.lit(points, normals, flats, faces, f, x, y, light)
    body, edge_on = bodies[f], 1.0 - facing
    # A shell seen edge-on is thicker along the ray: glass-like outlines help to read its shape.
    held[layer, s, 3] = min(1.0, alphas[body] * (1.0 + rims[body] * edge_on * edge_on * edge_on))
    for c in range(3):
        held[layer, s, c] = min(colours[body, c] * tone + shine, 255.0)


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def byte(total):
    """The mean of a pixel's samples as a byte."""
    return np.uint8(min(max(np.round(total / SAMPLES**2), 0.0), 255.0))


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
