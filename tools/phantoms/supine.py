"""A patient on a CT table, with what else a scan shows: arms, mattress, table, sheet and line, each of known shape.

LPS, mm; z along the bed, the patient on the back. The trunk is that of the embedded abdomen with a belly that changes
along the bed, as a patient's does; the image cuts it at head and feet.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.plant.scanner.image import Solid
from tools.phantoms import torso
from tools.phantoms.ct_image import AIR_HU, Grid, ScannedPart
from tools.phantoms.implicit import Field, capsule, ellipsoid, offset, within
from tools.phantoms.mesher import SamplingBox, marched

LESION_LPS_MM = (-55.0, 20.0, 0.0)
"""In the right half of the trunk, nearer to the back."""
BACK_MM = 106.0
"""Where the back ends: here the mattress begins, mm along y."""
TABLE_MM = BACK_MM + 32.0
"""Where the table begins."""
BELLY_MM, WAVE_MM = 8.0, 90.0
"""How much the belly's surface changes along the bed, and over which length. Without it the trunk is nearly a cylinder,
which no patient is, and a table that touches a patient is known by being one."""
LINE_GAP_MM = 14.0
"""How far the line runs in front of the trunk, mm."""
LOOK_MM, SURFACE_MM, FINE_MM, THIN_MM = 8.0, 5.0, 2.0, 160.0
"""Spacings at which surfaces are looked for and sampled, and of parts whose box is no thicker than the last."""
ROOM_MM = (330.0, 262.0, 132.0)
"""Half the edges of the box in which surfaces are looked for."""
Arms = Literal["down", "up", "none"]


def slab(low: tuple[float, float, float], high: tuple[float, float, float]) -> Field:
    """A box with edges along the axes."""
    a, b = np.array(low), np.array(high)

    def field(points: Floats) -> Floats:
        return np.asarray(np.maximum(a - points, points - b).max(axis=1))

    return field


def skin(points: Floats) -> Floats:
    """Field of the trunk: that of the embedded abdomen, up to ``BELLY_MM`` flatter in front, in waves along the bed."""
    front = np.clip(0.5 - points[:, 1] / 60.0, 0.0, 1.0)
    waves = 0.5 + 0.5 * np.sin(2.0 * np.pi * points[:, 2] / WAVE_MM)
    return np.asarray(torso.skin(points) + BELLY_MM * front * waves)


def trunk_parts() -> list[ScannedPart]:
    """Fat, muscle, spine and lesion of the trunk."""
    return [
        ScannedPart("trunk", skin, -100.0),
        ScannedPart("muscle", offset(torso.skin, -22.0), 45.0),
        ScannedPart("spine", capsule((0, 36, -300), (0, 36, 300), 21.0), 420.0),
        ScannedPart("lesion", ellipsoid(LESION_LPS_MM, (12, 12, 12)), 90.0),
    ]


def arm_parts(arms: Arms) -> list[ScannedPart]:
    """Both arms beside the trunk (with a gap), or over the head, where this scan does not see them; skin and bone."""
    if arms != "down":
        return []
    parts = []
    for side, x in (("left", 215.0), ("right", -215.0)):
        limb = capsule((x, 30, -320), (0.97 * x, 20, 320), 44.0, 40.0)
        bone = capsule((x, 30, -320), (0.97 * x, 20, 320), 12.0)
        parts += [ScannedPart(f"arm_{side}", limb, 20.0), ScannedPart(f"humerus_{side}", bone, 700.0)]
    return parts


def bed_parts(gap_mm: float = 0.0) -> list[ScannedPart]:
    """A mattress of foam in a cover, and a table of two shells about foam; so far behind the back, mm."""
    wide, long = 280.0, 400.0
    mattress = slab((-wide, BACK_MM + gap_mm, -long), (wide, TABLE_MM + gap_mm - 2.0, long))
    table = slab((-wide, TABLE_MM + gap_mm, -long), (wide, TABLE_MM + gap_mm + 40.0, long))
    return [
        ScannedPart("mattress", mattress, -120.0),
        ScannedPart("mattress_foam", offset(mattress, -2.0), -960.0),
        ScannedPart("table", table, 60.0),
        ScannedPart("table_foam", offset(table, -3.0), -930.0),
    ]


def cradle_parts(
    radius_mm: float = 300.0, thick_mm: float = 20.0, half_width_mm: float = 180.0, slope: float = 0.0
) -> list[ScannedPart]:
    """A cradle as dense as the body, bent about the bed's direction, into which the back is pressed; air beneath.

    By its slope it descends to the head, mm per mm, as a bed does in the images of a tilted gantry.
    """

    def beneath(points: Floats) -> Floats:
        y = points[:, 1] - slope * points[:, 2] - (BACK_MM - 10.0 - radius_mm)
        upper = radius_mm - np.hypot(points[:, 0], y)
        return np.asarray(np.maximum.reduce([upper, np.abs(points[:, 0]) - half_width_mm, -y]))

    def cradle(points: Floats) -> Floats:
        y = points[:, 1] - slope * points[:, 2] - (BACK_MM - 10.0 - radius_mm)
        lower = np.hypot(points[:, 0], y) - radius_mm - thick_mm
        return np.asarray(np.maximum(beneath(points), lower))

    return [ScannedPart("beneath", beneath, AIR_HU), ScannedPart("cradle", cradle, 20.0)]


def line_part() -> ScannedPart:
    """An infusion line of 5 mm across the front of the trunk."""
    front = -112.0 - LINE_GAP_MM
    return ScannedPart("line", capsule((-150, front, 30), (150, front, 30), 2.5), 80.0)


def sheet_part() -> ScannedPart:
    """A folded sheet of 6 mm over the front of the trunk, on its left."""
    band = within(offset(torso.skin, 18.0), [slab((20, -200, -400), (150, 0, 400))], 0.5)
    hollow = offset(torso.skin, 12.0)
    return ScannedPart("sheet", within(band, [lambda points: -hollow(points)], 0.5), -550.0)


def grid(spacing_mm: float = 4.0, slice_mm: float = 4.0) -> Grid:
    """A field of view of 600 x 380 x 160 mm: the whole width of patient and arms, part of the trunk's length."""
    spacing = (spacing_mm, spacing_mm, slice_mm)
    size = (600.0, 380.0, 160.0)
    shape = tuple(round(length / step) for length, step in zip(size, spacing, strict=True))
    return Grid((-300.0 + spacing_mm / 2, -190.0, -80.0), spacing, (shape[0], shape[1], shape[2]))


def solids(parts: Sequence[ScannedPart]) -> list[Solid]:
    """The same parts as surfaces, for the scanner; what is beyond the longest field of view is cut off."""
    ends = slab((-318.0, -250.0, -120.0), (318.0, 250.0, 120.0))
    return [Solid(part.name, _surface(within(part.field, [ends], 0.5)), part.hu) for part in parts]


def _surface(field: Field) -> TriangleMesh:
    """The zero set by marching cubes in the box about it, finer where that box is thin."""
    axes = (np.arange(-half, half + LOOK_MM, LOOK_MM) for half in ROOM_MM)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    near = nodes[field(nodes.reshape(-1, 3)).reshape(nodes.shape[:3]) < LOOK_MM]
    low, high = near.min(axis=0) - LOOK_MM, near.max(axis=0) + LOOK_MM
    spacing = FINE_MM if np.min(high - low) < THIN_MM else SURFACE_MM
    return marched(field, SamplingBox(tuple(low), tuple(high), spacing))
