"""The carton of Chen et al. 2019: a box with markers on it and three bolts inside, whose ends are the lesions.

Its frame: the box's inner corner is the origin, the inner edges are the axes, mm. From the paper (J. Xi'an
Jiaotong Univ. 53(4), 2019, DOI 10.7652/xjtuxb201904013, Tables 1 and 2): the markers, the lesions, the touched
points. Not in the paper and chosen here: walls of 10 mm (marker C and D lie at y = -10), the box's extent in x
and y, and that the bolts are cylinders of 4 mm radius that rise straight from the floor.
"""

from __future__ import annotations

import itertools
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.experiment.chen2019 import TABLE_1, TABLE_2, TABLE_4

LESIONS_CT_MM = MappingProxyType({name: TABLE_1[name] for name in "LMH"})
"""Table 1: the lesions, the middles of the bolts' upper ends."""
MARKERS_CT_MM = MappingProxyType({name: TABLE_1[name] for name in "ABC"})
"""Table 1: the markers used in the first setup."""
TOUCHED_BASE_MM = TABLE_2
"""Table 2: markers and lesions touched with the needle tip, in the robot's base frame."""
SETUP_2_MARKERS = MappingProxyType({name: TABLE_1[name] for name in "ABCDE"})
"""Table 1: the markers used in the second setup."""
TOUCHED_SETUP_2_BASE_MM = TABLE_4
"""Table 4: the same box elsewhere, five markers and lesion M, base frame."""
BOX_LOW_MM, BOX_HIGH_MM = (-10.0, -10.0, -10.0), (160.0, 210.0, 147.0)
_BOX_CELLS = (17, 22, 16)
_BOLT_RADIUS_MM = 4.0
_BOLT_SIDES = 64
_BOLT_RINGS_MM = 4.0
"""Height of one ring of a bolt's side: triangles stay well shaped."""


def carton_meshes() -> dict[str, TriangleMesh]:
    """The box as ``skin`` and the bolts, by name; closed, triangles outward, carton frame, mm."""
    bolts = {f"bolt_{name.lower()}": _bolt(np.array(end)) for name, end in LESIONS_CT_MM.items()}
    return {"skin": _box(), **bolts}


def _box() -> TriangleMesh:
    index: dict[tuple[int, ...], int] = {}
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for i, j in itertools.product(range(_BOX_CELLS[u]), range(_BOX_CELLS[v])):
            corners = []
            for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
                node = [0, 0, 0]
                node[axis], node[u], node[v] = side * _BOX_CELLS[axis], i + du, j + dv
                corners.append(index.setdefault(tuple(node), len(index)))
            a, b, c, d = corners if side else corners[::-1]
            faces += [(a, b, c), (a, c, d)]
    fraction = np.array(list(index)) / np.array(_BOX_CELLS)
    low, high = np.array(BOX_LOW_MM), np.array(BOX_HIGH_MM)
    return TriangleMesh(low + fraction * (high - low), np.array(faces, dtype=np.int32))


def _bolt(end: Floats) -> TriangleMesh:
    """A cylinder from the floor (z = 0) to its end; its corners lie on the true circle."""
    rings = round(float(end[2]) / _BOLT_RINGS_MM) + 1
    angle = 2 * np.pi * np.arange(_BOLT_SIDES) / _BOLT_SIDES
    circle = _BOLT_RADIUS_MM * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    heights = np.linspace(0.0, end[2], rings)
    side = [np.column_stack([end[:2] + circle, np.full(_BOLT_SIDES, z)]) for z in heights]
    middles = [[end[0], end[1], 0.0], [end[0], end[1], end[2]]]
    here, following = np.arange(_BOLT_SIDES), np.roll(np.arange(_BOLT_SIDES), -1)
    faces = []
    for ring in range(rings - 1):
        a, b = ring * _BOLT_SIDES + here, ring * _BOLT_SIDES + following
        faces += [np.stack([a, b, b + _BOLT_SIDES], axis=1), np.stack([a, b + _BOLT_SIDES, a + _BOLT_SIDES], axis=1)]
    foot = rings * _BOLT_SIDES
    top = (rings - 1) * _BOLT_SIDES
    faces.append(np.stack([np.full(_BOLT_SIDES, foot), following, here], axis=1))
    faces.append(np.stack([np.full(_BOLT_SIDES, foot + 1), top + here, top + following], axis=1))
    return TriangleMesh(np.concatenate([*side, middles]), np.concatenate(faces).astype(np.int32))
