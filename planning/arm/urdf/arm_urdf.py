"""An arm's URDF with all that it names, read: its chain, its lengths and the shapes of its bodies."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.urdf.document import UrdfDocument, UrdfShape, parse_urdf
from puncture_twin.planning.arm.urdf.lengths import ArmChain, arm_chain, ur_lengths
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.formats.meshes.mesh_files import MESH_SUFFIXES, parse_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, Unit, Up

ROUND_SIDES = 48
"""Sides of the prism about a cylinder: up to 0.2 % wider than it is (0.1 mm at a radius of 50 mm)."""
Read = Callable[[str], bytes]
"""The content of a mesh file, by its address in the URDF."""


class BodyShape(NamedTuple):
    """A shape of one of the arm's bodies."""

    mesh: TriangleMesh  # in the shape's own frame, mm
    T_body_shape: Floats  # shape (4, 4), mm


def body_shapes(chain: ArmChain, document: UrdfDocument, read: Read) -> tuple[tuple[BodyShape, ...], ...]:
    """The collision shapes of each of the arm's seven bodies."""
    bodies = []
    for number, members in enumerate(chain.bodies):
        shapes: list[BodyShape] = []
        for member in members:
            link, where = member.link, f"{document.where}: link '{member.link.name}'"
            if link.drawn and not link.collisions:
                allowed = "a <collision>; the mesh of its <visual> is enough"
                refuse("it has a visual shape but no collision shape", where, allowed, "no_collision_shape")
            if link.collisions and link.name in chain.beyond:
                allowed = "only the arm; parts on the flange belong to [tool] of the case"
                refuse(f"it is fixed beyond the flange '{chain.flange}'", where, allowed, "shape_beyond_flange")
            shapes += [
                BodyShape(_mesh(shape, document, where, read), member.T_body_link @ shape.T_link_shape)
                for shape in link.collisions
            ]
        if not shapes:
            names = ", ".join(member.link.name for member in members)
            what = f"nothing has a collision shape between the joints {number} and {number + 1} (links {names})"
            refuse(what, document.where, "at least one collision shape per link", "no_collision_shape")
        bodies.append(tuple(shapes))
    return tuple(bodies)


def _mesh(shape: UrdfShape, document: UrdfDocument, where: str, read: Read) -> TriangleMesh:
    if shape.kind == "mesh":
        return _file(shape, document, where, read)
    if shape.kind == "box":
        return hull(np.array(list(product((-0.5, 0.5), repeat=3))) * shape.size)
    # of a sphere the prism is that about its cylinder
    radius, half = shape.size[0], shape.size[1] / 2.0 if shape.kind == "cylinder" else shape.size[0]
    return hull(ring_corners(radius / math.cos(math.pi / ROUND_SIDES), ROUND_SIDES, (-half, half)))


def _file(shape: UrdfShape, document: UrdfDocument, where: str, read: Read) -> TriangleMesh:
    if Path(shape.address).suffix.lower() not in MESH_SUFFIXES:
        allowed = f"a file ending in {', '.join(MESH_SUFFIXES)}, for contacts"
        refuse(f"mesh '{shape.address}' has an unsupported format", where, allowed, "unknown_format")
    path = document.where.parent / shape.address
    try:
        return parse_mesh(read(shape.address), path, unit=Unit.M, space=Space.LOCAL, up=Up.Z, stretch=shape.size)
    except InputError as error:
        what = f"mesh '{shape.address}': {error.what}"
        allowed = f'{error.allowed}; a URDF is in metres; scale="0.001 0.001 0.001" is for mm'
        raise InputError(what, where=where, allowed=allowed, code=error.code) from error


def ring_corners(radius_mm: float, sides: int, heights_mm: tuple[float, float]) -> Floats:
    """Corners of a prism of a regular polygon about z, between two heights: shape (2 ``sides``, 3), mm."""
    turn = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = radius_mm * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in heights_mm])


def hull(points: Floats) -> TriangleMesh:
    """The convex hull of points (n, 3) that do not lie in one plane, mm."""
    import trimesh  # here: it costs a third of a second, and few need it

    convex = trimesh.convex.convex_hull(points)
    return TriangleMesh(np.asarray(convex.vertices), np.asarray(convex.faces))


FLANGE = "tool0"
"""The link that ROS has for a UR's flange, z along the needle."""


@dataclass(frozen=True, eq=False)
class ArmUrdf:
    """The URDF of an arm that is built as a UR."""

    text: bytes
    document: UrdfDocument
    chain: ArmChain  # the document's six joints and seven bodies
    lengths_mm: tuple[float, ...]  # d1, a2, a3, d4, d5, d6
    T_base_root: Floats  # shape (4, 4), mm: the URDF's root in the controller's base frame
    shapes: tuple[tuple[BodyShape, ...], ...]  # of each of the seven bodies, in its own frame

    @property
    def where(self) -> Path:
        """Path of the file, to which its mesh addresses are relative."""
        return self.document.where

    @property
    def root(self) -> str:
        """Name of the root link."""
        return self.chain.bodies[0][0].link.name

    def body_poses(self, q: Floats) -> Floats:
        """T_base_body of the seven bodies at a configuration (6,), rad, shape (7, 4, 4), mm, by the URDF's chain."""
        return self.chain.body_poses(self.T_base_root, q)

    @cached_property
    def digest(self) -> str:
        """Hexadecimal SHA-256 of the URDF, its flange and its meshes."""
        digest = hashlib.sha256(self.text + self.chain.flange.encode())
        for shape in (one for body in self.shapes for one in body):
            digest.update(shape.mesh.digest.encode())
        return digest.hexdigest()


def read_arm_urdf(data: bytes, where: Path, *, flange: str, read: Read, T_base_root: Floats | None = None) -> ArmUrdf:
    """The arm of a URDF.

    Args:
        read: Reads a mesh file by its address in the URDF.
        T_base_root: Shape (4, 4), mm: the root in the controller's base frame, where the URDF does not say it.

    Raises:
        InputError: It cannot be read whole, it is not built as a UR, or a shape is missing.
    """
    document = parse_urdf(data, where)
    chain = arm_chain(document, flange)
    return ArmUrdf(data, document, chain, *ur_lengths(chain, document, T_base_root), body_shapes(chain, document, read))
