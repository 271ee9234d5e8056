"""Names that say by every one of their words that a needle may cross what they name: an organ of solid tissue.

A word that is not in these lists may be anything: "liver veins", ``A. pulmonalis`` and ``Lungenvene`` are named after
organs that a needle crosses, and are none. So what is not told wholly is not crossed.
"""

from __future__ import annotations

import re

from puncture_twin.planning.anatomy.default_roles import plain_name

ORGANS = frozenset(
    (
        *("liver", "spleen", "pancreas", "kidney", "kidneys", "lung", "lungs", "adrenal", "adrenals", "thyroid"),
        *("parotid", "submandibular", "thymus", "prostate", "uterus", "ovary", "testis", "breast", "breasts", "gland"),
        *("glands", "node", "nodes", "brain", "cerebrum", "cerebellum", "hemisphere", "matter"),
    )
)
"""Organs of solid tissue: a lesion lies in them, and a path to it leads through them."""

LESIONS = frozenset(
    (
        *("lesion", "lesions", "laesion", "lasion", "tumor", "tumors", "tumour", "tumours", "tumeur", "nodule"),
        *("nodules", "metastasis", "metastases", "metastase", "metastasen", "carcinoma", "neoplasm", "neoplasia"),
        *("cancer", "mass", "gtv", "ctv", "itv", "ptv", "hcc"),
    )
)
"""Lesions, as whole words: a ``Tumorvene`` is none."""

BONES = frozenset(
    (
        *("bone", "bones", "rib", "ribs", "vertebra", "vertebrae", "sternum"),
        *("hip", "ilium", "ischium", "pubis", "sacrum", "femur", "tibia", "fibula", "patella", "humerus"),
        *("radius", "ulna", "scapula", "clavicle", "clavicula", "skull", "cranium", "mandible", "maxilla"),
    )
)
"""Bones; of the spine the vertebrae alone, since a spine may hold its cord."""

SOFT_TISSUES = frozenset(
    (
        *("muscle", "muscles", "gluteus", "autochthon", "iliopsoas", "psoas", "pectoralis", "quadriceps", "rectus"),
        *("oblique", "latissimus", "trapezius", "deltoid", "serratus", "erector"),
        *("sartorius", "thigh", "levator", "sternocleidomastoid", "platysma", "scalenus", "scalene"),
        *("digastric", "masseter", "temporalis", "fat", "adipose", "subcutaneous"),
    )
)
"""Muscles and fat, which needles pass."""

QUALIFIERS = frozenset(
    (
        *("left", "right", "l", "r", "upper", "middle", "lower", "superior", "inferior", "anterior", "posterior"),
        *("medial", "lateral", "internal", "external", "intermediate", "major", "minor", "maximus", "medius"),
        *("minimus", "lobe", "lobes", "segment", "segments", "section", "cortex", "parenchyma", "tissue"),
        *(
            "cerebral",
            "cerebellar",
            "lymph",
            "abdominis",
            "femoris",
            "spinae",
            "ani",
            "white",
            "grey",
            "gray",
            "head",
            "neck",
            "body",
            "tail",
            "whole",
            "of",
            "the",
        ),
        *("and", "costal", "skeletal", "torso", "visceral", "intermuscular", "compartment", "dorsi", "scapulae"),
        *("externus", "internus", "cervical", "thoracic", "lumbar"),
    )
)
"""What is said of an organ besides: a side, a part, a kind. Alone it may be said of a vessel: ``middle cerebral``."""

DIGITS = "0123456789"
LEVEL = re.compile(r"[clst]?\d+")
"""A number, or a vertebra's."""


def named_as_crossed(name: str) -> bool:
    """Whether every word of a name is known, and one of them is an organ, a bone, a soft tissue or a lesion.

    Args:
        name: A structure's, in any spelling.

    >>> named_as_crossed("Left Lung"), named_as_crossed("vertebrae_L1"), named_as_crossed("liver tumour 2")
    (True, True, True)
    >>> named_as_crossed("liver veins"), named_as_crossed("Tumorvene"), named_as_crossed("left middle cerebral")
    (False, False, False)
    """
    words = [word for word in plain_name(name).split("_") if word not in QUALIFIERS and not LEVEL.fullmatch(word)]
    return bool(words) and all(
        word in ORGANS | BONES | SOFT_TISSUES or word.rstrip(DIGITS) in LESIONS for word in words
    )
