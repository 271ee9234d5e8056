"""Colours for what the pictures and the page show. Those of the verdicts stand beside the reasons."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.reasons import Reason, Rgb

PNG_LEVEL = 3
"""How hard pictures are packed: a tenth larger than at Pillow's own 6, in half the time."""

SAFE_LOW: Rgb = (150, 224, 190)
"""Safe, with the least clearance of the safe region."""

SAFE_HIGH: Rgb = (0, 104, 74)
"""Safe, with the greatest clearance."""

CHOSEN: Rgb = (0, 0, 0)
NEEDLE: Rgb = (20, 20, 24)
HOLDER: Rgb = (70, 74, 82)
ARM: Rgb = (173, 183, 196)
TABLE: Rgb = (120, 110, 98)
OUTSIDE: Rgb = (128, 128, 140)
SKIN: Rgb = (226, 176, 148)
TARGET_POINT: Rgb = (214, 0, 30)

ORGAN_COLOURS: tuple[Rgb, ...] = (
    (166, 86, 70),
    (118, 120, 196),
    (206, 128, 60),
    (126, 92, 150),
    (98, 150, 190),
    (196, 150, 120),
    (150, 166, 90),
    (186, 96, 130),
    (90, 140, 140),
    (140, 110, 80),
)
"""For organs without a colour of custom, in order of appearance."""

CUSTOM_COLOURS: tuple[tuple[str, Rgb], ...] = (
    ("lesion", (255, 205, 40)),
    ("tumor", (255, 205, 40)),
    ("tumour", (255, 205, 40)),
    ("aorta", (205, 32, 44)),
    ("artery", (205, 32, 44)),
    ("portal", (122, 76, 178)),
    ("vena", (44, 88, 190)),
    ("vein", (44, 88, 190)),
    ("hepatic_v", (44, 88, 190)),
    ("ureter", (232, 220, 120)),
    ("rib", (232, 222, 198)),
    ("vertebra", (226, 214, 188)),
    ("spine", (226, 214, 188)),
    ("sacrum", (226, 214, 188)),
    ("hip", (226, 214, 188)),
    ("sternum", (232, 222, 198)),
    ("skull", (232, 222, 198)),
    ("bone", (232, 222, 198)),
    ("costal", (214, 214, 200)),
    ("liver", (150, 70, 56)),
    ("kidney", (176, 92, 92)),
    ("spleen", (140, 74, 120)),
    ("stomach", (222, 150, 130)),
    ("colon", (196, 146, 90)),
    ("bowel", (206, 160, 110)),
    ("duodenum", (206, 160, 110)),
    ("gallbladder", (92, 150, 70)),
    ("pancreas", (222, 184, 96)),
    ("lung", (226, 160, 176)),
    ("heart", (190, 60, 70)),
)
"""What books of anatomy use: part of a structure's name, colour; the first match counts."""


def reason_of(value: str) -> Reason:
    """The reason behind a value of ``Candidates.verdict.reason``."""
    return Reason(value)


def organ_colours(names: tuple[str, ...]) -> dict[str, Rgb]:
    """One colour for each structure name; by custom where there is one, else by turn."""
    colours: dict[str, Rgb] = {}
    spare = 0
    for name in names:
        custom = next((colour for part, colour in CUSTOM_COLOURS if part in name.lower()), None)
        if custom is None:
            custom = ORGAN_COLOURS[spare % len(ORGAN_COLOURS)]
            spare += 1
        colours[name] = custom
    return colours


def safe_shades(fraction: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Greens for a share 0..1 of the clearance range, shape (n,) to (n, 3)."""
    fraction = np.clip(np.nan_to_num(fraction, nan=0.0), 0.0, 1.0)[..., None]
    return np.round(np.array(SAFE_LOW) * (1 - fraction) + np.array(SAFE_HIGH) * fraction).astype(np.uint8)
