"""Aorta, vena cava, portal vein with its roots and branches, hepatic veins."""

from __future__ import annotations

from functools import cache

from tools.phantoms import bones, torso
from tools.phantoms.implicit import Field, above, below, carve, union, within
from tools.phantoms.sweep import tube

_ENDS = (above(2, torso.CONTENT_BOTTOM_MM + 14.0), below(2, torso.CONTENT_TOP_MM))


@cache
def aorta() -> Field:
    """From the chest to its fork before L4, with the common iliac arteries' beginnings."""
    trunk = tube(
        [(21, 37, 260), (21, 36, 215), (19, 32, 165), (13, 23, 115), (9, 13, 60), (8, 6, 0), (6, 3, -50), (3, 4, -80)],
        [12.5, 12.3, 12.0, 11.5, 10.8, 10.0, 9.6, 9.2],
    )
    left = tube([(3, 4, -78), (14, 8, -105), (32, 18, -140), (44, 26, -175)], [6.8, 5.8, 5.4, 5.2])
    right = tube([(3, 4, -78), (-8, 5, -105), (-28, 12, -140), (-42, 20, -175)], [6.8, 5.8, 5.4, 5.2])
    return within(union([trunk, left, right], 5.0), _ENDS, 3.0)


@cache
def vena_cava_inferior() -> Field:
    """From the junction of the iliac veins behind the liver to the right atrium."""
    path = [
        (-13, 11, -98), (-20, 8, -70), (-23, 5, -20), (-24, 4, 30), (-25, 9, 75), (-26, 9, 110), (-25, 4, 140),
        (-22, -6, 168),
    ]  # fmt: skip
    trunk = tube(path, [10.5, 10.8, 11.0, 11.2, 11.5, 12.0, 12.5, 12.0])
    left = tube([(-12, 12, -96), (6, 17, -118), (30, 29, -145), (40, 36, -175)], [7.5, 6.2, 5.8, 5.6])
    right = tube([(-15, 16, -96), (-26, 19, -120), (-40, 29, -148), (-48, 36, -175)], [7.5, 6.2, 5.8, 5.6])
    whole = within(union([trunk, left, right], 5.0), [_ENDS[0]], 3.0)
    return carve(whole, [aorta(), bones.spine()], 1.0, 3.0)


@cache
def portal_vein() -> Field:
    """Superior mesenteric and splenic vein, the trunk, and the branches to segments 2 to 8."""
    gate, right, left = (-26, -14, 60), (-43, -10, 67), (-12, -28, 76)
    front, back, umbilical = (-60, -22, 76), (-62, 12, 70), (2, -42, 88)
    tubes = [
        tube([(-2, -22, -90), (-3, -20, -50), (-2, -14, -15), (-1, -10, 16)], [4.2, 4.8, 5.4, 6.0]),
        tube([(-1, -10, 16), (22, -8, 34), (45, 5, 46), (72, 24, 66), (86, 32, 78)], [4.6, 4.4, 4.2, 3.8, 3.2]),
        tube([(-1, -10, 16), (-10, -12, 36), gate], [6.6, 6.8, 6.4]),
        tube([gate, (-34, -10, 64), right], [6.0, 5.4, 5.0]),
        tube([right, (-52, -16, 71), front], [4.6, 4.2, 3.8]),
        tube([front, (-66, -26, 92), (-72, -28, 112)], [3.5, 2.9, 2.2]),
        tube([front, (-68, -38, 64), (-78, -50, 46)], [3.4, 2.8, 2.1]),
        tube([right, (-52, 2, 68), back], [4.5, 4.1, 3.7]),
        tube([back, (-72, 24, 84), (-84, 32, 100)], [3.4, 2.9, 2.2]),
        tube([back, (-76, 20, 52), (-92, 26, 34)], [3.4, 2.8, 2.2]),
        tube([gate, (-20, -20, 70), left, umbilical], [5.4, 5.0, 4.8, 4.2]),
        tube([umbilical, (14, -56, 90), (26, -66, 92)], [3.4, 2.7, 2.1]),
        tube([umbilical, (14, -42, 96), (32, -46, 103)], [3.2, 2.6, 2.0]),
        tube([umbilical, (-10, -54, 86), (-22, -62, 74)], [3.2, 2.6, 2.0]),
    ]
    return carve(union(tubes, 3.0), [vena_cava_inferior(), aorta()], 1.5, 3.0)


@cache
def hepatic_veins() -> Field:
    """Right, middle and left hepatic vein with their side branches, ending at the wall of the vena cava."""
    mouth = (-27, -3, 133)
    tubes = [
        tube([(-30, 4, 130), (-52, 8, 120), (-76, 12, 98), (-94, 14, 72), (-104, 14, 48)], [5.6, 5.0, 4.2, 3.2, 2.2]),
        tube([(-76, 12, 98), (-92, 24, 98), (-106, 30, 92)], [3.0, 2.5, 2.0]),
        tube([(-52, 8, 120), (-70, -4, 126), (-86, -8, 122)], [2.9, 2.4, 2.0]),
        tube([mouth, (-34, -18, 118), (-42, -34, 96), (-50, -46, 70), (-58, -56, 44)], [5.0, 4.6, 3.9, 3.0, 2.1]),
        tube([(-42, -34, 96), (-30, -50, 92), (-20, -62, 92)], [2.8, 2.3, 1.9]),
        tube([mouth, (-12, -16, 124), (6, -24, 116), (28, -30, 111)], [4.6, 4.0, 3.3, 2.1]),
        tube([(-12, -16, 124), (-6, -36, 116), (4, -52, 108)], [2.9, 2.4, 2.0]),
    ]
    return carve(union(tubes, 3.0), [vena_cava_inferior(), portal_vein()], 0.4, 1.5)
