"""What moves, drawn over what stands still, and taken away again: one picture after the other of the same view."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.report.raster.camera import ViewCamera
from puncture_twin.twin.report.raster.compositing import (
    NOWHERE,
    SAMPLES,
    PixelBox,
    RasterShot,
    compose,
    recompose,
)
from puncture_twin.twin.report.raster.raster import depth_before
from puncture_twin.twin.report.raster.render import Drawn, Layer, Posed, View, opaque_shot, posed, shells_of


class MovingPicture:
    """One view of what stands still, with bodies that move.

    Args:
        opaque: What stands still, CT frame.
        translucents: What of it is see-through.
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

    @property
    def changed_pixels(self) -> PixelBox:
        """Where the last picture may differ from `still`."""
        left, top, right, bottom = self.changed
        return PixelBox(left // SAMPLES, top // SAMPLES, -(-right // SAMPLES), -(-bottom // SAMPLES))

    def another(self) -> MovingPicture:
        """The same picture for another thread: what stands still is shared."""
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
