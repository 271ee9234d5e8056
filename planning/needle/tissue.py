"""What a needle passes on its way: tissues, layer by layer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True)
class Tissue:
    """One tissue, as a needle feels it.

    Attributes:
        stiffness_n_mm2: k, by which it holds the shaft: force by length of shaft and by deflection.
        cutting_n: Force at the tip while it cuts.
        friction_n_mm: Along the shaft, by length of it inside.
        capsule_n: Force at which its surface ruptures; 0 has none.
        capsule_mm: How far the surface is pushed in by then.
    """

    stiffness_n_mm2: float
    cutting_n: float = 0.0
    friction_n_mm: float = 0.0
    capsule_n: float = 0.0
    capsule_mm: float = 0.0


class Layer(NamedTuple):
    """A tissue from one depth to the next, mm from the skin along the path."""

    start_mm: float
    end_mm: float
    tissue: Tissue
