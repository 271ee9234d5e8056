"""Pictures without a screen: triangles drawn into a sample grid with depth, and shaded, by compiled code.

Opaque surfaces give one hit per sample; translucent surfaces (skin, corridor) are seen through, with up to
``MAX_SHELLS`` hits.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints32
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.raster.camera import ViewCamera
from puncture_twin.twin.report.raster.compositing import (
    NOWHERE,
    SAMPLES,
    PixelBox,
    RasterShot,
    TranslucentLayer,
    compose,
    empty_translucent,
)
from puncture_twin.twin.report.raster.line_of_sight import blocked
from puncture_twin.twin.report.raster.raster import depth_before, draw, outlines, sorted_by_band
from puncture_twin.twin.report.raster.shading import corner_normals, flat_normals, rotated, shade_nearest, shade_shells

Floats32 = NDArray[np.float32]
T = TypeVar("T")

MAX_SHELLS = 4
"""Layers of a translucent surface that are drawn: skin in, skin out, twice."""

LINE_OF_SIGHT_SLACK_MM = 2.0
"""A point this close behind a surface still counts as seen: points on the needle lie inside its bar."""

BACKGROUND = np.array([246.0, 247.0, 249.0], dtype=np.float32)

LIGHT = np.array([-0.45, 0.6, -1.0]) / np.linalg.norm([-0.45, 0.6, -1.0])
"""Over the viewer's left shoulder: right, up, forward."""

BAND = 120_000
"""Samples that are worked on at once: their arrays stay in the cache, and the bands share the processors."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with its look.

    Attributes:
        mesh: In the frame of the layer it belongs to, mm.
        colour: RGB, 0..255.
        alpha: Opacity where one looks straight at it; only translucent surfaces use it.
        rim: How much more opaque it is where one sees it edge-on.
    """

    mesh: TriangleMesh
    colour: Rgb
    alpha: float = 1.0
    rim: float = 2.5


class Layer:
    """Surfaces that move together, in their own frame. Of two in one place the first is seen.

    Args:
        surfaces: The surfaces, in one frame.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
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
        """Of the corners, shape (n, 3)."""
        return np.asarray(corner_normals(self.vertices, self.faces))

    def sees(self, eye: Floats, points: Floats) -> NDArray[np.bool_]:
        """Whether nothing of this layer lies between an eye and each point (n, 3), in the layer's frame."""
        return np.asarray(
            ~blocked(self.vertices, self.faces, np.asarray(eye), np.asarray(points), LINE_OF_SIGHT_SLACK_MM)
        )


class _View:
    """A layer as a camera has it before it: corners in the camera's frame, and where each triangle lies.

    Args:
        layer: The layer.
        camera: Its pixels are the samples.
        T_ct_layer: The layer's pose, shape (4, 4), mm; the CT frame itself when None.
    """

    def __init__(self, layer: Layer, camera: ViewCamera, T_ct_layer: Floats | None = None) -> None:
        turn, eye = camera.axes, np.asarray(camera.eye, dtype=float)
        if T_ct_layer is not None:
            turn, eye = camera.axes @ T_ct_layer[:3, :3], (eye - T_ct_layer[:3, 3]) @ T_ct_layer[:3, :3]
        self.points = rotated(layer.vertices, turn, eye)
        self._grid = camera.scale, camera.height, camera.width
        self._layer = layer
        self._mesh = self.points, layer.faces, layer.bodies
        normals = rotated(layer.normals, turn, np.zeros(3))
        self._look = normals, flat_normals(self.points, layer.faces), layer.colours
        self.spans = outlines(self.points, layer.faces, self._grid)
        self._starts, self._in_bands = sorted_by_band(self.spans, _band_rows(camera), len(_bands(camera)))

    def of_band(self, band: int) -> Ints32:
        """The rows of ``spans`` that a band of the picture needs."""
        return np.asarray(self._in_bands[self._starts[band] : self._starts[band + 1]])

    def put_opaque(self, shot: RasterShot, corner: tuple[int, int], spans: Ints32) -> None:
        """Draw what is opaque into a picture, where it is nearer than what is there; in place.

        Args:
            shot: A part of the picture.
            corner: Row and column of the whole picture at which it begins, multiples of ``SAMPLES``.
            spans: The triangles that it needs.
        """
        inverse, triangle = self._drawn(1, shot.depth, corner, spans)
        place = tuple(LIGHT), self._grid, corner, inverse[0], triangle[0]
        shade_nearest(*self._mesh, *self._look, *place, shot.colour, shot.depth)

    def shells(self, before: Floats32, corner: tuple[int, int], spans: Ints32) -> tuple[TranslucentLayer, ...]:
        """What is see-through, as far as nothing opaque hides it, nearest first.

        Args:
            before: Depth of what is opaque in a part of the picture, shape (h, w), mm along the ray.
            corner: Row and column of the whole picture at which it begins, multiples of ``SAMPLES``.
            spans: The triangles that it needs.
        """
        inverse, triangle = self._drawn(MAX_SHELLS, before, corner, spans)
        translucents = tuple(empty_translucent(before.shape) for _ in range(MAX_SHELLS))
        look: Any = (*self._look, self._layer.alphas, self._layer.rims, tuple(LIGHT), self._grid, corner)
        for translucent, *drawn in zip(translucents, inverse, triangle, strict=True):
            samples: Any = (*drawn, translucent.colour, translucent.alpha, translucent.depth)
            shade_shells(*self._mesh, *look, *samples)
        return translucents

    def _drawn(self, most: int, before: Floats32, corner: tuple[int, int], spans: Ints32) -> tuple[Floats32, Ints32]:
        """1/z and triangle of the nearest surfaces, shape (most, h, w), before what is opaque already."""
        size = (most, *before.shape)
        inverse, triangle = np.zeros(size, dtype=np.float32), np.full(size, -1, dtype=np.int32)
        hidden = depth_before(before, self._grid, corner)
        draw(*self._mesh, spans, self._grid, corner, hidden, inverse, triangle)
        return inverse, triangle


def opaque_shot(layer: Layer, camera: ViewCamera) -> RasterShot:
    """Everything opaque of one layer in the CT frame, at the camera's own resolution."""
    view, shot = _View(layer, camera), _background(camera.height, camera.width)

    def draw_band(band: int, rows: slice) -> None:
        view.put_opaque(RasterShot(shot.colour[rows], shot.depth[rows]), (rows.start, 0), view.of_band(band))

    _in_bands(camera, draw_band)
    return shot


def translucents_of(layer: Layer, camera: ViewCamera) -> tuple[TranslucentLayer, ...]:
    """The shells of a see-through layer: the nearest hit of every sample first, then the one behind it, and so on.

    Args:
        layer: The surfaces, CT frame.
        camera: Its pixels are the samples.
    """
    view, depth = _View(layer, camera), np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    parts = _in_bands(camera, lambda band, rows: view.shells(depth[rows], (rows.start, 0), view.of_band(band)))
    translucents = (
        TranslucentLayer(
            *(np.concatenate([getattr(part[k], name) for part in parts]) for name in ("colour", "alpha", "depth"))
        )
        for k in range(MAX_SHELLS)
    )
    return tuple(translucent for translucent in translucents if np.isfinite(translucent.depth).any())


def picture(opaque: Layer, translucents: Layer, camera: ViewCamera) -> NDArray[np.uint8]:
    """A scene in the CT frame in pixels, shape (h, w, 3): what is opaque, and what is see-through over it.

    Args:
        opaque: The opaque surfaces.
        translucents: The see-through ones.
        camera: Its pixels are the picture's; each is the mean of ``SAMPLES`` by ``SAMPLES``.
    """
    fine = camera.finer(SAMPLES)
    solid, glass = _View(opaque, fine), _View(translucents, fine)

    def draw_band(band: int, rows: slice) -> NDArray[np.uint8]:
        shot = _background(rows.stop - rows.start, fine.width)
        solid.put_opaque(shot, (rows.start, 0), solid.of_band(band))
        return compose(shot, glass.shells(shot.depth, (rows.start, 0), glass.of_band(band)))

    return np.concatenate(_in_bands(fine, draw_band))


def put_moving(shot: RasterShot, layer: Layer, T_ct_layer: Floats, camera: ViewCamera) -> PixelBox:
    """Draw one more rigid body into a shot, in place, where it is nearer than what is there.

    Args:
        shot: What is there already, at the camera's resolution; its arrays are written to.
        layer: The body, in its own frame.
        T_ct_layer: Its pose, shape (4, 4), mm.
        camera: The camera.

    Returns:
        Where something may have changed.
    """
    view = _View(layer, camera, T_ct_layer)
    if len(view.spans) == 0:
        return NOWHERE
    first, last, begin, end = view.spans[:, 1:].T
    top, left = (int(low.min()) // SAMPLES * SAMPLES for low in (first, begin))
    box = PixelBox(left, top, int(end.max()) + 1, int(last.max()) + 1)
    view.put_opaque(RasterShot(shot.colour[box.slices], shot.depth[box.slices]), (top, left), view.spans)
    return box


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
    """What a function makes of the number and the rows of every band; the processors share them."""
    bands = _bands(camera)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, range(len(bands)), bands))


def _joined(arrays: Sequence[NDArray[Any]], dtype: type) -> NDArray[Any]:
    """Rows of three, one after the other; also of no array at all."""
    return np.concatenate([np.empty((0, 3), dtype=dtype), *arrays]).astype(dtype, copy=False)
