"""What lies in a scanner: closed surfaces with Hounsfield units, and the simple bodies of devices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose

SIDES = 64
"""Of a round body: its volume is that of the circle to 1.6e-3."""


class Solid(NamedTuple):
    """One body in the scanner; a later one fills the place of an earlier one.

    Attributes:
        name: What it is.
        mesh: Closed, mm.
        hu: What it is made of, Hounsfield units.
        label: Its number in its label map; 0 for what no segmentation names.
        layer: Which label map shows it: bodies that hold others have one of their own.
        whole: Its label leaves out no part of it, however thin.
    """

    name: str
    mesh: TriangleMesh
    hu: float
    label: int = 0
    layer: int = 0
    whole: bool = False


def check_closed(solid: Solid, where: str) -> Solid:
    """The solid, if it has an inside.

    Raises:
        InputError: Its surface is open.
    """
    if not solid.mesh.closed:
        raise InputError(f"'{solid.name}' has an open surface", where=where, allowed="closed surfaces")
    return solid


def ball(centre: Floats, diameter_mm: float) -> TriangleMesh:
    """A ball about a point (3,), mm."""
    mesh = trimesh.creation.icosphere(4, diameter_mm / 2)
    return TriangleMesh(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces))


def rod(start: Floats, end: Floats, diameter_mm: float) -> TriangleMesh:
    """A round rod between the middles of its flat ends, points (3,), mm: a needle, or a disc where it is short."""
    mesh = trimesh.creation.cylinder(diameter_mm / 2, segment=np.stack([start, end]), sections=SIDES)
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def box(centre: Floats, size_mm: Floats) -> TriangleMesh:
    """A box with edges along the axes, mm."""
    mesh = trimesh.creation.box(np.asarray(size_mm, dtype=float))
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)).transformed(pose(np.eye(3), centre))
