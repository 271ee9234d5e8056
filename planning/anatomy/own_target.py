"""A target that lies in no structure, such as one in fat: what is hit is the ball of the case's hit radius about it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.labels.label_surface import field_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose

CELLS = 24
"""Along the ball's diameter."""
OWN_TARGET = "target.hit_radius_mm"
"""Where the ball comes from."""


def own_target(case: Case) -> Iterator[Structure]:
    """The target as a structure of its own, where the case names none that holds it."""
    if case.own_target and case.hit_radius_mm is not None:
        mesh = ball(case.target_ct, case.hit_radius_mm)
        yield Structure(case.target_structure, Role.TARGET, 0.0, mesh, OWN_TARGET)


def ball(middle_ct: Floats, radius_mm: float) -> TriangleMesh:
    """The surface of a ball, to a hundredth of its radius.

    Args:
        middle_ct: Shape (3,), mm.
        radius_mm: Its radius.
    """
    cell = 2.0 * radius_mm / CELLS
    count = CELLS + 3
    offset = (np.arange(count) - (count - 1) / 2) * cell
    x, y, z = np.meshgrid(offset, offset, offset, indexing="ij")
    field = radius_mm - np.sqrt(x**2 + y**2 + z**2)
    field[field == 0.0] = -np.finfo(np.float32).eps
    T_ct_index = pose(np.eye(3) * cell, middle_ct + offset[0])
    return field_surface(field / radius_mm, T_ct_index, where=OWN_TARGET)
