"""Default roles of structures that a case says nothing of: a line per class or group of classes, with the reason.

Names are those of TotalSegmentator's tasks and of Slicer's segments, in any spelling of capitals, spaces and signs:
``lung_upper_lobe_left``, "Left Lung". Of several lines that match a name the most specific holds, as in a case; but
what may be hurt is not crossed because its name holds a muscle's too, as in ``thigh_artery``. Margins are a start to be
looked at for each patient, not a rule of any society.

A needle may cross what a name names by every one of its words as an organ of solid tissue (`named_as_crossed`). A
word that is not in these lists may be anything: "liver veins", ``A. pulmonalis`` and ``Lungenvene`` are named after
organs that a needle crosses, and are none. So what is not told wholly is not crossed. And vessels and nerves are
often named by adjectives alone: "superior thyroid" leaves out the artery, so a position needs a part or a noun of its
own.
"""

import re
import unicodedata
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from functools import cache
from typing import Literal, NamedTuple, get_args

from puncture_twin.planning.formats.labels.naming import specificity

Kind = Literal["avoid", "traverse", "ignore", "unknown"]
KINDS: Mapping[str, Kind] = {kind: kind for kind in get_args(Kind)}


def words(text: str) -> frozenset[str]:
    """The words of a text."""
    return frozenset(text.split())


class DefaultRole(NamedTuple):
    """One line of the table, for shell patterns of names in lower case with underscores.

    ``ignore`` is for outlines of the body, which the skin is; ``unknown`` for what nobody looked at.
    """

    group: str
    patterns: tuple[str, ...]
    kind: Kind
    margin_mm: float
    reason: str


def _table(text: str) -> tuple[DefaultRole, ...]:
    """Lines of the table: kind, margin, group and reason; below, indented, the patterns."""
    lines = []
    for row in re.split(r"\n(?=\S)", text.strip()):
        first, _, patterns = row.partition("\n")
        start, _, reason = first.partition(": ")
        what, _, group = start.partition(", ")
        kind, _, margin_mm = what.partition(" ")
        lines.append(DefaultRole(group, tuple(patterns.split()), KINDS[kind], float(margin_mm), reason))
    return tuple(lines)


UNKNOWN_NAME, BODY, NOT_ANNOTATED, LESION = _table("""
avoid 5, unknown name: nobody knows what it is: the largest margin of the table
ignore 0, outline of the body: the skin is found in the CT, or is the skin mesh
    skin body body_trunc body_extremities body_envelope external outline patient
unknown 2, not annotated: nobody said what is there: no path through it is known to be free
    ignore ignore_label void not_annotated unannotated
avoid 3, lesion: tumour cells are not carried along the needle; the one that holds the target is the target
    *lesion* *lasion* *laesion* *tumor* *tumour* *tumeur* *nodule* *metastas* *carcinoma* *neoplas* *cancer* *mass
    mass_* gtv* ctv* itv* ptv* hcc*
""")
"""Of a name that no line matches; structures that are the body itself; voxels that a segmentation leaves open, as
nnU-Net's label ``ignore``; and what a target usually is, which comes before all others."""

LATERAL_MASS = "lateral_mass"
"""Of a vertebra: a mass that is no lesion."""

GENERAL = (
    BODY,
    NOT_ANNOTATED,
    *_table("""
avoid 2, vertebrae, spine: bone deflects a needle; nerve roots leave beside it
    *vertebra* spine *spinal_column* *intervertebral* *disc *disk *lateral_mass* *massa_lateralis*
avoid 1, ribs: bone deflects; the intercostal vessels run below it
    rib* *_rib* *thoracic_cage*
avoid 1, costal cartilages, sternum: bone and cartilage deflect a needle
    *costal_cart* *sternum*
avoid 1, pelvis: bone deflects a needle
    hip hip_* *_hip *pelvi*bone* *ilium *ischium *pubis *sacrum* *coccyx*
avoid 1, limbs and girdles: bone deflects a needle
    *femur* *tibia* *fibula* *patella* *humerus* *radius* *ulna* *scapula* *clavicula* *clavicle* *carpal* *tarsal*
    *metacarpal* *metatarsal* *phalanges* *bone bone*
avoid 1, skull and face: bone deflects a needle
    *skull* *crani* *mandible* *maxilla* *zygomatic* *teeth* face* *hyoid*
avoid 5, spinal cord: palsy
    *spinal_cord* *spinal_canal* *medulla_spinalis* *cauda_equina* *thecal_sac* *dural_sac*
avoid 5, nerves: palsy, pain; they move with their surroundings
    *nerve* *plexus* *optic* *chiasm*
avoid 3, brain: eloquent tissue
    *brain* *cerebr* *cerebell* *thalamus* *caudate* *putamen* *pallidum* *capsule* *subarachnoid*
    *septum_pellucidum* *insular* *parenchyma*
avoid 3, eyes: sight
    *eye* *orbit* *lens* *lacrimal*
avoid 5, aorta and venae cavae: large vessel: bleeding
    *aorta* *vena_cava* vena_cava* ivc svc
avoid 5, great vessels of the chest and neck: large vessel: bleeding, embolism
    *pulmonary_arter* *pulmonary_vein* *pulmonary_venous* *pulmonary_trunk* *brachiocephalic* *subclavian*
    *carotid* *jugular*
avoid 4, portal vein: bleeding
    *portal_vein* portal* *splenic_vein* *mesenteric*
avoid 4, iliac vessels: bleeding
    iliac_arter* iliac_ven* *_iliac_arter* *_iliac_ve*
avoid 3, other vessels: bleeding; smaller ones are rarely segmented whole
    *arter* *vein* hepatic_ve* *vena* *venous* *vessel* *vascul* *sinus_sagitt* *circle_of_willis* aneurysm
    aneurysma *_aneurysm
avoid 5, heart: it moves; tamponade
    *heart* *cardi* *papillary_muscle* *atri* *ventricle_left* *ventricle_right* *left_ventricle *right_ventricle
    *coronar*
avoid 2, lungs: pneumothorax; it moves with the breath
    *lung* *pulmo* *pleura* *bronch*
avoid 3, airways: air leaks; infection
    *trachea* *airway* *larynx* *pharynx* *thyroid_cartilage* *cricoid* nasal* *sinus*
avoid 3, oesophagus: perforation, infection
    *esophag*
avoid 3, stomach and bowel: perforation, infection; it moves
    *stomach* *duoden* *bowel* *intestin* *jejun* ileum *colon* *rectum* *sigmoid* *c?ecum* *append*x*
avoid 3, gallbladder and bile ducts: bile leaks
    *gallbladder* *gall_bladder* *bile* *biliary* *common_duct*
avoid 3, urinary bladder and ureters: urine leaks
    *bladder* *ureter* *urethra*
avoid 3, liver: it bleeds; make it traverse where a path through the liver is meant
    *liver* *hepatic* *hepar*
avoid 3, spleen: it bleeds
    *spleen* *splenic*
avoid 3, kidneys: it bleeds; cysts leak
    *kidney* *renal*
avoid 3, pancreas: pancreatitis
    *pancrea*
avoid 2, adrenal glands: it bleeds; blood pressure crises
    *adrenal* *suprarenal*
avoid 2, thyroid, glands of the neck: it bleeds
    *thyroid* *parotid* *submandibular* *gland* *thymus*
avoid 2, organs of the pelvis: bleeding, infection
    *prostate* *uter?s* *ovar* *seminal* *vagina* *testi* *penis*
avoid 2, lymph nodes: seeding; vessels lie beside them
    *lymph* *node
avoid 3, devices: a needle damages it, or is deflected
    *implant* *stent* *pacemaker* *catheter* *port_a* *electrode* *prosthe*
traverse 0, muscles: needles pass muscle
    *gluteus* *autochthon* *iliopsoas* *psoas* *muscle* *pectoralis* *quadriceps* *rectus_abdom* *oblique*
    *latissimus* *trapezius* *deltoid* *serratus* *erector* *sartorius* thigh_* *levator* *sternocleido* *platysma*
    *scalen* *digastric* *masseter* *temporalis*
traverse 0, fat, breast: needles pass fat
    *fat *fat_* *adipose* *subcutan* breast* *_breast
"""),
)
"""The lines for every region."""

BY_REGION: Mapping[str, tuple[DefaultRole, ...]] = {
    "brain": _table("""
traverse 0, brain: the path to a target in the brain leads through it
    *brain *cerebrum* *cerebral_hemi* *parenchyma* *white_matter* *grey_matter* *gray_matter*
traverse 0, skull and face: the path leads through a burr hole
    *skull* *crani*
avoid 3, ventricles of the brain: leak of fluid, bleeding; the needle deflects at their wall
    *ventric*
avoid 5, brainstem: vital centres
    *brainstem* *brain_stem* *truncus_enceph* *pons* *midbrain* *mesenceph* *medulla_oblong*
"""),
    "head": _table("""
avoid 3, ventricles of the brain: leak of fluid, bleeding
    *ventric*
avoid 5, brainstem: vital centres
    *brainstem* *brain_stem*
"""),
}
"""Lines that hold in a region before the general ones; other regions have none of their own."""


NEVER_CROSSED = frozenset(
    (
        *("spinal cord", "nerves", "brainstem", "heart", "aorta and venae cavae", "portal vein", "iliac vessels"),
        *("great vessels of the chest and neck", "other vessels"),
    )
)
"""Groups that no path crosses because they hold the target too: masks overlap, and a lesion may lie on a vessel."""

OTHER_VESSELS = "other vessels"
VESSEL_WORDS = words("artery arteries arteria arteriae vein veins vena venae vessel vessels aorta aneurysm")
"""Words of a vessel's name; ``tumor_artery`` is one, ``hypervascular_lesion`` is none."""


@cache
def default_role(name: str, region: str) -> DefaultRole | None:
    """The line of the table that a name belongs to, or None."""
    plain = plain_name(name)
    own, general = (list(_matching(plain, lines)) for lines in (BY_REGION.get(region, ()), GENERAL))
    lesion = list(_matching(plain.replace(LATERAL_MASS, ""), (LESION,)))
    matches = lesion or own or general
    closest = max(matches, key=lambda one: one[0], default=(0.0, None))[1]
    if closest is None or closest.kind in ("avoid", "unknown"):
        return closest
    hurt = [one for one in general if one[1].kind == "avoid" and one[1].group != closest.group]
    return max(hurt, key=lambda one: one[0], default=(0.0, closest))[1]


def never_crossed(name: str) -> DefaultRole | None:
    """The line, in any region, of what no path crosses and is no usual target, such as a large vessel; else None."""
    lines = [default_role(name, region) for region in ("other", *BY_REGION)]
    if not VESSEL_WORDS.isdisjoint(plain_name(name).split("_")):  # of a lesion, or of anything else
        lines += [line for line in GENERAL if line.group == OTHER_VESSELS]
    return next((line for line in lines if line is not None and line.group in NEVER_CROSSED), None)


def plain_name(name: str) -> str:
    """A name in lower case with underscores, without accents.

    >>> plain_name("Left Lung"), plain_name("rib-left.7"), plain_name("SpinalCord"), plain_name("Artère")
    ('left_lung', 'rib_left_7', 'spinal_cord', 'artere')
    """
    bare = "".join(one for one in unicodedata.normalize("NFKD", name) if not unicodedata.combining(one))
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare)
    return re.sub(r"[\W_]+", "_", spaced).strip("_").lower()


def _matches(plain: str, pattern: str) -> bool:
    """Whether a name is as a pattern of the table has it, in which ``*`` and ``?`` stand for something else.

    Python compiles each pattern before it matches: hundreds, of which a name holds the words of a few.
    """
    return all(part in plain for part in pattern.replace("?", "*").split("*")) and fnmatchcase(plain, pattern)


def _matching(plain: str, lines: tuple[DefaultRole, ...]) -> Iterator[tuple[float, DefaultRole]]:
    for line in lines:
        close = [specificity(pattern, plain) for pattern in line.patterns if _matches(plain, pattern)]
        if close:
            yield max(close), line


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

NEEDS: Mapping[str, frozenset[str]] = {
    "rectus": frozenset(("abdominis", "femoris")),
    "oblique": WALLS | {"abdominis"},
    "levator": frozenset(("ani", "scapulae")),
}
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
    if not nouns or not all(word in ORGANS | BONES | SOFT_TISSUES or _is_lesion(word) for word in nouns):
        return False
    # Known words may still be said of a vessel or a nerve, of one beside a bone, of the cord or of a muscle of the eye.
    of_organ = bool(spoken & POSITIONS and spoken & ORGANS and not spoken & PARTS)
    of_bone = bool(spoken & WALLS and spoken & BONES)
    of_cord = "matter" in spoken and any(word in POSITIONS or LEVEL.fullmatch(word) for word in spoken)
    of_eye = any(noun in spoken and not spoken & NEEDS[noun] for noun in NEEDS)
    return any(_is_lesion(word) for word in nouns) or not (of_organ or of_bone or of_cord or of_eye)


def named_as_lesion(name: str) -> bool:
    """Whether every word of a name is known, and one of them is a lesion: a ``Tumorvene`` is none."""
    return named_as_crossed(name) and any(_is_lesion(word) for word in _words(name))


def _words(name: str) -> frozenset[str]:
    """A name's words; a vertebra's lateral mass is one of its own, which is not known."""
    return frozenset(plain_name(name).replace(LATERAL_MASS, LATERAL_MASS.replace("_", "")).split("_"))


def _is_lesion(word: str) -> bool:
    return word.rstrip(DIGITS) in LESIONS
