"""An arm's URDF with all that it names, read: its chain, its lengths and the shapes of its bodies."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from puncture_twin.planning.arm.urdf.chain import ArmChain, arm_chain
from puncture_twin.planning.arm.urdf.document import UrdfDocument, parse_urdf
from puncture_twin.planning.arm.urdf.lengths import ur_lengths
from puncture_twin.planning.arm.urdf.shapes import BodyShape, Read, body_shapes
from puncture_twin.planning.base.arrays import Floats

FLANGE = "tool0"
"""The link that ROS has for a UR's flange, z along the needle."""


@dataclass(frozen=True, eq=False)
class ArmUrdf:
    """A URDF that was found to be of an arm built as a UR.

    Attributes:
        text: The file's bytes.
        document: What it says.
        chain: Its six joints and seven bodies.
        lengths_mm: d1, a2, a3, d4, d5, d6.
        T_base_root: Shape (4, 4), mm: the URDF's root in the controller's base frame.
        shapes: Of each of the seven bodies, in its own frame.
    """

    text: bytes
    document: UrdfDocument
    chain: ArmChain
    lengths_mm: tuple[float, ...]
    T_base_root: Floats
    shapes: tuple[tuple[BodyShape, ...], ...]

    @property
    def where(self) -> Path:
        """The file, to which its addresses are relative."""
        return self.document.where

    @property
    def root(self) -> str:
        """Name of the root link."""
        return self.chain.bodies[0][0].link.name

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the six joints, as ROS has them."""
        return tuple(joint.name for joint in self.chain.joints)

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
        data: The file's bytes.
        where: The file.
        flange: Name of the link that carries the needle.
        read: Reads a mesh file by its address in the URDF.
        T_base_root: Shape (4, 4), mm: the root in the controller's base frame, where the URDF does not say it.

    Raises:
        InputError: It cannot be read whole, it is not built as a UR, or a shape is missing.
    """
    document = parse_urdf(data, where)
    chain = arm_chain(document, flange)
    found = ur_lengths(chain, document, T_base_root)
    shapes = body_shapes(chain, document, read)
    return ArmUrdf(data, document, chain, found.lengths_mm, found.T_base_root, shapes)
