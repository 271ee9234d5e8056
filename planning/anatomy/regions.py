"""The usual organs of a region of the body, and which of them no structure of a case is named like.

Names of TotalSegmentator's classes and common synonyms, English and Latin. A list of what is usually there, for a
reminder: what it does not hold may matter as much.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple


class Organ(NamedTuple):
    """One usual organ, and words of which a name holds one, in lower case without spaces and signs.

    ``paired``: there is one on each side; ``conduit``: it is itself a vessel or a nerve.
    """

    name: str
    words: tuple[str, ...]
    paired: bool = False
    conduit: bool = False


def _rows(text: str) -> Iterator[tuple[str, str]]:
    """Rows of a table as (text before, text after) the first colon; an indented line continues the row above."""
    for row in re.split(r"\n(?=\S)", text.strip()):
        first, _, rest = row.partition(":")
        yield first, rest


ORGANS: Mapping[str, Organ] = {
    name: Organ(name, tuple(words.split()), "paired" in kinds, "conduit" in kinds)
    for first, words in _rows("""
liver: liver hepar
gallbladder: gallbladder vesicafellea
spleen: spleen lien
pancreas: pancreas
stomach: stomach gaster ventriculus
duodenum: duodenum
small bowel: smallbowel smallintestine intestinesmall jejunum ileum intestinumtenue
colon: colon largebowel largeintestine intestinelarge
kidneys, paired: kidney ren renal
aorta, conduit: aorta
inferior vena cava, conduit: inferiorvenacava venacavainferior cavainf ivc
portal vein, conduit: portal portavein venaporta
lungs, paired: lung pulmo pleura
ribs: rib costa thoraciccage
spine: vertebra spine spinalcolumn backbone
heart: heart cor cardi ventric atrium
pulmonary artery, conduit: pulmonaryartery pulmonarytrunk pulmonaryvein arteriapulmonalis
superior vena cava, conduit: superiorvenacava venacavasuperior cavasup svc
oesophagus: oesophagus esophagus
trachea: trachea airway windpipe
sternum: sternum breastbone
urinary bladder: bladder vesicaurinaria
rectum or colon: rectum colon largebowel largeintestine intestinelarge
iliac arteries, paired, conduit: iliacartery arteriailiaca
iliac veins, paired, conduit: iliacvein iliacvena venailiaca
hip bones, paired: hip ilium pelvis pelvicbone oscoxae
sacrum: sacrum
femurs, paired: femur
brain: brain cerebrum cerebr encephalon
skull: skull cranium calvari
brainstem: brainstem truncusencephali pons
ventricles: ventric
vessels, conduit: arter vein vena vessel sinus willis carotid
optic nerves, conduit: optic chiasm
eyes, paired: eye orbit bulbus
airway: airway pharynx nasal trachea
carotid arteries, paired, conduit: carotid carotis
jugular veins, paired, conduit: jugular
thyroid gland: thyroid
spinal cord: spinalcord medullaspinalis myelon spinalcanal
bone: bone femur tibia fibula humerus radius ulna patella
artery, conduit: arter
vein, conduit: vein vena
nerve, conduit: nerv
""")
    for name, *kinds in [first.split(", ")]
}
"""By name; after it whether it is paired, or a conduit; then the words."""

USUAL: Mapping[str, tuple[Organ, ...]] = {
    region: tuple(ORGANS[" ".join(name.split())] for name in names.split(";") if name.strip())
    for region, names in _rows("""
abdomen: liver; gallbladder; spleen; pancreas; stomach; duodenum; small bowel; colon; kidneys; aorta; inferior vena
    cava; portal vein; lungs; ribs; spine
chest: lungs; heart; aorta; pulmonary artery; superior vena cava; oesophagus; trachea; ribs; sternum; spine
pelvis: urinary bladder; rectum or colon; small bowel; iliac arteries; iliac veins; hip bones; sacrum; femurs
brain: brain; skull; brainstem; ventricles; vessels; optic nerves
head: brain; skull; eyes; vessels; airway
neck: carotid arteries; jugular veins; thyroid gland; trachea; oesophagus; spine; spinal cord; lungs
spine: spine; spinal cord; aorta; inferior vena cava; kidneys; lungs
limb: bone; artery; vein; nerve
phantom:
other:
""")
}
"""Region to its usual organs."""

NOT_THE_ORGAN = re.compile(
    r"arter(y|ies|ia|iae)|veins?|vena|venae|vessels?|nerves?|nervus|ducts?|cysts?|(tumou?r|lesion|nodule)s?"
)
"""A word that makes a name that of a vessel, a duct or a lesion of an organ: "liver vessels" are no liver."""
_SIDES: Mapping[str, frozenset[str]] = {
    "left": frozenset({"left", "l", "lt", "sin", "sinister", "sinistra"}),
    "right": frozenset({"right", "r", "rt", "dex", "dexter", "dextra"}),
}


def absent_organs(region: str, names: Iterable[str]) -> list[str]:
    """The usual organs of a region that no name of a case's structures (ignored ones too) is like, in their order."""
    known, absent = [_Name.of(name) for name in names], list[str]()
    for organ in USUAL[region]:
        alike = [name for name in known if name.is_like(organ)]
        sides = frozenset[str]().union(*(name.sides for name in alike))
        if not alike:
            absent.append(organ.name)
        elif organ.paired:
            absent += [f"{organ.name} ({side})" for side in _SIDES if side not in sides]
    return absent


class _Name(NamedTuple):
    """A name without spaces and signs, and the sides that it tells: both where it tells none."""

    text: str
    words: tuple[str, ...]
    sides: frozenset[str]

    @classmethod
    def of(cls, name: str) -> _Name:
        spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()
        words = tuple(re.findall(r"[^\W_]+", spaced))
        sides = frozenset(side for side, said in _SIDES.items() if said & set(words))
        return cls("".join(words), words, sides or frozenset(_SIDES))

    def is_like(self, organ: Organ) -> bool:
        """Whether it may be an organ's, and not that of its vessels, nerves, ducts or lesions.

        Long words may stand anywhere in the name; short ones begin one of its words, so that `ren` is no adrenal.
        """
        if not organ.conduit and any(NOT_THE_ORGAN.fullmatch(word) for word in self.words):
            return False
        return any(
            word in self.text if len(word) > 5 else any(own.startswith(word) for own in self.words)
            for word in organ.words
        )
