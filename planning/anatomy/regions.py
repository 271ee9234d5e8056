"""The usual organs of a region of the body, and which of them no structure of a case is named like.

Names of TotalSegmentator's classes and common synonyms, English and Latin. A list of what is usually there, for a
reminder: what it does not hold may matter as much.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import NamedTuple


class Organ(NamedTuple):
    """One usual organ.

    Attributes:
        name: What a person reads.
        words: What a structure's name may hold, in lower case without spaces and signs; one is enough.
        paired: Whether there is one on each side.
        conduit: Whether it is itself a vessel or a nerve.
    """

    name: str
    words: tuple[str, ...]
    paired: bool = False
    conduit: bool = False


AORTA = Organ("aorta", ("aorta",), conduit=True)
BOWEL = Organ("small bowel", ("smallbowel", "smallintestine", "intestinesmall", "jejunum", "ileum", "intestinumtenue"))
BRAIN = Organ("brain", ("brain", "cerebrum", "cerebr", "encephalon"))
CAROTID = Organ("carotid arteries", ("carotid", "carotis"), paired=True, conduit=True)
CAVA_INFERIOR = Organ("inferior vena cava", ("inferiorvenacava", "venacavainferior", "cavainf", "ivc"), conduit=True)
COLON = Organ("colon", ("colon", "largebowel", "largeintestine", "intestinelarge"))
CORD = Organ("spinal cord", ("spinalcord", "medullaspinalis", "myelon", "spinalcanal"))
HEART = Organ("heart", ("heart", "cor", "cardi", "ventric", "atrium"))
KIDNEYS = Organ("kidneys", ("kidney", "ren", "renal"), paired=True)
LUNGS = Organ("lungs", ("lung", "pulmo", "pleura"), paired=True)
OESOPHAGUS = Organ("oesophagus", ("oesophagus", "esophagus"))
RIBS = Organ("ribs", ("rib", "costa", "thoraciccage"))
SKULL = Organ("skull", ("skull", "cranium", "calvari"))
SPINE = Organ("spine", ("vertebra", "spine", "spinalcolumn", "backbone"))
TRACHEA = Organ("trachea", ("trachea", "airway", "windpipe"))

USUAL: Mapping[str, tuple[Organ, ...]] = MappingProxyType(
    {
        "abdomen": (
            Organ("liver", ("liver", "hepar")),
            Organ("gallbladder", ("gallbladder", "vesicafellea")),
            Organ("spleen", ("spleen", "lien")),
            Organ("pancreas", ("pancreas",)),
            Organ("stomach", ("stomach", "gaster", "ventriculus")),
            Organ("duodenum", ("duodenum",)),
            BOWEL,
            COLON,
            KIDNEYS,
            AORTA,
            CAVA_INFERIOR,
            Organ("portal vein", ("portal", "portavein", "venaporta"), conduit=True),
            LUNGS,
            RIBS,
            SPINE,
        ),
        "chest": (
            LUNGS,
            HEART,
            AORTA,
            Organ(
                "pulmonary artery",
                ("pulmonaryartery", "pulmonarytrunk", "pulmonaryvein", "arteriapulmonalis"),
                conduit=True,
            ),
            Organ("superior vena cava", ("superiorvenacava", "venacavasuperior", "cavasup", "svc"), conduit=True),
            OESOPHAGUS,
            TRACHEA,
            RIBS,
            Organ("sternum", ("sternum", "breastbone")),
            SPINE,
        ),
        "pelvis": (
            Organ("urinary bladder", ("bladder", "vesicaurinaria")),
            Organ("rectum or colon", ("rectum", *COLON.words)),
            BOWEL,
            Organ("iliac arteries", ("iliacartery", "arteriailiaca"), paired=True, conduit=True),
            Organ("iliac veins", ("iliacvein", "iliacvena", "venailiaca"), paired=True, conduit=True),
            Organ("hip bones", ("hip", "ilium", "pelvis", "pelvicbone", "oscoxae"), paired=True),
            Organ("sacrum", ("sacrum",)),
            Organ("femurs", ("femur",), paired=True),
        ),
        "brain": (
            BRAIN,
            SKULL,
            Organ("brainstem", ("brainstem", "truncusencephali", "pons")),
            Organ("ventricles", ("ventric",)),
            Organ("vessels", ("arter", "vein", "vena", "vessel", "sinus", "willis"), conduit=True),
            Organ("optic nerves", ("optic", "chiasm"), conduit=True),
        ),
        "head": (
            BRAIN,
            SKULL,
            Organ("eyes", ("eye", "orbit", "bulbus"), paired=True),
            Organ("vessels", ("arter", "vein", "vena", "vessel", "sinus", "carotid"), conduit=True),
            Organ("airway", ("airway", "pharynx", "nasal", "trachea")),
        ),
        "neck": (
            CAROTID,
            Organ("jugular veins", ("jugular",), paired=True, conduit=True),
            Organ("thyroid gland", ("thyroid",)),
            TRACHEA,
            OESOPHAGUS,
            SPINE,
            CORD,
            LUNGS,
        ),
        "spine": (SPINE, CORD, AORTA, CAVA_INFERIOR, KIDNEYS, LUNGS),
        "limb": (
            Organ("bone", ("bone", "femur", "tibia", "fibula", "humerus", "radius", "ulna", "patella")),
            Organ("artery", ("arter",), conduit=True),
            Organ("vein", ("vein", "vena"), conduit=True),
            Organ("nerve", ("nerv",), conduit=True),
        ),
        "phantom": (),
        "other": (),
    }
)
"""Region to its usual organs."""

NOT_THE_ORGAN = re.compile(
    r"arter(y|ies|ia|iae)|veins?|vena|venae|vessels?|nerves?|nervus|ducts?|cysts?|(tumou?r|lesion|nodule)s?"
)
"""A word that makes a name that of a vessel, a duct or a lesion of an organ: "liver vessels" are no liver."""

_SIDES: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "left": frozenset({"left", "l", "lt", "sin", "sinister", "sinistra"}),
        "right": frozenset({"right", "r", "rt", "dex", "dexter", "dextra"}),
    }
)


def absent_organs(region: str, names: Iterable[str]) -> list[str]:
    """The usual organs of a region that no name is like, in the order of its list.

    Args:
        region: A key of `USUAL`.
        names: Of the case's structures, also of those that it ignores on purpose.
    """
    known = [_Name.of(name) for name in names]
    return [absent for organ in USUAL[region] for absent in _absent(organ, known)]


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

    @property
    def is_of_an_organ(self) -> bool:
        """Whether it says of itself that it is a vessel, a nerve, a duct or a lesion."""
        return any(NOT_THE_ORGAN.fullmatch(word) for word in self.words)

    def is_like(self, word: str) -> bool:
        """Long words may stand anywhere in the name; short ones begin one of its words, so that `ren` is no adrenal."""
        if len(word) > 5:
            return word in self.text
        return any(own.startswith(word) for own in self.words)


def _absent(organ: Organ, names: list[_Name]) -> Iterator[str]:
    own = names if organ.conduit else [name for name in names if not name.is_of_an_organ]
    alike = [name for name in own if any(name.is_like(word) for word in organ.words)]
    if not alike:
        yield organ.name
    elif organ.paired:
        sides = frozenset[str]().union(*(name.sides for name in alike))
        yield from (f"{organ.name} ({side})" for side in _SIDES if side not in sides)
