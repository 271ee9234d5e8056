"""What names tell: default roles in any spelling, and what holds the target beside a lesion, which no table knows."""

import pytest
from places import ROOT

from puncture_twin.planning.anatomy.default_roles import (
    BODY,
    BONES,
    BY_REGION,
    GENERAL,
    LESION,
    NEEDS,
    ORGANS,
    POSITIONS,
    QUALIFIERS,
    SOFT_TISSUES,
    UNKNOWN_NAME,
    default_role,
    named_as_crossed,
    never_crossed,
    words,
)
from puncture_twin.planning.base.toml_file import parse_toml
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.formats.labels.naming import V1, V2, RuleKind, select
from puncture_twin.planning.init.target import Holding, assign, chosen_target

DANGERS = {
    "abbreviations": ["AAA", "ICA", "SMA", "SMV", "CBD", "A. hepatica", "V. renalis", "hepatic a.", "Aa. renales"],
    "German": ["Rückenmark", "Herz", "Darm", "Galle", "Lungenvene", "Nierenvene", "Pfortader", "Bauchschlagader"],
    "French": ["moelle épinière", "cœur", "intestin", "vésicule", "artère pulmonaire", "veine rénale", "vaisseau"],
    "of an organ": ["liver veins", "kidney_pelvis", "lung vessels", "thyroid cartilage", "pancreas duct"],
    "of a lesion": ["Tumorvene", "Metastasenarterie", "hccvein", "GTVein", "Tumorgefäße", "tumor feeder"],
    "of an adjective": ["left middle cerebral", "posterior_inferior_cerebellar", "lymph", "femoris", "spinae"],
    "no names": ["Segment_1", "label 7", "structure", "left", "Segment_1 (copy)", "External", "patient"],
    "an organ's adjective": [
        *("superior thyroid", "Thyroid_Inferior_L", "SuperiorThyroid", "middle thyroid 1", "inferior adrenal"),
        *("internal thoracic", "middle cerebral", "posterior cerebellum", "neck superior thyroid", "superior parotid"),
        *("internal ilium", "external ilium 2", "internal maxilla", "lateral breast", "superior pancreas"),
    ],
    "the cord": ["cervical white matter", "grey matter c5", "lumbar gray matter", "anterior grey matter segment"],
    "the eye": [
        *("superior_oblique_muscle_right", "inferior_oblique_muscle_left", "superior_rectus_muscle_right"),
        *("medial_rectus_muscle_left", "lateral rectus", "levator_muscle_left", "oblique", "M. rectus superior"),
    ],
    "whole nomenclatures": [
        *("Lumen of liver", "Hilum of lung", "Capsule of kidney", "Branch of left lung", "Muscle of heart"),
        *("Entire vertebral artery", "Structure of tail of spine", "Wall of uterus", "Duct of parotid gland"),
    ],
    "Spanish": ["vena del hígado", "mesentérica superior", "arteria tiroidea superior", "médula", "uréter", "vejiga"],
    "Italian": ["vena porta", "arteria renale", "midollo", "tiroidea inferiore", "vena polmonare", "colecisti"],
    "Latin": ["V. lienalis", "Aa. cerebri", "N. vagus", "ductus pancreaticus", "thyroidea superior", "arcus aortae"],
    "compounds": ["Schilddrüsenarterie", "Schilddruesenvene", "Schilddrusenvene", "Nierenbecken", "Tumorgefass"],
    "signs": [
        *("liver\u200bvein", "lung\u00advein", "liverV", "lung.a", "kidney(v)", "LIVER-VEIN", "Lùng vèin", "liver+v")
    ],
}
CROSSED = """
    Left Lung, LIVER, kidney-r, vertebrae_L1, liver tumour 2, lung_upper_lobe_left, L_adrenal gland, left cerebral white
    matter, erector spinae, lymph node 3, GTV1, Left-Cerebral-White-Matter, white_matter, superior thyroid lobe, thyroid
    left, right middle lobe of lung, superior thyroid tumour, External_Oblique_R, rectus_abdominis_left,
    serratus_anterior_1, levator_scapulae_right, thigh_medial_compartment_left, thoracic vertebra 7
"""
CROSSED_NAMES = " ".join(CROSSED.split()).split(", ")


@pytest.mark.parametrize("kind", sorted(DANGERS))
def test_names_that_do_not_tell_are_crossed_in_no_region(kind):
    """As a neighbour of the lesion in any region: avoided where the table knows them for vessels, else unknown."""
    for name in DANGERS[kind]:
        for region in ("abdomen", "brain", "chest", "other"):
            (row, _) = assign({1: name, 2: "tumor"}, region, Holding("tumor", frozenset({name})))
            assert row.kind == ("unknown" if never_crossed(name) is None else "avoid"), name
            assert row.margin_mm > 0.0


def test_what_a_needle_crosses_is_crossed_as_before():
    """An organ, a bone or a lesion about the lesion, in the spellings of the programs that write masks."""
    for name in CROSSED_NAMES:
        (row,) = assign({1: name}, "abdomen", Holding("tumor", frozenset({name})))
        assert (row.kind, row.margin_mm) == ("traverse", 0.0), name


@pytest.mark.parametrize("name", ["V. pectoralis", "N. masseter", "Gefäß thigh", "thigh_nv_bundle", "muscle bas"])
def test_the_name_of_a_muscle_with_another_word_is_not_crossed(name):
    """Away from the target too: it was free, as a muscle is."""
    (row,) = assign({1: name}, "abdomen", Holding(None, frozenset()))
    assert row.kind == "avoid" and row.margin_mm > 0.0


def test_an_unknown_name_is_no_target_beside_an_organ():
    """The smallest was taken, and nothing kept the needle out of an artery whose mask overlaps the organ's."""
    assert chosen_target(["SMA", "pancreas"]) == "pancreas"
    assert chosen_target(["AAA", "liver", "gtv 1"]) == "gtv 1"
    assert chosen_target(["aorta", "liver"]) == "aorta"
    assert chosen_target(["SMA", "qwerty"]) == "SMA"


@pytest.mark.parametrize("name", ["Tumorvene", "tumor feeder", "lesion_a", "Metastasenarterie"])
def test_what_is_named_after_a_lesion_is_no_target_beside_one(name):
    """The smaller of the two was the target's structure, and nothing kept the needle out of the vein of a tumour."""
    assert chosen_target([name, "tumor"]) == "tumor"
    assert chosen_target([name, "liver"]) == name
    (row, _) = assign({1: name, 2: "tumor"}, "abdomen", Holding("tumor", frozenset({name})))
    assert row.kind == "unknown"


@pytest.mark.parametrize("region", ["head", "brain", "other"])
def test_muscles_of_the_eye_are_crossed_nowhere(region):
    """Away from the target too: TotalSegmentator's obliques were muscles like those of the belly."""
    for name in DANGERS["the eye"]:
        (row,) = assign({1: name}, region, Holding(None, frozenset()))
        assert row.kind == "avoid" and row.margin_mm > 0.0, name


@pytest.mark.parametrize("name", ["tumor-artery", "lung_lesion_vessels", "peritumoralVessels", "aneurysm mass"])
def test_a_vessel_of_a_lesion_is_a_vessel(name):
    """As a target it was a lesion by its name, and nothing kept the needle out of it."""
    line = never_crossed(name)
    assert line is not None and line.group == "other vessels"
    assert never_crossed("hypervascular lesion") is None and never_crossed("brainstem tumour") is None


def test_a_foreign_word_beside_known_ones_is_never_crossed(rng):
    """Drawn names: known words, one letter of one of them changed or one word more, and the whole is not known."""
    nouns = sorted((ORGANS | BONES | SOFT_TISSUES) - {"matter", *NEEDS})
    told = sorted({*nouns, *QUALIFIERS} - POSITIONS)
    for _ in range(500):
        known = [str(rng.choice(nouns)), *map(str, rng.choice(told, rng.integers(0, 3)))]
        rng.shuffle(known)
        assert named_as_crossed("_".join(known))
        foreign = "".join(rng.choice(list("aeiouvnrst"), rng.integers(2, 9)))
        if foreign in told:
            continue
        assert not named_as_crossed("_".join([*known, foreign]))
        assert not named_as_crossed("_".join([*known[:-1], known[-1] + foreign])) or known[-1] + foreign in told


def test_the_margin_is_the_tables():
    """Of a name that a line knows its margin, of others the largest."""
    rows = assign({1: "colon", 2: "AAA"}, "abdomen", Holding("tumor", frozenset({"colon", "AAA"})))
    assert [(row.kind, row.margin_mm) for row in rows] == [("unknown", 3.0), ("unknown", UNKNOWN_NAME.margin_mm)]


SUBTASKS = words("""
    lung_vessels lung_trachea_bronchia intracerebral_hemorrhage hip_implant pleural_effusion pericardial_effusion
    eye_left eye_lens_left optic_nerve_left parotid_gland_left submandibular_gland_right nasopharynx oropharynx
    hypopharynx nasal_cavity_right auditory_canal_right soft_palate hard_palate larynx_air thyroid_cartilage hyoid
    cricoid_cartilage zygomatic_arch_right styloid_process_right internal_carotid_artery_right
    internal_jugular_vein_right superior_pharyngeal_constrictor middle_pharyngeal_constrictor
    inferior_pharyngeal_constrictor sterno_thyroid_right thyrohyoid_right prevertebral_right liver_vessels eyeball_right
    lateral_rectus_muscle_right superior_oblique_muscle_right levator_palpebrae_superioris_right
    superior_rectus_muscle_right medial_rectus_muscle_left inferior_oblique_muscle_right inferior_rectus_muscle_right
    kidney_cyst_left ventricle_frontal_horn_left ventricle_body_left third_ventricle fourth_ventricle heart_myocardium
    subarachnoid_space venous_sinuses septum_pellucidum caudate_nucleus lentiform_nucleus insular_cortex
    internal_capsule ventricle central_sulcus frontal_lobe thalamus brainstem coronary_arteries mandible teeth_lower
    sinus_maxillary sinus_frontal abdominal_cavity thoracic_cavity pericardium mediastinum aortic_sinuses brain_aneurysm
    spinal_cord_gray_matter levator_scapulae_right vertebrae_L5 rib_left_7 skull
""")
"""Classes of TotalSegmentator's further tasks: away from the target none of them is crossed outside of the brain."""
CROSSED_SUBTASKS = words("""
    sternocleidomastoid_right trapezius_left platysma_right anterior_scalene_right middle_scalene_left
    posterior_scalene_left subcutaneous_fat torso_fat intermuscular_fat skeletal_muscle quadriceps_femoris_left
    thigh_medial_compartment_left thigh_posterior_compartment_right sartorius_left deltoid pectoralis_minor
    serratus_anterior external_oblique_right internal_oblique_left erector_spinae rectus_abdominis latissimus_dorsi_left
    psoas_major_right breast
""")


@pytest.mark.parametrize("region", ["head", "neck", "abdomen", "limb"])
def test_the_classes_of_further_tasks_are_crossed_where_they_are_muscle_or_fat(region):
    """Names as facts; the same are crossed as before."""
    rows = assign(dict(enumerate([*SUBTASKS, *CROSSED_SUBTASKS])), region, Holding(None, frozenset()))
    assert {row.name for row in rows if row.kind == "traverse"} == CROSSED_SUBTASKS
    assert all(row.margin_mm > 0.0 for row in rows if row.kind == "avoid")


@pytest.mark.parametrize("region", ["abdomen", "brain", "head"])
def test_every_class_of_totalsegmentator_is_known(region):
    """Both versions, and nothing is free that could be hurt: what may be crossed is muscle, or brain and skull."""
    found = {name: default_role(name, region) for table in (V1, V2) for name in table.values()}
    assert [name for name, line in found.items() if line is None] == []
    crossed = {name for name, line in found.items() if line.kind == "traverse"}
    muscles = {name for name in found if name.startswith(("gluteus", "autochthon", "iliopsoas"))}
    assert crossed == muscles | ({"brain", "skull"} if region == "brain" else set())
    assert {line.kind for line in found.values()} == {"avoid", "traverse"}


def test_the_cases_written_by_hand_are_met():
    """Whatever the case of the real CT avoids, the table avoids by as much; what it crosses is crossed."""
    path = ROOT / "tests" / "real" / "case_v2.toml"
    (section,) = parse_toml(path.read_bytes(), path, CaseFile, allowed="", keys="").structures
    rest = {"traverse": section.traverse, "target": section.target, "where": "case"}
    for rule in select(V2, V2, avoid={**section.avoid, "*": 0.0}, **rest).rules:
        line = default_role(rule.name, "abdomen")
        if rule.kind is RuleKind.TRAVERSE:
            assert line.kind == "traverse", rule.name
        elif rule.pattern != "*" and rule.kind is RuleKind.AVOID:
            assert (line.kind, line.margin_mm) == ("avoid", rule.margin_mm), rule.name


@pytest.mark.parametrize(
    ("names", "group"),
    [
        (["Left Lung", "right lung", "lung_upper_lobe_left", "RightLung"], "lungs"),
        (
            ["liver_lesion", "Liver Tumor 1", "kidney tumour", "lung_nodules", "colon_cancer_primaries", "Lesion"],
            "lesion",
        ),
        (["liver_vessels", "Hepatic veins", "femoral artery", "Circle of Willis", "basilar_aneurysm"], "other vessels"),
        (["portal_vein", "Portal Vein and Splenic Vein"], "portal vein"),
        (["gall-bladder", "Gallbladder"], "gallbladder and bile ducts"),
        (["urinary_bladder"], "urinary bladder and ureters"),
        (["SpinalCord", "spinal cord", "Thecal sac", "dural sac"], "spinal cord"),
        (["heart_atrium_left", "pericardium", "Left Ventricle", "heart_ventricle_left"], "heart"),
        (["Body", "skin", "body_trunc"], BODY.group),
        (["subcutaneous_fat", "torso_fat"], "fat, breast"),
        (["skeletal_muscle"], "muscles"),
        (["oesophagus", "esophagus"], "oesophagus"),
    ],
)
def test_spellings_of_other_programs_are_known(names, group):
    """Capitals, spaces and signs say nothing; a tumour of an organ is a tumour."""
    assert {default_role(name, "abdomen").group for name in names} == {group}


LINES = [*GENERAL, *(line for region in BY_REGION.values() for line in region)]


@pytest.mark.parametrize(
    ("names", "region"),
    [
        (["heart_muscle", "cardiac muscle", "Papillary muscle", "thigh_artery", "Thigh nerve"], "chest"),
        (["breast_artery", "muscle_artery", "masseteric nerve", "oblique vein", "subcutaneous veins"], "abdomen"),
        (["intracranial_artery", "Cranial nerves", "vessels_brain", "White matter artery", "sinus_skull"], "brain"),
        (["cerebral hemisphere vessels", "parenchyma_vessels"], "brain"),
    ],
)
def test_what_may_be_hurt_is_not_crossed_for_its_place(names, region):
    """The longer pattern was the place's, muscle or skull, and a new case crossed these vessels and nerves freely."""
    assert {default_role(name, region).kind for name in names} == {"avoid"}


def test_what_no_line_knows_is_not_guessed():
    """It is avoided by the largest margin of the table."""
    assert default_role("Segment_1", "abdomen") is default_role("qwerty", "brain") is None
    assert (UNKNOWN_NAME.kind, UNKNOWN_NAME.margin_mm) == ("avoid", max(line.margin_mm for line in LINES))
    assert all((line.margin_mm > 0) == (line.kind in ("avoid", "unknown")) for line in LINES)


def test_a_region_has_its_own_lines():
    """The brain is crossed where the target is in it, and nowhere else; its ventricles are no heart's."""
    assert default_role("brain", "brain").kind == "traverse"
    assert default_role("brain", "neck").kind == "avoid"
    assert default_role("Left lateral ventricle", "brain").group == "ventricles of the brain"
    assert default_role("brainstem", "brain").margin_mm == 5.0

    for name in ("Midbrain", "Pons", "Medulla oblongata", "mesencephalon"):  # brain by its ending, it was crossed
        assert default_role(name, "brain").group == never_crossed(name).group == "brainstem"


def test_a_lesion_named_after_a_vessel_stays_a_lesion():
    """An aneurysmal bone cyst is biopsied: it is no aneurysm."""
    assert never_crossed("aneurysmal bone cyst") is None
    assert never_crossed("Left lateral ventricle") is None


def test_the_page_shows_the_table():
    """Every line with its role, margin and reason, as docs/default_roles.py writes it."""
    page = (ROOT / "docs" / "reference" / "default-roles.md").read_text(encoding="utf-8")
    for line in (UNKNOWN_NAME, *LINES):
        margin = f"{line.margin_mm:g}" if line.margin_mm else ""
        assert f"| {line.kind} | {margin} | {line.reason} |" in page, line.group
        assert all(f"`{pattern}`" in page for pattern in line.patterns), line.group


def test_each_pattern_of_the_table_finds_a_name_of_its_own():
    """Names are looked through for the words between stars and question marks before Python compiles a pattern."""
    missed = []
    for region, lines in {"other": (*GENERAL, LESION), **BY_REGION}.items():
        patterns = {pattern for line in lines for pattern in line.patterns}
        assert not {sign for pattern in patterns for sign in pattern} & set("[]!")
        names = {pattern: pattern.replace("*", "a").replace("?", "a") for pattern in patterns}
        missed += [pattern for pattern, name in names.items() if default_role(name, region) is None]
    assert missed == []
