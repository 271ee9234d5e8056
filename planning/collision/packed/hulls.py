"""The convex hulls of boxes and bodies as compiled code takes them, each once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.collision.bodies.body import Body
from puncture_twin.planning.collision.enclosures.prism import inscribed_prism
from puncture_twin.planning.collision.kernels.hulls import Hulls
from puncture_twin.planning.collision.packed.enclosed import enclosed
from puncture_twin.planning.collision.packed.frames import WORKCELL_FRAME, in_frame
from puncture_twin.planning.collision.packed.made_from import made_from
from puncture_twin.planning.collision.packed.ragged import by_axes, row_starts

NO_BOX = -1.0
"""Half sizes of what is no box."""

ROUND = ("holder", "needle")
"""Bodies that are cylinders: their hulls are prisms about them."""


class PackedHulls:
    """Convex hulls, each once: the boxes first."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._rows: dict[int, int] = {}
        self._boxes = list(boxes)
        self._names = {box.name: row for row, box in enumerate(boxes)}
        self._corners = [box.corners for box in boxes]
        self._rounded = [False] * len(boxes)
        self._frames = [WORKCELL_FRAME] * len(boxes)

    def box(self, name: str) -> int:
        """Row of the box of that name."""
        return self._names[name]

    def add(self, corners: Floats, body: Body) -> int:
        """Row of a hull of a body, which is added if it is new."""
        row = self._rows.setdefault(id(corners), len(self._corners))
        if row == len(self._corners):
            self._corners.append(in_frame(corners, body))
            self._rounded.append(body.name in ROUND)
            self._frames.append(body.frame)
        return row

    def packed(self, cache: Cache) -> tuple[Hulls, Floats, Floats]:
        """``hulls``, ``T_box_base`` and ``halves`` of :class:`ProofScene`."""
        corners, pieces = np.concatenate(self._corners), zip(self._corners, self._rounded, strict=True)
        inner = np.concatenate([inscribed_prism(piece) if about else piece for piece, about in pieces])
        count = len(self._boxes)
        boxes, bodies = enclosed(self._corners[:count]), self._corners[count:]
        arm = cache.arrays(made_from("hulls", bodies), lambda: enclosed(bodies), by=__name__)
        centres, radii, slack, sizes, few, degrees = (
            np.concatenate([boxes[key], arm[key]]) for key in ("centres", "radii", "slack", "sizes", "few", "degrees")
        )
        neighbours = np.concatenate([boxes["neighbours"], arm["neighbours"] + sum(map(len, self._corners[:count]))])
        poses, halves = np.tile(np.eye(4), (len(self._corners), 1, 1)), np.full((len(self._corners), 3), NO_BOX)
        for row, box in enumerate(self._boxes):
            poses[row], halves[row] = np.linalg.inv(box.T_base_box), np.asarray(box.size_mm) / 2.0
        starts, around = row_starts([len(piece) for piece in self._corners]), np.array(self._rounded)
        few_axes, frames = (by_axes(few), row_starts(sizes)), np.array(self._frames, dtype=np.int64)
        links = (row_starts(degrees), neighbours)
        hulls = Hulls(
            by_axes(corners), starts, *few_axes, slack, corners, inner, around, *links, centres, radii, frames
        )
        return hulls, poses, halves
