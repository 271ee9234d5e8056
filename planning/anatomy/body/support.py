"""What the body lies on, and the faces of a CT beyond which nothing is known because the image does not show all of it.

A patient does not float: what they lie on, and the arms beside them, may begin right beyond a face of the image. A
face near the body counts as air only where the image shows what the body lies on, and that it ends before this face.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.body.drawn_side import DrawnSide, support_side
from puncture_twin.planning.anatomy.body.flat_side import SIDES, FlatSide
from puncture_twin.planning.base.arrays import Bools, Floats

NEAR_MM = 60.0
"""A face is near the body up to this distance. Mattresses are at most some 50 mm thick; of their foam a CT shows
nothing that is denser than air."""
CUT_FRACTION = 0.5
"""A face cuts what the body lies on where something outside of the body ends at it in so many of the slices."""


Side = tuple[int, int]
"""Axis and end of a face, as `planning.flat_side.SIDES` names them."""
FACES: tuple[Side, ...] = tuple(itertools.product((0, 1), (0, -1)))
"""The faces of an image beside the bed's two ends."""


class Support(NamedTuple):
    """What a body lies on.

    Attributes:
        drawn: Its far side, where it does not hold together with the body; one or none.
        seen: Whether the image shows any, there or as one with the body.
        open_faces: Faces beyond which nothing is known, apart from those that are known to cut a body which lies on
            something that is seen.
    """

    drawn: tuple[DrawnSide, ...]
    seen: bool
    open_faces: tuple[Side, ...]


def find_support(
    outside: Bools, body: Bools, spacing_mm: Floats, touching: Sequence[FlatSide | DrawnSide] = ()
) -> Support:
    """What the body lies on, and the faces of the image beyond which nothing is known.

    Args:
        outside: Shape (nx, ny, nz), what was scanned, lies outside of the body and is not air; axis 2 along the bed.
        body: Same shape.
        spacing_mm: Shape (3,).
        touching: Tables that hold together with the body, so that they are not outside of it.
    """
    side = support_side(outside, body, spacing_mm)
    drawn = () if side is None else (side,)
    whole = [side for side in (*drawn, *touching) if not isinstance(side, DrawnSide) or side.whole]
    supports = {(side.axis, side.end) for side in whole}
    cut = [face for face in FACES if _cuts(outside, face) and any(face[0] != axis for axis, _ in supports)]
    faces = cut if supports else FACES
    gaps = {face: _gap_mm(body, face, spacing_mm) for face in faces}
    near = tuple(face for face, gap in gaps.items() if gap <= NEAR_MM and not (supports and gap == 0.0))
    return Support(drawn, bool(supports), near)


def support_warnings(seen: bool, open_faces: Sequence[Side]) -> Iterator[str]:
    """One sentence, where the image does not show all of what the body lies on.

    Args:
        seen: Whether it shows anything of it.
        open_faces: The faces beyond which nothing is known.
    """
    names = " and ".join(SIDES[face] for face in open_faces)
    beyond = f"what is beyond its {names} face, within {NEAR_MM:g} mm of the body, is unknown_region (outside_body)"
    if not seen:
        far = f"beyond its faces, more than {NEAR_MM:g} mm from the body, counts as air"
        yield f"the CT shows nothing that the body lies on; {beyond if open_faces else far}"
    elif open_faces:
        yield f"the CT cuts what the body lies on; {beyond}"


def _cuts(outside: Bools, face: Side) -> bool:
    axis, end = face
    return bool(outside.take(end, axis=axis).any(axis=0).mean() >= CUT_FRACTION)


def _gap_mm(body: Bools, face: Side, spacing_mm: Floats) -> float:
    """From the body to a face of the image; 0 where the face cuts it."""
    axis, end = face
    occupied = np.flatnonzero(body.any(axis=(1 - axis, 2)))
    voxels = occupied[0] if end == 0 else body.shape[axis] - 1 - occupied[-1]
    return float(voxels * spacing_mm[axis])
