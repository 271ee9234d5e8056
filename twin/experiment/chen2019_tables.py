"""What Chen et al. 2019 measured: Tables 1, 2 and 4, mm.

Chen G. et al., "Robot-Assisted Puncture Positioning Methods under CT Navigation", J. Xi'an Jiaotong Univ. 53(4),
2019, DOI 10.7652/xjtuxb201904013.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

Point = tuple[float, float, float]

TABLE_1: Mapping[str, Point] = MappingProxyType(
    {
        "A": (10, 20, 147),
        "B": (110, 120, 147),
        "C": (60, -10, 80),
        "D": (90, -10, 20),
        "E": (20, 150, 147),
        "L": (50, 150, 39),
        "M": (50, 130, 63),
        "H": (50, 120, 76),
    }
)
"""Markers A-E and lesions L, M, H in the CT frame."""

TABLE_2: Mapping[str, Point] = MappingProxyType(
    {
        "A": (417.67, -291.23, 534.59),
        "B": (557.74, -272.83, 534.57),
        "C": (423.48, -231.41, 604.06),
        "L": (543.02, -336.48, 641.60),
        "M": (527.05, -324.48, 617.63),
        "H": (519.10, -318.38, 604.58),
    }
)
"""The same, touched by the robot, first placement of the box (setup 1), base frame."""

TABLE_4: Mapping[str, Point] = MappingProxyType(
    {
        "A": (465.15, -298.26, 533.71),
        "B": (602.02, -332.68, 533.97),
        "C": (492.55, -244.10, 602.28),
        "D": (518.62, -227.75, 661.64),
        "E": (540.74, -404.60, 533.96),
        "M": (554.23, -370.12, 617.50),
    }
)
"""Second placement (setup 2), base frame."""
