"""Spine, ribs, breastbone with its cartilages, and the wings of the pelvis."""

from __future__ import annotations

from functools import cache

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from tools.phantoms import torso
from tools.phantoms.implicit import Field, above, below, capsule, carve, mirrored, smooth_min, union, within
from tools.phantoms.sweep import ribbon

RIBS = (4, 5, 6, 7, 8, 9, 10, 11, 12)
RIB_HALF_HEIGHT_MM, RIB_HALF_THICKNESS_MM = 5.8, 3.4
_RIB_FALL_MM = {4: 55.0, 5: 64.0, 6: 74.0, 7: 86.0, 8: 99.0, 9: 110.0, 10: 113.0, 11: 72.0, 12: 36.0}
"""How much lower the front end of each rib lies than its head."""
_RIB_END_DEG = {4: 148.0, 5: 146.0, 6: 143.0, 7: 138.0, 8: 131.0, 9: 124.0, 10: 116.0, 11: 93.0, 12: 62.0}
"""Where each rib ends, as an angle about the body axis from the back."""
_RIB_START_DEG = 36.0
"""Where a rib reaches the cage surface; medially of it runs the neck, toward the spine."""
_SPINOUS_TIP_Y_MM = 93.0
"""No spinous process reaches farther back; the skin of the back lies about 10 mm behind it."""
_STERNUM_Z = (158.0, 236.0)
_CARTILAGE_GOAL = {5: 208.0, 6: 186.0, 7: 166.0}
"""Heights at which cartilages reach the breastbone; the others lean on the cartilage above."""


@cache
def spine() -> Field:
    """The column from T5 to the sacrum, discs and processes included."""
    arches = [(z, _arch(z)) for z in torso.VERTEBRA_Z]

    def field(points: Floats) -> Floats:
        value = _bodies(points)
        for z, arch in arches:
            near = np.abs(points[:, 2] - z) < 50.0
            value[near] = smooth_min(value[near], arch(points[near]), 5.0)
        return value

    return within(field, [above(2, torso.CONTENT_BOTTOM_MM), below(2, torso.CONTENT_TOP_MM)], 4.0)


def _bodies(points: Floats) -> Floats:
    x, y, z = points.T
    height = np.clip(z, -180.0, 280.0)
    number = np.interp(z, torso.VERTEBRA_Z, np.arange(len(torso.VERTEBRA_Z)))
    waist = 2.2 * np.cos(np.pi * number) ** 2
    width = torso.body_half_width(height) - waist
    depth = torso.body_half_depth(height) - waist
    radius = np.hypot(x, y - torso.spine_y(height))
    k = np.maximum(np.hypot(x / width, (y - torso.spine_y(height)) / depth), 1e-9)
    return np.asarray(radius * (1.0 - 1.0 / k))


def _arch(z: float) -> Field:
    """Pedicles, laminae, joints, transverse and spinous processes of one vertebra."""
    at = np.array([z])
    y, wide, deep = (float(f(at)[0]) for f in (torso.spine_y, torso.body_half_width, torso.body_half_depth))
    side = 0.62 * min(wide, 26.0)
    lumbar = z < 50.0
    reach, droop = (wide + 13.0, 2.0) if lumbar else (wide + 9.0, -1.0)
    half = [
        capsule((side, y + deep - 4, z + 5), (side, y + deep + 12, z + 3), 5.0),
        capsule((side, y + deep + 12, z + 2), (2.0, y + deep + 23, z - 6), 4.5),
        capsule((side + 2, y + deep + 13, z + 15), (side + 1, y + deep + 15, z - 15), 5.2),
        capsule((side + 2, y + deep + 13, z + 3), (reach, y + deep + 16 - droop, z + 5), 4.6, 3.6),
    ]
    back = min(y + deep + 40.0, _SPINOUS_TIP_Y_MM)
    tip = (0.0, back, z - 12) if lumbar else (0.0, back, z - 26)
    spinous = capsule((0.0, y + deep + 24, z - 5), tip, 4.4, 3.4)
    right = union(half, 4.0)
    return union([right, mirrored(right), spinous], 5.0)


def rib_path(number: int) -> Floats:
    """Middle line of a right rib, head to front end, shape (n, 3), mm."""
    head_z = torso.VERTEBRA_Z[18 - number] + 6.0
    angle = np.radians(np.linspace(_RIB_START_DEG, _RIB_END_DEG[number], 14))
    fraction = (angle - angle[0]) / (np.radians(150.0) - angle[0])
    full = (angle[-1] - angle[0]) / (np.radians(150.0) - angle[0])
    fall = _RIB_FALL_MM[number] * fraction * (0.6 + 0.4 * fraction) / (full * (0.6 + 0.4 * full))
    shaft = torso.on_cage(angle, head_z - 6.0 - fall)
    at = np.array([head_z])
    y, wide = float(torso.spine_y(at)[0]), float(torso.body_half_width(at)[0])
    neck = [[-wide - 6.0, y + 9.0, head_z], [-wide - 15.0, y + 18.0, head_z - 1.0]]
    return np.concatenate([neck, shaft])


@cache
def rib(number: int) -> Field:
    """One right rib."""
    path = rib_path(number)
    middle = path * [0.0, 0.0, 1.0]
    bar = ribbon(path, path - middle, RIB_HALF_HEIGHT_MM, RIB_HALF_THICKNESS_MM)
    cut = within(bar, [below(2, torso.CONTENT_TOP_MM)], 3.0)
    return carve(cut, [spine()], 1.5, 2.0)


@cache
def ribs_right() -> Field:
    """Ribs 4 to 12 of the right side."""
    return union([rib(number) for number in RIBS], 1.0)


@cache
def ribs_left() -> Field:
    """Ribs 4 to 12 of the left side, the mirror image of the right."""
    return mirrored(ribs_right())


@cache
def sternum() -> Field:
    """Lower part of the breastbone with the xiphoid."""
    z = np.linspace(*_STERNUM_Z, 8)
    path = torso.on_cage(np.full(len(z), np.pi), z)
    body = ribbon(path, np.tile([0.0, -1.0, 0.0], (len(z), 1)), 15.0, 4.6)
    tip = torso.on_cage(np.full(2, np.pi), np.array([160.0, 138.0]))
    xiphoid = ribbon(tip, np.tile([0.0, -1.0, 0.0], (2, 1)), 6.0, 3.2)
    return within(union([body, xiphoid], 8.0), [below(2, torso.CONTENT_TOP_MM)], 3.0)


@cache
def costal_cartilages() -> Field:
    """Cartilages of ribs 5 to 10, both sides: 5 to 7 reach the breastbone, 8 to 10 lean on the one above."""
    bars = [ribbon(path, path * [1.0, 1.0, 0.0], 5.4, 3.6) for path in map(_cartilage_path, range(5, 11))]
    right = union(bars, 4.0)
    both = union([right, mirrored(right)], 2.0)
    return carve(both, [sternum(), ribs_right(), ribs_left()], 0.8, 1.5)


def _cartilage_path(number: int) -> Floats:
    """From just beyond the rib's end to the breastbone, or to the middle of the cartilage above, shape (9, 3), mm."""
    start = np.array([np.radians(_RIB_END_DEG[number]) + 0.085, rib_path(number)[-1, 2] - 4.0])
    if number in _CARTILAGE_GOAL:
        goal = np.array([np.radians(170.0), _CARTILAGE_GOAL[number]])
    else:
        goal = _angle_and_height(_cartilage_path(number - 1)[4])
    fraction = np.linspace(0.0, 1.0, 9)
    angle = start[0] + fraction * (goal[0] - start[0])
    sag = -14.0 * np.sin(np.pi * fraction) * (1.0 - fraction)
    return torso.on_cage(angle, start[1] + (goal[1] - start[1]) * fraction**1.3 + sag)


def _angle_and_height(point: Floats) -> Floats:
    centre = torso.on_cage(np.array([0.0, np.pi]), np.full(2, point[2])).mean(axis=0)
    return np.array([np.arctan2(-point[0], point[1] - centre[1]), point[2]])


@cache
def hip_right() -> Field:
    """Upper part of the right iliac wing, a curved plate in the wall of the pelvis."""

    def plate(points: Floats) -> Floats:
        thickness = 4.2 + 2.0 * np.exp(-(((points[:, 2] - _crest(points)) / 12.0) ** 2))
        return np.asarray(np.abs(torso.cage(points) + 3.0) - thickness)

    def crest(points: Floats) -> Floats:
        return np.asarray((points[:, 2] - _crest(points)) * 0.85)

    def front(points: Floats) -> Floats:
        return np.asarray(-54.0 + 0.35 * np.maximum(-104.0 - points[:, 2], 0.0) - points[:, 1])

    limits = [crest, front, above(2, torso.CONTENT_BOTTOM_MM), below(0, -50.0)]
    return carve(within(plate, limits, 7.0), [spine()], 2.0, 3.0)


@cache
def hip_left() -> Field:
    """Upper part of the left iliac wing."""
    return mirrored(hip_right())


def _crest(points: Floats) -> Floats:
    """Height of the iliac crest over y, mm."""
    y = points[:, 1]
    return np.asarray(-78.0 - 40.0 * ((y - 12.0) / 62.0) ** 2)
