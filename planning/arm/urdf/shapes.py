"""What a URDF's collision shapes are as meshes, in mm: files as they are, boxes, cylinders and spheres from outside."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.urdf.chain import ArmChain
from puncture_twin.planning.arm.urdf.document import UrdfDocument, UrdfShape
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.meshes.mesh_files import MESH_SUFFIXES, parse_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, Up
from puncture_twin.planning.geometry.units import Unit

ROUND_SIDES = 48
"""Of the prism about a cylinder: up to 0.2 % wider than it is (0.1 mm at a radius of 50 mm)."""

Read = Callable[[str], bytes]
"""The content of a mesh file, by its address in the URDF."""


class BodyShape(NamedTuple):
    """A shape of one of the arm's bodies."""

    mesh: TriangleMesh
    """In the shape's own frame, mm."""
    T_body_shape: Floats
    """Shape (4, 4), mm."""


def body_shapes(chain: ArmChain, document: UrdfDocument, read: Read) -> tuple[tuple[BodyShape, ...], ...]:
    """The collision shapes of each of the arm's seven bodies.

    Args:
        chain: The arm.
        document: Its URDF.
        read: Reads a mesh file.

    Raises:
        InputError: A link is drawn without a shape for contacts, a body has none at all, something is fixed beyond the
            flange, or a mesh cannot be used.
    """
    found = []
    for number, members in enumerate(chain.bodies):
        shapes: list[BodyShape] = []
        for member in members:
            link, here = member.link, f"{document.where}: link '{member.link.name}'"
            if link.drawn and not link.collisions:
                what = "it is drawn, and has no shape for contacts"
                raise InputError(what, where=here, allowed="a <collision>; the mesh of its <visual> will do")
            if link.collisions and link.name in chain.beyond:
                what = f"it is fixed beyond the flange '{chain.flange}'"
                raise InputError(
                    what, where=here, allowed="the arm alone; what the flange carries is [tool] of the case"
                )
            shapes += [
                BodyShape(_mesh(shape, document, here, read), member.T_body_link @ shape.T_link_shape)
                for shape in link.collisions
            ]
        if not shapes:
            names = ", ".join(member.link.name for member in members)
            what = f"nothing has a collision shape between the joints {number} and {number + 1} (links {names})"
            raise InputError(what, where=document.where, allowed="one collision shape a link at least")
        found.append(tuple(shapes))
    return tuple(found)


def _mesh(shape: UrdfShape, document: UrdfDocument, here: str, read: Read) -> TriangleMesh:
    if shape.kind == "mesh":
        return _file(shape, document, here, read)
    if shape.kind == "box":
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * shape.size
    elif shape.kind == "cylinder":
        radius, length = shape.size
        corners = _about(radius, length)
    else:
        corners = _about(shape.size[0], 2.0 * shape.size[0])
    return _hull(corners)


def _file(shape: UrdfShape, document: UrdfDocument, here: str, read: Read) -> TriangleMesh:
    if Path(shape.address).suffix.lower() not in MESH_SUFFIXES:
        what = f"mesh '{shape.address}' is of a kind that is not read"
        raise InputError(what, where=here, allowed=f"a file ending in {', '.join(MESH_SUFFIXES)}, for contacts")
    path = document.where.parent / shape.address
    try:
        return parse_mesh(read(shape.address), path, unit=Unit.M, space=Space.LOCAL, up=Up.Z, stretch=shape.size)
    except InputError as error:
        what = f"mesh '{shape.address}': {error.what}"
        raise InputError(
            what, where=here, allowed=f'{error.allowed}; a URDF speaks metres, scale="0.001 0.001 0.001" reads mm'
        ) from error


def _about(radius: float, length: float) -> Floats:
    """Corners of the prism about a cylinder along z, mm; the one about a sphere is that of its cylinder."""
    turn = np.linspace(0.0, 2.0 * np.pi, ROUND_SIDES, endpoint=False)
    ring = radius / math.cos(math.pi / ROUND_SIDES) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-length / 2.0, length / 2.0)])


def _hull(corners: Floats) -> TriangleMesh:
    import trimesh  # here: it costs a third of a second, and few need it

    hull = trimesh.convex.convex_hull(corners)
    return TriangleMesh(np.asarray(hull.vertices), np.asarray(hull.faces))
