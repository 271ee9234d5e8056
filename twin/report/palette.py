"""Colours for what the pictures and the page show. Those of the verdicts stand beside the reasons."""

from __future__ import annotations

import re

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
    (118, 120, 196),
    (206, 128, 60),
    (126, 92, 150),
    (98, 150, 190),
    (196, 150, 120),
    (170, 166, 90),
    (186, 96, 130),
    (140, 110, 80),
)
"""For structures without a colour of custom, in order of appearance; right and left are one."""

ARTERY, VEIN, BONE, MUSCLE = (216, 101, 79), (0, 151, 206), (241, 214, 145), (176, 132, 122)

CUSTOM_COLOURS: tuple[tuple[str, Rgb], ...] = (
    ("lesion", (255, 205, 40)),
    ("tumor", (255, 205, 40)),
    ("tumour", (255, 205, 40)),
    ("metasta", (255, 205, 40)),
    ("cyst", (205, 205, 100)),
    ("pulmonary_vein", (186, 77, 64)),
    ("pulmonary_artery", (0, 122, 171)),
    ("portal", (122, 76, 178)),
    ("aorta", (224, 97, 76)),
    ("arter", ARTERY),
    ("brachiocephalic_trunk", ARTERY),
    ("vena", VEIN),
    ("vein", VEIN),
    ("hepatic_v", VEIN),
    ("muscle", MUSCLE),
    ("gluteus", MUSCLE),
    ("autochthon", MUSCLE),
    ("iliopsoas", MUSCLE),
    ("psoas", MUSCLE),
    ("trapezius", MUSCLE),
    ("quadriceps", MUSCLE),
    ("ureter", (247, 182, 164)),
    ("cartilage", (214, 214, 200)),
    ("costal", (214, 214, 200)),
    ("spinal_cord", (244, 214, 49)),
    ("nerve", (234, 202, 40)),
    ("vertebra", (226, 202, 134)),
    ("spine", (226, 202, 134)),
    ("sacrum", (212, 188, 102)),
    ("rib", (253, 232, 158)),
    ("sternum", (244, 217, 154)),
    ("skull", (241, 213, 144)),
    ("hip", BONE),
    ("femur", BONE),
    ("humerus", BONE),
    ("scapula", BONE),
    ("clavicula", (205, 179, 108)),
    ("clavicle", (205, 179, 108)),
    ("bone", BONE),
    ("brain", (250, 250, 225)),
    ("liver", (221, 130, 101)),
    ("adrenal", (249, 186, 150)),
    ("kidney", (185, 102, 83)),
    ("spleen", (157, 108, 162)),
    ("esophagus", (211, 171, 143)),
    ("oesophagus", (211, 171, 143)),
    ("stomach", (216, 132, 105)),
    ("duodenum", (255, 253, 229)),
    ("colon", (204, 168, 143)),
    ("bowel", (205, 167, 142)),
    ("gallbladder", (139, 150, 98)),
    ("pancreas", (249, 180, 111)),
    ("bladder", (222, 154, 132)),
    ("prostate", (230, 158, 140)),
    ("trachea", (182, 228, 255)),
    ("lung", (197, 165, 145)),
    ("heart", (206, 110, 84)),
    ("atri", (203, 108, 81)),
)
"""Part of a structure's name, colour; the first match counts.

The colours by which 3D Slicer shows anatomy (its GenericAnatomyColors of 2010), so that a structure looks here as
there. Three are not followed: a mass is green there, and green means safe here; cartilage has there the blue of a vein,
behind a see-through organ; muscles are muted, since they fill the picture. The portal vein is told from the veins that
drain the liver.
"""

SIDES = re.compile(r"(^|[_ ])(right|left|r|l)(?=[_ ]|$)")
"""Of a structure's name: both sides look alike."""


def reason_of(value: str) -> Reason:
    """The reason behind a value of ``Candidates.verdict.reason``."""
    return Reason(value)


def organ_colours(names: tuple[str, ...]) -> dict[str, Rgb]:
    """One colour for each structure name; by custom where there is one, else by turn."""
    colours: dict[str, Rgb] = {}
    spare: dict[str, Rgb] = {}
    for name in names:
        plain = name.lower().replace(" ", "_")
        custom = next((colour for part, colour in CUSTOM_COLOURS if part in plain), None)
        if custom is None:
            custom = spare.setdefault(SIDES.sub("", plain), ORGAN_COLOURS[len(spare) % len(ORGAN_COLOURS)])
        colours[name] = custom
    return colours


def safe_shades(fraction: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Greens for a share 0..1 of the clearance range, shape (n,) to (n, 3)."""
    fraction = np.clip(np.nan_to_num(fraction, nan=0.0), 0.0, 1.0)[..., None]
    return np.round(np.array(SAFE_LOW) * (1 - fraction) + np.array(SAFE_HIGH) * fraction).astype(np.uint8)
