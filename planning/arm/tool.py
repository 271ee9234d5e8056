"""What the arm carries and what stands about it: needle holder and needle, and the workcell's boxes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from puncture_twin.planning.arm.tool_body import ToolBody
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import apply

HOLDER_ROOT_MM = 5.0
"""How far the holder's body reaches back into wrist 3, whose mesh ends up to 1.4 mm before the flange plane: without
an overlap a flat surface could pass between the two unseen."""

NEEDLE_ROOT_MM = 1.0
"""How far the needle's body reaches back into the holder, for the same reason."""


@dataclass(frozen=True)
class Tool:
    """Needle and holder. The holder is a cylinder from the flange along +z; the needle goes on from it to the tip.

    Attributes:
        needle_length_mm: Flange to tip.
        shaft_mm: Usable length: from the holder's end to the tip.
        needle_diameter_mm: Diameter of the needle.
        holder_diameter_mm: Diameter of the holder.
        body: What the flange carries beside them, or None.

    Raises:
        InputError: If a length is not finite and positive, or the shaft is longer than the needle.
    """

    needle_length_mm: float
    shaft_mm: float
    needle_diameter_mm: float
    holder_diameter_mm: float
    body: ToolBody | None = None

    def __post_init__(self) -> None:
        for name in ("needle_length_mm", "shaft_mm", "needle_diameter_mm", "holder_diameter_mm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"{name} = {value}", where="tool", allowed="finite and above 0")
        if self.shaft_mm > self.needle_length_mm:
            raise InputError(
                f"shaft_mm = {self.shaft_mm}",
                where="tool",
                allowed=f"at most needle_length_mm = {self.needle_length_mm}",
            )

    @property
    def holder_length_mm(self) -> float:
        """From the flange to where the needle leaves the holder, mm."""
        return self.needle_length_mm - self.shaft_mm

    @property
    def holder_span_mm(self) -> tuple[float, float]:
        """Where the holder's body begins and ends on the flange's z axis, mm."""
        return (-HOLDER_ROOT_MM, self.holder_length_mm)

    @property
    def needle_span_mm(self) -> tuple[float, float]:
        """Where the needle's body begins and ends on the flange's z axis, mm."""
        return (self.holder_length_mm - NEEDLE_ROOT_MM, self.needle_length_mm)


@dataclass(frozen=True, eq=False)
class Box:
    """A solid cuboid in the workcell, such as the table.

    Attributes:
        name: What contacts call it.
        T_base_box: Shape (4, 4), mm: the box's centre and axes in the base frame.
        size_mm: Full edge lengths along its axes.

    Raises:
        InputError: If the pose is not rigid or a size not positive.
    """

    name: str
    T_base_box: Floats
    size_mm: tuple[float, float, float]

    def __post_init__(self) -> None:
        T = np.array(self.T_base_box, dtype=np.float64)
        rigid = T.shape == (4, 4) and bool(np.isfinite(T).all())
        rigid = rigid and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9) and np.linalg.det(T[:3, :3]) > 0
        if not rigid:
            raise InputError("T_base_box is not rigid", where=f"box {self.name!r}", allowed="rotation and mm")
        if not all(np.isfinite(edge) and edge > 0.0 for edge in self.size_mm):
            raise InputError(f"size_mm = {self.size_mm}", where=f"box {self.name!r}", allowed="three lengths above 0")
        T.setflags(write=False)
        object.__setattr__(self, "T_base_box", T)

    @property
    def corners(self) -> Floats:
        """Its eight corners, base frame, shape (8, 3), mm."""
        local = np.array(list(product((-0.5, 0.5), repeat=3))) * self.size_mm
        return np.asarray(apply(self.T_base_box, local))

    @property
    def bounds(self) -> Floats:
        """Lowest and highest corner of the axis-aligned box about it, base frame, shape (2, 3), mm."""
        half = np.abs(self.T_base_box[:3, :3]) @ (np.asarray(self.size_mm) / 2.0)
        return np.stack([self.T_base_box[:3, 3] - half, self.T_base_box[:3, 3] + half])
