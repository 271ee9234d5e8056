"""The table of default roles: what TotalSegmentator and Slicer name is known, in any spelling."""

import pytest
from places import ROOT

from puncture_twin.planning.anatomy.default_roles import (
    BODY,
    BY_REGION,
    GENERAL,
    LESION,
    UNKNOWN_NAME,
    default_role,
    never_crossed,
)
from puncture_twin.planning.base.toml_file import parse_toml
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.formats.labels.naming import V1, V2, RuleKind, select


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
