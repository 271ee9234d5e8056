"""What else the flange carries: a body of the user's own, such as a holder with its cable or a camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from puncture_twin.planning.arm.links import convex_pieces
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.mesh import TriangleMesh

SLABS = 6
"""Into how many slabs along its longest side a tool is cut before the hulls are taken: what is bent stays bent."""


@dataclass(frozen=True, eq=False)
class ToolBody:
    """A rigid body that is bolted to the flange.

    Attributes:
        mesh: Its surface, mm, in the flange's frame.
        file: The mesh's file.
        unit_mm: How many millimetres one unit of the file is.
        T_flange_file: Shape (4, 4), mm: the file's frame in the flange's.
        key: Where it is stated, for errors.
    """

    mesh: TriangleMesh
    file: Path
    unit_mm: float
    T_flange_file: Floats
    key: str

    @cached_property
    def pieces(self) -> tuple[TriangleMesh, ...]:
        """Convex pieces that together contain it: open or turned inside out, it is the same body.

        Raises:
            InputError: It is flat.
        """
        pieces = convex_pieces(self.mesh, SLABS)
        if not pieces:
            raise InputError("the mesh is flat", where=self.key, allowed="a body, not a sheet")
        return pieces

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ToolBody) and self.mesh.digest == other.mesh.digest

    def __hash__(self) -> int:
        return hash(self.mesh.digest)
