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

NEEDLE: Rgb = (20, 20, 24)
HOLDER: Rgb = (70, 74, 82)
ARM: Rgb = (173, 183, 196)
TABLE: Rgb = (120, 110, 98)
OUTSIDE: Rgb = (128, 128, 140)
SKIN: Rgb = (226, 176, 148)
TARGET_POINT: Rgb = (214, 0, 30)

ORGAN_COLOURS: tuple[Rgb, ...] = (
    (178, 168, 220),
    (208, 190, 150),
    (118, 92, 62),
    (226, 140, 160),
    (206, 140, 124),
    (122, 98, 128),
    (232, 226, 232),
    (140, 124, 60),
)
"""For structures without a colour of custom, in order of appearance; right and left are one."""

LESION, ARTERY, VEIN, PORTAL = (255, 215, 6), (178, 54, 10), (0, 140, 226), (125, 60, 190)
"""What a needle is aimed at, and what bleeds: these are told from everything at a glance, by every reader."""

NERVE, BILE, URINE, BONE, MUSCLE = (255, 255, 160), (157, 154, 103), (230, 190, 230), (244, 229, 192), (131, 105, 100)
CARTILAGE, HEART = (188, 206, 186), (185, 39, 82)

CUSTOM_COLOURS: tuple[tuple[str, Rgb], ...] = (
    ("lesion", LESION),
    ("tumor", LESION),
    ("tumour", LESION),
    ("metasta", LESION),
    ("cyst", (205, 205, 100)),
    ("pulmonary_vein", ARTERY),
    ("pulmonary_artery", VEIN),
    ("portal", PORTAL),
    ("aorta", ARTERY),
    ("arter", ARTERY),
    ("carotid", ARTERY),
    ("brachiocephalic_trunk", ARTERY),
    ("vena", VEIN),
    ("vein", VEIN),
    ("cava", VEIN),
    ("jugular", VEIN),
    ("hepatic_v", VEIN),
    ("vessel", PORTAL),
    ("muscle", MUSCLE),
    ("gluteus", MUSCLE),
    ("autochthon", MUSCLE),
    ("iliopsoas", MUSCLE),
    ("psoas", MUSCLE),
    ("trapezius", MUSCLE),
    ("quadriceps", MUSCLE),
    ("ureter", URINE),
    ("cartilage", CARTILAGE),
    ("costal", CARTILAGE),
    ("spinal_cord", NERVE),
    ("nerve", NERVE),
    ("vertebra", BONE),
    ("spine", BONE),
    ("sacrum", BONE),
    ("rib", BONE),
    ("sternum", BONE),
    ("skull", BONE),
    ("hip", BONE),
    ("femur", BONE),
    ("humerus", BONE),
    ("scapula", BONE),
    ("clavicula", BONE),
    ("clavicle", BONE),
    ("bone", BONE),
    ("brain", (251, 222, 212)),
    ("bile", BILE),
    ("gallbladder", BILE),
    ("liver", (224, 124, 72)),
    ("adrenal", (255, 118, 114)),
    ("kidney", (177, 110, 102)),
    ("spleen", (150, 91, 122)),
    ("esophagus", (179, 142, 161)),
    ("oesophagus", (179, 142, 161)),
    ("stomach", (240, 147, 165)),
    ("duodenum", (251, 222, 212)),
    ("colon", (152, 122, 68)),
    ("bowel", (179, 159, 135)),
    ("pancreas", (243, 168, 87)),
    ("bladder", URINE),
    ("prostate", (225, 95, 150)),
    ("trachea", (222, 240, 255)),
    ("lung", (187, 194, 215)),
    ("heart", HEART),
    ("atri", HEART),
)
"""Part of a structure's name, colour; the first match counts.

Near the field's habits (arteries red, veins blue, bone ivory, bile olive), but as far apart as so many can be: the
colours that atlases give to organs are a dozen browns, in which a vessel is lost in the liver. Found by annealing over
CIEDE2000 as readers without and with protanopia or deuteranopia see them; ``tests/twin/report/test_colours.py`` states
what they keep. None is near the green that means safe, nor needle and region in the slices; muscles are muted, since
they fill the picture. The portal vein is told from the veins that drain the liver; vessels of no kind look as it.
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
