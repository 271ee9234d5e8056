# mypy: disable-error-code="no-untyped-def"
"""Pictures without a screen: triangles drawn into a sample grid with depth, and shaded, by compiled code.

Opaque surfaces give one hit per sample; translucent surfaces (skin, corridor) are seen through, with up to
``MAX_SHELLS`` hits.

What moves, drawn over what stands still, and taken away again: one picture after the other of the same view.

The pixels of a picture, from the triangles that its samples show: lit, and blended from back to front; compiled.

A pixel whose samples show the same smooth surfaces is lit and blended once. What is computed is rounded where what
moves is drawn by way of arrays (`shade_nearest`, `shade_shells`, `recompose`): both make the same pixels.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints32
from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.raster.camera import ViewCamera, blocked
from puncture_twin.twin.report.raster.compositing import (
    NOWHERE,
    SAMPLES,
    PixelBox,
    RasterShot,
    Shells,
    byte,
    compose,
    recompose,
)
from puncture_twin.twin.report.raster.raster import depth_before, draw, outlines, sorted_by_band
from puncture_twin.twin.report.raster.shading import (
    all_alike,
    corner_normals,
    flat_normals,
    lit,
    rotated,
    shade_nearest,
    shade_shells,
)

Floats32 = NDArray[np.float32]
T = TypeVar("T")

_SHELL_PARTS = ("colour", "alpha", "depth")

MAX_SHELLS = 4
"""Layers of a translucent surface that are drawn: skin in, skin out, twice."""

LINE_OF_SIGHT_SLACK_MM = 2.0
"""A point this close behind a surface still counts as seen: points on the needle lie inside its bar."""

BACKGROUND = np.array([246.0, 247.0, 249.0], dtype=np.float32)

LIGHT = np.array([-0.45, 0.6, -1.0]) / np.linalg.norm([-0.45, 0.6, -1.0])
"""Over the viewer's left shoulder: right, up, forward."""

BAND = 60_000
"""Samples that are worked on at once: their arrays stay in the cache, and the bands share the processors."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with its look.

    Attributes:
        mesh: In the frame of the layer it belongs to, mm.
        colour: RGB, 0..255.
        alpha: Opacity where one looks straight at it; only translucent surfaces use it.
        rim: How much more opaque it is where one sees it edge-on.
        solid: Whether its triangles close it and face outwards, and nobody looks from within: then those that face
            away are behind others, and drawing them, which is half of the work, changes nothing.
    """

    mesh: TriangleMesh
    colour: Rgb
    alpha: float = 1.0
    rim: float = 2.5
    solid: bool = False


class Layer:
    """Surfaces that move together, in their own frame. Of two in one place the first is seen.

    Args:
        surfaces: The surfaces, in one frame.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = tuple(surfaces)
        meshes = [s.mesh for s in surfaces]
        shifts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        self.vertices = _joined([m.vertices for m in meshes], np.float64)
        self.faces: Ints32 = _joined([m.faces + k for m, k in zip(meshes, shifts, strict=False)], np.int32)
        self.bodies: Ints32 = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(m.faces) for m in meshes])
        self.colours = np.array([s.colour for s in surfaces], dtype=np.float32).reshape(-1, 3)
        self.alphas = np.array([s.alpha for s in surfaces], dtype=np.float32)
        self.solids = np.array([s.solid for s in surfaces], dtype=np.bool_)
        self.rims = np.array([s.rim for s in surfaces], dtype=np.float32)

    @cached_property
    def normals(self) -> Floats32:
        """Of the corners, shape (n, 3)."""
        return np.asarray(corner_normals(self.vertices, self.faces))

    def sees(self, eye: Floats, points: Floats) -> NDArray[np.bool_]:
        """Whether nothing of this layer lies between an eye and each point (n, 3), in the layer's frame."""
        eye, points = np.array(eye, dtype=np.float64), np.array(points, dtype=np.float64, order="C")
        mesh = self.vertices, self.faces, self._starts, self._boxes
        return np.asarray(~blocked(*mesh, eye, points, LINE_OF_SIGHT_SLACK_MM))

    @cached_property
    def _boxes(self) -> Floats:
        """About each surface, shape (b, 2, 3), mm."""
        return np.array([s.mesh.bounds for s in self.surfaces]).reshape(-1, 2, 3)

    @cached_property
    def _starts(self) -> NDArray[np.int64]:
        """Where the vertices and faces of each surface begin, and where the last ones end, shape (b + 1, 2)."""
        counts = [(len(s.mesh.vertices), len(s.mesh.faces)) for s in self.surfaces]
        return np.cumsum([(0, 0), *counts], axis=0)


class Drawn(NamedTuple):
    """1/z and triangle of the nearest surfaces of every sample, each (k, h, w); 0 and -1 for none."""

    inverse: Floats32
    triangle: Ints32

    def part(self, where: tuple[slice, slice]) -> Drawn:
        """Rows and columns of it."""
        return Drawn(self.inverse[:, *where], self.triangle[:, *where])

    @staticmethod
    def empty(most: int, shape: tuple[int, ...]) -> Drawn:
        """Nothing is drawn yet; at most so many surfaces a sample."""
        return Drawn(np.zeros((most, *shape), dtype=np.float32), np.full((most, *shape), -1, dtype=np.int32))


class Posed(NamedTuple):
    """Corners and their normals in a camera's frame, each (n, 3)."""

    points: Floats
    normals: Floats32


def posed(layer: Layer, camera: ViewCamera, T_ct_layer: Floats | None = None) -> Posed:
    """A layer before a camera: at a pose, shape (4, 4), mm, or in the CT frame itself."""
    turn, eye = camera.axes, np.asarray(camera.eye, dtype=float)
    if T_ct_layer is not None:
        turn, eye = camera.axes @ T_ct_layer[:3, :3], (eye - T_ct_layer[:3, 3]) @ T_ct_layer[:3, :3]
    return Posed(rotated(layer.vertices, turn, eye), rotated(layer.normals, turn, np.zeros(3)))


class View:
    """A layer as a camera has it before it: corners in the camera's frame, and where each triangle lies.

    Args:
        camera: The samples are its pixels.
    """

    def __init__(self, layer: Layer, camera: ViewCamera, seen: Posed) -> None:
        self.grid = camera.scale, camera.height, camera.width
        self._layer, self._camera = layer, camera
        self._mesh = seen.points, layer.faces, layer.bodies
        self._look = seen.normals, flat_normals(seen.points, layer.faces), layer.colours
        self.spans = outlines(seen.points, layer.faces, layer.bodies, layer.solids, self.grid)

    @property
    def look(self) -> Any:
        """As `finish` takes it."""
        return *self._mesh, *self._look, self._layer.alphas, self._layer.rims

    @cached_property
    def _by_band(self) -> tuple[NDArray[np.int64], Ints32]:
        starts, spans = sorted_by_band(self.spans, _band_rows(self._camera), len(_bands(self._camera)))
        return starts, spans

    def of_band(self, band: int) -> Ints32:
        """The rows of ``spans`` that a band of the picture needs."""
        starts, spans = self._by_band
        return spans[starts[band] : starts[band + 1]]

    def put_opaque(self, shot: RasterShot, corner: tuple[int, int], spans: Ints32) -> None:
        """Draw what is opaque into a picture, where it is nearer than what is there; in place.

        Args:
            corner: Row and column of the whole picture at which it begins, multiples of ``SAMPLES``.
        """
        drawn = Drawn.empty(1, shot.depth.shape)
        self.draw(depth_before(shot.depth, self.grid, corner), drawn, corner, spans)
        self.shade(drawn, shot, corner)

    def draw(self, hidden: Floats32, drawn: Drawn, corner: tuple[int, int], spans: Ints32) -> None:
        """Find what every sample of a part of the picture shows.

        Args:
            hidden: Shape (h, w), of `depth_before`: what is there already.
            corner: Row and column of the whole picture at which it begins.
        """
        draw(*self._mesh, spans, self.grid, corner, hidden, *drawn)

    def shade(self, drawn: Drawn, shot: RasterShot, corner: tuple[int, int]) -> None:
        """Colour and depth of the samples for which a triangle was found, in place; ``corner`` is even."""
        place = tuple(LIGHT), self.grid, corner, drawn.inverse[0], drawn.triangle[0]
        shade_nearest(*self._mesh, *self._look, *place, shot.colour, shot.depth)

    def shells(self, before: Floats32, corner: tuple[int, int], spans: Ints32) -> Shells:
        """What is see-through, as far as nothing opaque hides it.

        Args:
            before: Depth of what is opaque in a part of the picture, shape (h, w), mm along the ray.
            corner: Row and column of the whole picture at which it begins, multiples of ``SAMPLES``.
        """
        drawn = Drawn.empty(MAX_SHELLS, before.shape)
        self.draw(depth_before(before, self.grid, corner), drawn, corner, spans)
        shells = Shells.empty(MAX_SHELLS, *before.shape)
        look: Any = (*self._look, self._layer.alphas, self._layer.rims, tuple(LIGHT), self.grid, corner)
        for shell in zip(*drawn, shells.colour, shells.alpha, shells.depth, strict=True):
            samples: Any = shell
            shade_shells(*self._mesh, *look, *samples)
        return shells


def opaque_shot(layer: Layer, camera: ViewCamera) -> RasterShot:
    """Everything opaque of one layer in the CT frame, at the camera's own resolution."""
    view, shot = View(layer, camera, posed(layer, camera)), _background(camera.height, camera.width)

    def draw_band(band: int, rows: slice) -> None:
        view.put_opaque(RasterShot(shot.colour[rows], shot.depth[rows]), (rows.start, 0), view.of_band(band))

    _in_bands(camera, draw_band)
    return shot


def shells_of(layer: Layer, camera: ViewCamera) -> Shells:
    """The shells of a see-through layer: the nearest hit of every sample first, then the one behind it, and so on.

    Args:
        layer: The surfaces, CT frame.
        camera: The samples are its pixels.
    """
    view = View(layer, camera, posed(layer, camera))
    depth = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    parts = _in_bands(camera, lambda band, rows: view.shells(depth[rows], (rows.start, 0), view.of_band(band)))
    most = max(int(np.isfinite(part.depth).any(axis=(1, 2)).sum()) for part in parts)
    joined = (np.concatenate([getattr(part, name)[:most] for part in parts], axis=1) for name in _SHELL_PARTS)
    return Shells(*joined)


def picture(opaque: Layer, translucents: Layer, camera: ViewCamera) -> NDArray[np.uint8]:
    """A scene in the CT frame in pixels, shape (h, w, 3): what is opaque, and what is see-through over it.

    Args:
        camera: Its pixels are the picture's; each is the mean of ``SAMPLES`` by ``SAMPLES``.
    """
    fine = camera.finer(SAMPLES)
    solid, glass = (View(layer, fine, posed(layer, fine)) for layer in (opaque, translucents))
    return np.concatenate(_in_bands(fine, lambda band, rows: _pixels(solid, glass, band, rows)))


def _pixels(solid: View, glass: View, band: int, rows: slice) -> NDArray[np.uint8]:
    """A band of a picture of what is opaque and of what is see-through before it, shape (h, w, 3)."""
    corner, size = (rows.start, 0), (rows.stop - rows.start, solid.grid[2])
    behind, shells = Drawn.empty(1, size), Drawn.empty(MAX_SHELLS, size)
    solid.draw(np.zeros(size, dtype=np.float32), behind, corner, solid.of_band(band))
    glass.draw(behind.inverse[0], shells, corner, glass.of_band(band))
    held = np.zeros((1 + MAX_SHELLS, SAMPLES * SAMPLES, 4), dtype=np.float32)  # what is not there is blended at 0
    pixels = np.empty((size[0] // SAMPLES, size[1] // SAMPLES, 3), dtype=np.uint8)
    place: Any = tuple(LIGHT), solid.grid, corner
    finish(solid.look, glass.look, *place, behind.triangle, shells.triangle, tuple(BACKGROUND), held, pixels)
    return pixels


def _background(height: int, width: int) -> RasterShot:
    colour = np.empty((height, width, 3), dtype=np.float32)
    colour[:] = BACKGROUND
    return RasterShot(colour, np.full((height, width), np.inf, dtype=np.float32))


def _band_rows(camera: ViewCamera) -> int:
    return max(1, BAND // (camera.width * SAMPLES)) * SAMPLES


def _bands(camera: ViewCamera) -> list[slice]:
    """The picture's rows, band by band, whole pixels of ``SAMPLES`` rows, from the top."""
    rows = _band_rows(camera)
    return [slice(top, min(top + rows, camera.height)) for top in range(0, camera.height, rows)]


def _in_bands(camera: ViewCamera, work: Callable[[int, slice], T]) -> list[T]:
    """Call a function with number and rows of every band, on several processors, and collect its results."""
    bands = _bands(camera)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, range(len(bands)), bands))


def _joined(arrays: Sequence[NDArray[Any]], dtype: type) -> NDArray[Any]:
    """Rows of three, one after the other; also of no array at all."""
    return np.concatenate([np.empty((0, 3), dtype=dtype), *arrays]).astype(dtype, copy=False)


class MovingPicture:
    """One view of what stands still, with bodies that move.

    Args:
        opaque: What stands still, CT frame.
        layers: What moves, each in its own frame. Of two in one place the first is seen.
        camera: Its pixels are the picture's.
    """

    def __init__(self, opaque: Layer, translucents: Layer, layers: Sequence[Layer], camera: ViewCamera) -> None:
        self._camera, self._layers = camera.finer(SAMPLES), tuple(layers)
        self._together = Layer([surface for layer in layers for surface in layer.surfaces])
        self._still, self._shells = opaque_shot(opaque, self._camera), shells_of(translucents, self._camera)
        self._picture = compose(self._still, self._shells)
        fine = self._camera
        self._hidden = depth_before(self._still.depth, (fine.scale, fine.height, fine.width), (0, 0))
        self._with_own_arrays()

    @property
    def still(self) -> NDArray[np.uint8]:
        """The picture without what moves, shape (h, w, 3)."""
        return self._picture

    def another(self) -> MovingPicture:
        """A copy of this picture for another thread; what does not move is shared."""
        made = copy(self)
        made._with_own_arrays()
        return made

    def _with_own_arrays(self) -> None:
        self._drawn = Drawn.empty(1, self._still.depth.shape)
        self.shot = RasterShot(self._still.colour.copy(), self._still.depth.copy())
        self.changed = NOWHERE

    def at(self, T_ct_layers: Sequence[Floats]) -> NDArray[np.uint8]:
        """The picture with what moves at its poses, each (4, 4), mm; shape (h, w, 3)."""
        self._take_away()
        seen = [posed(layer, self._camera, T) for layer, T in zip(self._layers, T_ct_layers, strict=True)]
        joined = Posed(*(np.concatenate(parts) for parts in zip(*seen, strict=True)))
        view = View(self._together, self._camera, joined)
        self.changed = _box(view)
        view.draw(self._hidden, self._drawn, (0, 0), view.spans)
        view.shade(*self._parts(), (self.changed.y0, self.changed.x0))
        picture = self._picture.copy()
        recompose(picture, self.shot, self._shells, self._still.depth, self.changed)
        return picture

    def _take_away(self) -> None:
        """What stands still, and nothing before it."""
        drawn, shot = self._parts()
        still = self._still.part(self.changed.slices)
        shot.colour[:], shot.depth[:] = still.colour, still.depth
        drawn.inverse[:], drawn.triangle[:] = 0.0, -1

    def _parts(self) -> tuple[Drawn, RasterShot]:
        """Where something changed."""
        part = self.changed.slices
        return self._drawn.part(part), self.shot.part(part)


def _box(view: View) -> PixelBox:
    """The part of a picture in which a view may show something, whole pixels."""
    if len(view.spans) == 0:
        return NOWHERE
    first, last, begin, end = view.spans[:, 1:].T
    top, left = (int(low.min()) // SAMPLES * SAMPLES for low in (first, begin))
    return PixelBox(left, top, int(end.max()) + 1, int(last.max()) + 1)


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
