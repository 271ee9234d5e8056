"""A trunk drawn by a seed: skin, bones, vessels, organs and a lesion, as closed meshes.

LPS, mm; the patient on the back, the middle of the trunk at the origin. No anatomist's body: sections, curves and
sizes are drawn in wide ranges of adults, so that what holds for many of them does not depend on one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from tools.phantoms.outside_objects import loft, tube

HALF_LENGTH_MM = 190.0
"""Of the trunk; its ends are flat, as an image's are."""
SLICE_MM = 10.0
AROUND = 96
"""Corners of a section: of a half width of 190 mm they lie within 0.1 mm of the curve."""
UNDER_SKIN = 0.86
"""Where ribs run, of the way from the middle to the skin."""


class Organ(NamedTuple):
    """One structure of a drawn trunk: its role and margin as in a case (0 for none), its closed mesh, mm."""

    role: str
    margin_mm: float
    mesh: TriangleMesh


class Trunk(NamedTuple):
    """A drawn trunk: a skin that is flat at head and feet, and filled with so much; the lesion's middle (3,)."""

    skin: TriangleMesh
    skin_hu: float
    organs: dict[str, Organ]
    target: Floats


class _Shape(NamedTuple):
    """Half widths, half depths and middles of the sections at heights z, each shape (n,), and their roundness."""

    z: Floats
    wide: Floats
    deep: Floats
    y: Floats
    power: float

    def at(self, angle: Floats, z: Floats, inside: float = 1.0) -> Floats:
        """Points at angles from the left (0) over the front (pi / 2), so far out, shape (n, 3)."""
        wide, deep, y = (np.interp(z, self.z, one) for one in (self.wide, self.deep, self.y))
        cosine, sine = np.cos(angle), np.sin(angle)
        radius = (np.abs(cosine / wide) ** self.power + np.abs(sine / deep) ** self.power) ** (-1.0 / self.power)
        x, y = inside * radius * cosine, y - inside * radius * sine
        return np.stack([x, y, np.broadcast_to(z, angle.shape)], axis=-1)


def draw_trunk(rng: np.random.Generator) -> Trunk:
    """A trunk and what is in it."""
    shape = _shape(rng)
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    skin = loft(np.stack([shape.at(angle, np.full(AROUND, z)) for z in shape.z]))
    depth = float(np.interp(0.0, shape.z, shape.deep))
    side = rng.choice([-1.0, 1.0])
    target = np.array([side * rng.uniform(20.0, 75.0), rng.uniform(-0.25, 0.35) * depth, rng.uniform(-20.0, 20.0)])
    organs = {
        "lesion": Organ("target", 0.0, _ball(target, rng.uniform(7.0, 14.0))),
        ("spleen" if side > 0 else "liver"): Organ(
            "traverse", 0.0, _ball(target + rng.uniform(-8.0, 8.0, 3), rng.uniform(30.0, 45.0))
        ),
        "spine": Organ("avoid", 2.0, _rod(0.0, 0.45 * depth, rng.uniform(17.0, 24.0), rng)),
        "aorta": Organ("avoid", 5.0, _rod(rng.uniform(5.0, 15.0), 0.1 * depth, rng.uniform(8.0, 12.0), rng)),
    }
    away = -side * rng.uniform(60.0, 80.0)
    organs["kidney_" + ("left" if away > 0 else "right")] = Organ(
        "avoid", 3.0, _ball(np.array([away, 0.3 * depth, rng.uniform(-40.0, 40.0)]), rng.uniform(22.0, 30.0))
    )
    for number in range(int(rng.integers(0, 4))):
        one = rng.choice([-1.0, 1.0])
        organs[f"rib_{'left' if one > 0 else 'right'}_{number + 7}"] = Organ("avoid", 1.0, _rib(shape, one, rng))
    return Trunk(skin, float(rng.choice([-100.0, 20.0, 40.0])), organs, target)


def _shape(rng: np.random.Generator) -> _Shape:
    z = np.arange(-HALF_LENGTH_MM, HALF_LENGTH_MM + 1.0, SLICE_MM)
    wide = rng.uniform(130.0, 185.0) * (1.0 + _waves(z, 0.05, rng))
    deep = rng.uniform(0.58, 0.75) * wide.mean() * (1.0 + _waves(z, 0.07, rng))
    return _Shape(z, wide, deep, deep.mean() - deep + rng.uniform(-2.0, 2.0), float(rng.uniform(2.0, 2.6)))


def _waves(z: Floats, height: float, rng: np.random.Generator) -> Floats:
    """A smooth change along the body, no more than a height."""
    phases, lengths = rng.uniform(0.0, 2.0 * np.pi, 2), rng.uniform(220.0, 500.0, 2)
    return np.asarray(height / 2.0 * np.sin(2.0 * np.pi * z[:, None] / lengths + phases).sum(axis=1))


def _ball(centre: Floats, radius: float) -> TriangleMesh:
    lift = np.linspace(-np.pi / 2, np.pi / 2, 26)[1:-1]
    angle = 2.0 * np.pi * np.arange(48) / 48
    across, up = np.cos(lift)[:, None], np.broadcast_to(np.sin(lift)[:, None], (len(lift), 48))
    return loft(centre + radius * np.stack([across * np.cos(angle), across * np.sin(angle), up], axis=-1))


def _rod(x: float, y: float, radius: float, rng: np.random.Generator) -> TriangleMesh:
    """Along the body, in a slight curve."""
    z = np.arange(20.0 - HALF_LENGTH_MM, HALF_LENGTH_MM - 19.0, SLICE_MM)
    bend = rng.uniform(-6.0, 6.0, 2)[:, None] * np.cos(np.pi * z / HALF_LENGTH_MM)
    return tube(np.stack([x + bend[0], y + bend[1], z], axis=1), np.full(len(z), radius))


def _rib(shape: _Shape, side: float, rng: np.random.Generator) -> TriangleMesh:
    """From the back around a flank to the front, descending."""
    turn = np.linspace(-1.1, 1.1, 30)
    angle = turn if side > 0 else np.pi - turn
    z = rng.uniform(-60.0, 90.0) - rng.uniform(15.0, 45.0) * (turn + 1.1)
    return tube(shape.at(angle, z, UNDER_SKIN), np.full(30, rng.uniform(4.5, 6.5)))
