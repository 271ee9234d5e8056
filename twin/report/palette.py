"""Colours of pictures and page. Those of the verdicts stand beside the reasons."""

import re

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Rgb

PNG_LEVEL = 3  # how hard pictures are packed: a tenth larger than at Pillow's own 6, in half the time
SAFE_LOW: Rgb = (150, 224, 190)  # safe, with the least clearance of the safe region
SAFE_HIGH: Rgb = (0, 104, 74)  # safe, with the greatest clearance
NEEDLE: Rgb = (20, 20, 24)
HOLDER: Rgb = (70, 74, 82)
ARM: Rgb = (173, 183, 196)
TABLE: Rgb = (120, 110, 98)
OUTSIDE: Rgb = (128, 128, 140)
SKIN: Rgb = (226, 176, 148)
TARGET_POINT: Rgb = (214, 0, 30)
NEEDLE_COLOUR, REGION_COLOUR, BENT_COLOUR = (0, 229, 255), (255, 77, 240), (182, 255, 0)
"""Colours of the slices: on grey none is near a structure's colour."""

ORGAN_COLOURS: tuple[Rgb, ...] = (  # for structures without a colour of custom, in order; right and left are one
    (178, 168, 220), (208, 190, 150), (118, 92, 62), (226, 140, 160),
    (206, 140, 124), (122, 98, 128), (232, 226, 232), (140, 124, 60),
)  # fmt: skip

LESION, ARTERY, VEIN, PORTAL = (255, 215, 6), (178, 54, 10), (0, 140, 226), (125, 60, 190)
"""Colours of a needle's aim and what bleeds: these are told from everything at a glance, by every reader."""

NERVE, BILE, URINE, BONE, MUSCLE = (255, 255, 160), (157, 154, 103), (230, 190, 230), (244, 229, 192), (131, 105, 100)
CARTILAGE, HEART = (188, 206, 186), (185, 39, 82)

CUSTOM_COLOURS: tuple[tuple[Rgb, str], ...] = (
    (LESION, "lesion tumor tumour metasta"),
    ((205, 205, 100), "cyst"),
    (ARTERY, "pulmonary_vein"),
    (VEIN, "pulmonary_artery"),
    (PORTAL, "portal"),
    (ARTERY, "aorta arter carotid brachiocephalic_trunk"),
    (VEIN, "vena vein cava jugular hepatic_v"),
    (PORTAL, "vessel"),
    (MUSCLE, "muscle gluteus autochthon iliopsoas psoas trapezius quadriceps"),
    (URINE, "ureter"),
    (CARTILAGE, "cartilage costal"),
    (NERVE, "spinal_cord nerve"),
    (BONE, "vertebra spine sacrum rib sternum skull hip femur humerus scapula clavicula clavicle bone"),
    ((251, 222, 212), "brain"),
    (BILE, "bile gallbladder"),
    ((224, 124, 72), "liver"),
    ((255, 118, 114), "adrenal"),
    ((177, 110, 102), "kidney"),
    ((150, 91, 122), "spleen"),
    ((179, 142, 161), "esophagus oesophagus"),
    ((240, 147, 165), "stomach"),
    ((251, 222, 212), "duodenum"),
    ((152, 122, 68), "colon"),
    ((179, 159, 135), "bowel"),
    ((243, 168, 87), "pancreas"),
    (URINE, "bladder"),
    ((225, 95, 150), "prostate"),
    ((222, 240, 255), "trachea"),
    ((187, 194, 215), "lung"),
    (HEART, "heart atri"),
)
"""Colour, parts of structures' names; the first match counts.

Near the field's habits (arteries red, veins blue, bone ivory, bile olive), but as far apart as so many can be: the
colours that atlases give to organs are a dozen browns, in which a vessel is lost in the liver. Found by annealing over
CIEDE2000 as readers without and with protanopia or deuteranopia see them; ``tests/twin/report/test_colours.py`` states
what they keep. None is near the green that means safe, nor needle and region in the slices; muscles are muted, since
they fill the picture. The portal vein is told from the veins that drain the liver; vessels of no kind look as it.
"""

SIDES = re.compile(r"(^|[_ ])(right|left|r|l)(?=[_ ]|$)")  # of a structure's name: both sides look alike


def organ_colours(names: tuple[str, ...]) -> dict[str, Rgb]:
    """One colour for each structure name; by custom where there is one, else by turn."""
    colours: dict[str, Rgb] = {}
    spare: dict[str, Rgb] = {}
    for name in names:
        plain = name.lower().replace(" ", "_")
        custom = next((colour for colour, parts in CUSTOM_COLOURS if any(one in plain for one in parts.split())), None)
        if custom is None:
            custom = spare.setdefault(SIDES.sub("", plain), ORGAN_COLOURS[len(spare) % len(ORGAN_COLOURS)])
        colours[name] = custom
    return colours


def safe_shades(fraction: Floats) -> NDArray[np.uint8]:
    """Greens for a fraction 0..1 of the clearance range, shape (n,) to (n, 3)."""
    fraction = np.clip(np.nan_to_num(fraction, nan=0.0), 0.0, 1.0)[..., None]
    return np.round(np.array(SAFE_LOW) * (1 - fraction) + np.array(SAFE_HIGH) * fraction).astype(np.uint8)
