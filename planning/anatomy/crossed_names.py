"""Names that say by every one of their words that a needle may cross what they name: an organ of solid tissue.

A word that is not in these lists may be anything: "liver veins", ``A. pulmonalis`` and ``Lungenvene`` are named after
organs that a needle crosses, and are none. So what is not told wholly is not crossed. And vessels and nerves are often
named by adjectives alone: "superior thyroid" leaves out the artery, so a position needs a part or a noun of its own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

from puncture_twin.planning.anatomy.default_roles import LATERAL_MASS, plain_name


def words(text: str) -> frozenset[str]:
    """The words of a text."""
    return frozenset(text.split())


ORGANS = words("""
    liver spleen pancreas kidney kidneys lung lungs adrenal adrenals thyroid parotid submandibular thymus prostate
    uterus ovary testis breast breasts gland glands node nodes brain cerebrum cerebellum hemisphere matter
""")
"""Organs of solid tissue: a lesion lies in them, and a path to it leads through them."""

LESIONS = words("""
    lesion lesions laesion lasion tumor tumors tumour tumours tumeur nodule nodules metastasis metastases metastase
    metastasen carcinoma neoplasm neoplasia cancer mass gtv ctv itv ptv hcc
""")
"""Lesions, as whole words: a ``Tumorvene`` is none."""

BONES = words("""
    bone bones rib ribs vertebra vertebrae sternum hip ilium ischium pubis sacrum femur tibia fibula patella humerus
    radius ulna scapula clavicle clavicula skull cranium mandible maxilla
""")
"""Bones; of the spine the vertebrae alone, since a spine may hold its cord."""

SOFT_TISSUES = words("""
    muscle muscles gluteus autochthon iliopsoas psoas pectoralis quadriceps rectus oblique latissimus trapezius
    deltoid serratus erector sartorius thigh levator sternocleidomastoid platysma scalenus scalene digastric
    masseter temporalis fat adipose subcutaneous
""")
"""Muscles and fat, which needles pass."""

WALLS = frozenset(("internal", "external", "internus", "externus"))
"""Of muscles of a wall (``external_oblique``); beside a bone they are a vessel's: "internal iliac"."""

LEVELS_OF_CORD = frozenset(("cervical", "thoracic", "lumbar"))

POSITIONS = (
    WALLS | LEVELS_OF_CORD | words("middle superior inferior anterior posterior medial lateral intermediate medius")
)
"""Said of vessels and nerves, which are then named after an organ without a noun of their own: "superior thyroid"."""

PARTS = words("lobe lobes segment segments section cortex parenchyma tissue hemisphere gland glands node nodes")
"""Parts of an organ: beside one of them a position is its own, as in ``lung_upper_lobe``."""

QUALIFIERS = (
    POSITIONS
    | PARTS
    | words("""
    left right l r upper lower major minor maximus minimus cerebral cerebellar lymph abdominis femoris spinae ani
    white grey gray head neck body tail whole of the and costal skeletal torso visceral intermuscular compartment
    dorsi scapulae
""")
) - ORGANS
"""What is said of an organ besides: a side, a part, a kind. Alone it may be said of a vessel: ``middle cerebral``."""

NEEDS: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "rectus": frozenset(("abdominis", "femoris")),
        "oblique": WALLS | {"abdominis"},
        "levator": frozenset(("ani", "scapulae")),
    }
)
"""Muscles of which some move the eye: which one it is must be said."""

DIGITS = "0123456789"
LEVEL = re.compile(r"[clst]?\d+")
"""A number, or a vertebra's."""


def named_as_crossed(name: str) -> bool:
    """Whether every word of a name is known, and one of them is an organ, a bone, a soft tissue or a lesion.

    >>> named_as_crossed("Left Lung"), named_as_crossed("vertebrae_L1"), named_as_crossed("liver tumour 2")
    (True, True, True)
    >>> named_as_crossed("liver veins"), named_as_crossed("Tumorvene"), named_as_crossed("left middle cerebral")
    (False, False, False)
    >>> named_as_crossed("superior thyroid"), named_as_crossed("superior thyroid lobe")
    (False, True)
    """
    spoken = _words(name)
    nouns = [word for word in spoken if word not in QUALIFIERS and not LEVEL.fullmatch(word)]
    lesion = any(_is_lesion(word) for word in nouns)
    known = all(word in ORGANS | BONES | SOFT_TISSUES or _is_lesion(word) for word in nouns)
    return bool(nouns) and known and (lesion or not _may_lack_its_noun(spoken))


def named_as_lesion(name: str) -> bool:
    """Whether every word of a name is known, and one of them is a lesion: a ``Tumorvene`` is none."""
    return named_as_crossed(name) and any(_is_lesion(word) for word in _words(name))


def _words(name: str) -> frozenset[str]:
    """A name's words; a vertebra's lateral mass is one of its own, which is not known."""
    return frozenset(plain_name(name).replace(LATERAL_MASS, LATERAL_MASS.replace("_", "")).split("_"))


def _is_lesion(word: str) -> bool:
    return word.rstrip(DIGITS) in LESIONS


def _may_lack_its_noun(spoken: frozenset[str]) -> bool:
    """Whether known words may be said of a vessel, a nerve, the cord or a muscle of the eye."""
    placed = spoken & POSITIONS
    of_organ = bool(placed and spoken & ORGANS and not spoken & PARTS)
    of_bone = bool(spoken & WALLS and spoken & BONES)
    of_cord = "matter" in spoken and any(word in POSITIONS or LEVEL.fullmatch(word) for word in spoken)
    return of_organ or of_bone or of_cord or any(noun in spoken and not spoken & NEEDS[noun] for noun in NEEDS)
