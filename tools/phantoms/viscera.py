"""The soft organs. Each leaves room for those that came before it, so that no two overlap."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.planning.base.arrays import Floats
from tools.phantoms import bones, torso, vessels
from tools.phantoms.implicit import Field, above, below, carve, ellipsoid, mirrored, offset, union, within
from tools.phantoms.sweep import tube

LESION_CENTRE_LPS_MM = (-90.0, -10.0, 60.0)
"""Middle of the lesion, at the border of segments 5 and 6, and the target of the case."""
LESION_RADII_MM = (12.0, 10.5, 11.0)
_GAP_MM = 1.2
"""Room between neighbours: fat and wall."""
_BLEND_MM = 5.0


@cache
def lesion() -> Field:
    """An ellipsoid, so that its middle is known exactly."""
    return ellipsoid(LESION_CENTRE_LPS_MM, LESION_RADII_MM, Rotation.from_euler("z", 35.0, degrees=True))


def _kidney(centre: tuple[float, float, float]) -> Field:
    """A right kidney: upper pole inward and back, hilum inward and to the front."""
    turn = Rotation.from_euler("yxz", (13.0, -12.0, -28.0), degrees=True)
    bean = ellipsoid(centre, (28.0, 23.0, 55.0), turn)
    hilum = np.asarray(centre) + turn.apply([34.0, -6.0, -2.0])
    return carve(bean, [ellipsoid(hilum, (17.0, 14.0, 19.0), turn)], 0.1, 12.0)


@cache
def kidney_right() -> Field:
    """Right kidney, lower than the left."""
    return carve(_kidney((-64.0, 40.0, 6.0)), [torso.spinal_mass], 1.0, _BLEND_MM)


@cache
def kidney_left() -> Field:
    """Left kidney."""
    return carve(mirrored(_kidney((-64.0, 42.0, 24.0))), [torso.spinal_mass], 1.0, _BLEND_MM)


@cache
def gallbladder() -> Field:
    """A pear under the liver, fundus at its front edge."""
    return tube([(-50, -64, 18), (-46, -54, 27), (-39, -41, 40), (-32, -29, 52)], [13.5, 13.5, 10.0, 4.5])


@cache
def liver() -> Field:
    """Bounded by diaphragm, wall, and a visceral face that rises to the left and to the back."""
    space = within(torso.diaphragm, [torso.inside_cage(8.0), _visceral_face, _left_edge], 18.0)
    pressed = carve(space, [kidney_right(), vessels.vena_cava_inferior(), gallbladder(), oesophagus()], _GAP_MM, 4.0)
    return carve(pressed, [torso.spinal_mass, vessels.aorta()], 4.0, 8.0)


def _visceral_face(points: Floats) -> Floats:
    x, y, z = points.T
    face = 43.0 + 0.56 * (x + 20.0) + 0.42 * (y + 20.0)
    gate = 20.0 * np.exp(-(((x + 24.0) / 26.0) ** 2) - ((y + 8.0) / 22.0) ** 2)
    notch = 16.0 * np.exp(-(((x - 4.0) / 9.0) ** 2)) / (1.0 + np.exp((y + 30.0) / 8.0))
    return np.asarray((face + gate + notch - z) * 0.8)


def _left_edge(points: Floats) -> Floats:
    x, y, _ = points.T
    return np.asarray((x - 62.0) * 0.9 + 0.35 * (y + 40.0))


@cache
def spleen() -> Field:
    """Along the tenth rib, hollow toward stomach and kidney."""
    turn = Rotation.from_euler("x", 28.0, degrees=True)
    body = ellipsoid((94.0, 32.0, 90.0), (50.0, 45.0, 62.0), turn)
    crescent = carve(body, [torso.inside_cage(43.0)], 0.1, 14.0)
    space = within(crescent, [torso.inside_cage(8.0), offset(torso.diaphragm, -2.0)], 6.0)
    return carve(space, [kidney_left(), vessels.portal_vein(), torso.spinal_mass], _GAP_MM, 6.0)


@cache
def pancreas() -> Field:
    """Head in the bend of the duodenum, body before the spine, tail toward the spleen."""
    path = [(-26, -14, -8), (-24, -20, 10), (-6, -27, 24), (16, -25, 36), (42, -9, 46), (68, 12, 62), (80, 20, 72)]
    organ = tube(path, [13.0, 15.5, 11.5, 11.0, 11.0, 10.5, 8.5], folds_mm=0.8, fold_length_mm=11.0)
    others = [vessels.portal_vein(), vessels.vena_cava_inferior(), vessels.aorta(), liver(), spleen(), kidney_left()]
    return carve(organ, others, 1.0, 3.0)


@cache
def oesophagus() -> Field:
    """From behind the heart through the diaphragm to the stomach."""
    path = tube(
        [(4, 22, 262), (4, 19, 215), (5, 12, 170), (10, 4, 140), (20, 1, 124), (30, 3, 113)], [8, 8, 8, 7.5, 7.5, 7]
    )
    cut = within(path, [below(2, torso.CONTENT_TOP_MM)], 3.0)
    return carve(cut, [vessels.aorta(), torso.spinal_mass, vessels.vena_cava_inferior()], 1.0, 3.0)


@cache
def stomach() -> Field:
    """Fundus under the left dome, body in front, antrum across the middle."""
    path = [
        (60, 20, 106), (66, 4, 92), (66, -20, 68), (57, -42, 42), (40, -55, 20), (16, -58, 8), (-8, -52, 8),
        (-26, -42, 14),
    ]  # fmt: skip
    body = tube(path, [33.0, 35.0, 33.0, 29.0, 25.0, 20.0, 16.0, 11.0])
    space = within(body, [torso.inside_cage(9.0), offset(torso.diaphragm, -2.0)], 6.0)
    others = [liver(), spleen(), pancreas(), kidney_left(), oesophagus(), gallbladder(), vessels.portal_vein()]
    return carve(space, [*others, torso.spinal_mass], _GAP_MM, _BLEND_MM)


@cache
def duodenum() -> Field:
    """The C about the pancreas' head, crossing before the great vessels."""
    path = [
        (-34, -38, 16), (-44, -28, 22), (-50, -12, 12), (-50, -4, -12), (-44, -6, -36), (-20, -14, -46),
        (10, -14, -44), (30, -14, -30),
    ]  # fmt: skip
    organ = tube(path, [10.0, 12.0, 12.5, 12.5, 12.5, 11.5, 11.5, 11.0], folds_mm=1.0, fold_length_mm=9.0)
    solid = [liver(), pancreas(), stomach(), gallbladder(), kidney_right()]
    near = [vessels.aorta(), vessels.vena_cava_inferior(), vessels.portal_vein(), torso.spinal_mass]
    return carve(organ, [*solid, *near], _GAP_MM, 3.0)


@cache
def colon() -> Field:
    """Caecum, ascending, transverse hanging in front, splenic flexure, descending: the frame."""
    path = [
        (-82, -28, -146), (-92, -8, -112), (-98, 8, -72), (-98, 6, -40), (-86, -26, -26), (-66, -54, -36),
        (-30, -64, -50), (8, -66, -54), (48, -62, -40), (80, -44, -8), (95, -20, 26), (100, 12, 43),
        (104, 33, 16), (104, 28, -36), (102, 18, -90), (94, 0, -128), (84, -18, -146),
    ]  # fmt: skip
    radii = [27, 28, 26, 24, 22, 21, 20.5, 20, 20, 19.5, 19, 18.5, 17, 16, 15.5, 15.5, 15.5]
    organ = tube(path, radii, folds_mm=2.6, fold_length_mm=27.0)
    space = within(organ, [torso.inside_cage(11.0), offset(torso.diaphragm, -2.0)], 6.0)
    solid = [liver(), stomach(), spleen(), kidney_right(), kidney_left(), pancreas(), duodenum(), gallbladder()]
    return carve(space, [*solid, bones.hip_right(), bones.hip_left(), torso.spinal_mass], _GAP_MM, 3.0)


@cache
def small_bowel() -> Field:
    """Loops in the frame of the colon."""
    rows = [_loop_row(row, z) for row, z in enumerate((-86.0, -107.0, -128.0, -149.0))]
    turns = ((upper[-1], lower[0]) for upper, lower in pairwise(rows))
    links = [np.stack([a, (a + b) / 2 + [0.0, 6.0, 0.0], b]) for a, b in turns]
    organ = union([tube(path, 11.0) for path in [*rows, *links]], 5.0)
    space = within(organ, [torso.inside_cage(11.0), above(2, torso.CONTENT_BOTTOM_MM)], 4.0)
    near = [vessels.aorta(), vessels.vena_cava_inferior(), vessels.portal_vein(), torso.spinal_mass]
    return carve(space, [colon(), duodenum(), *near], _GAP_MM, 3.0)


def _loop_row(row: int, z: float) -> Floats:
    """Middle line of one row of loops, to the left in even rows and back in odd ones, shape (9, 3), mm."""
    i = np.arange(9)
    x = np.linspace(-50.0, 60.0, 9)[:: 1 if row % 2 == 0 else -1]
    return np.stack([x, -38.0 + 20.0 * np.cos(1.7 * i + row), z + 5.0 * np.sin(2.1 * i + row)], axis=1)


@cache
def heart() -> Field:
    """Lower part of the heart on the saddle of the diaphragm."""
    turn = Rotation.from_euler("zy", (24.0, 18.0), degrees=True)
    muscle = ellipsoid((22.0, -34.0, 186.0), (66.0, 44.0, 46.0), turn)
    space = within(muscle, [torso.inside_cage(10.0), below(2, torso.CONTENT_TOP_MM)], 6.0)
    near = [vessels.vena_cava_inferior(), vessels.aorta(), oesophagus(), offset(torso.diaphragm, 3.0)]
    return carve(space, near, 1.5, 6.0)


def _recess(points: Floats) -> Floats:
    """Lower end of the lungs: higher in front than behind, and highest beside the breastbone."""
    x, y, z = points.T
    front = 36.0 * np.exp(-((x / 55.0) ** 2)) / (1.0 + np.exp((y + 25.0) / 10.0))
    return np.asarray((82.0 - 0.26 * y + front - z) * 0.85)


def _lung(side: Field, ribs: Field) -> Field:
    space = within(torso.inside_cage(6.5), [side, _recess, below(2, torso.CONTENT_TOP_MM)], 8.0)
    near = [vessels.aorta(), oesophagus(), heart(), vessels.vena_cava_inferior(), torso.spinal_mass]
    return carve(carve(space, near, 2.5, 6.0), [torso.diaphragm, ribs], 2.0, 10.0)


@cache
def lung_right() -> Field:
    """Right lower lung with its hollow underside on the dome and the wedge behind and beside it."""
    return _lung(below(0, -9.0), bones.ribs_right())


@cache
def lung_left() -> Field:
    """Left lower lung."""
    return _lung(above(0, 12.0), bones.ribs_left())
