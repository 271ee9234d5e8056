"""Names of labels, the rules that patterns give them, and which TotalSegmentator numbered a map."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import REAL_CT
from refusals import refused

from puncture_twin.planning.formats.labels.labelmaps import LabelMap, labelmap_of, parse_names
from puncture_twin.planning.formats.labels.naming import V1, V2, LabelRule, RuleKind, names_for, select
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.init.label_files import likely_numbering

REAL = REAL_CT
NAMES = {1: "liver", 2: "rib_left_7", 3: "rib_left_8", 4: "lung_lower_lobe_left", 5: "aorta"}


def map_with(names: dict[int, str] | None) -> LabelMap:
    return LabelMap(np.ones((2, 2, 2), dtype=np.int32), np.eye(4), names, Path("a.seg.nrrd"))


def chosen(present: tuple[int, ...] = (1, 2, 3, 4, 5), **rules: Any) -> dict[str, tuple[str, float]]:
    given = {"avoid": {"rib_*": 1.0, "aorta": 5.0}, "traverse": ["lung_*"], "target": ["liver"], **rules}
    selection = select(NAMES, present, where="case.toml", **given)
    return {rule.name: (str(rule.kind), rule.margin_mm) for rule in selection.rules}


def test_tables_have_their_sizes_and_the_versions_differ() -> None:
    assert (len(V1), len(V2)) == (104, 117)
    assert len(set(V1.values())) == 104
    assert len(set(V2.values())) == 117
    assert (V1[7], V1[104], V2[52], V2[117]) == ("aorta", "urinary_bladder", "aorta", "costal_cartilages")
    with pytest.raises(TypeError):
        V1[7] = "liver"  # type: ignore[index]


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real CT is not at {REAL}")
@pytest.mark.parametrize(("table", "name"), [(V1, "labels_v1_normal.json"), (V2, "labels_v2_fast.json")])
def test_tables_agree_with_the_real_label_maps(table: dict[int, str], name: str) -> None:
    named = json.loads((REAL / name).read_text())
    assert {int(label): text for label, text in named.items()} == {int(label): table[int(label)] for label in named}


def read_from(folder: Path) -> Callable[[str], bytes]:
    return lambda name: (folder / name).read_bytes()


def test_namings_by_name_by_file_and_by_the_map_itself(tmp_path: Path) -> None:
    (tmp_path / "names.csv").write_text("id,name\n1,liver\n")
    for naming, own, names in (
        ("totalsegmentator-v1", None, V1),
        ("totalsegmentator-v2", None, V2),
        ("names.csv", None, {1: "liver"}),
        (None, {3: "x"}, {3: "x"}),
        ("seg.nrrd", {3: "x"}, {3: "x"}),
    ):
        assert names_for(naming, tmp_path, read_from(tmp_path), map_with(own)) == names


def test_unknown_namings_are_refused_with_the_nearest(tmp_path: Path) -> None:
    """A misspelt naming, a map without names, and a map that names two labels alike."""
    with refused("unknown_naming"):
        names_for("totalsegmentator_v2", tmp_path, read_from(tmp_path), map_with(None))
    with refused("labels_without_names"):
        names_for(None, tmp_path, read_from(tmp_path), map_with(None))
    with refused("duplicate_name"):
        names_for(None, tmp_path, read_from(tmp_path), map_with({1: "a", 2: "a"}))


def test_patterns_give_every_label_its_rule() -> None:
    rules = select(NAMES, [5, 1, 2], avoid={"aorta": 2, "rib_*": 1}, target=["liver"], where="case.toml").rules
    assert set(rules) == {
        LabelRule(1, "liver", RuleKind.TARGET, 0.0, "liver"),
        LabelRule(2, "rib_left_7", RuleKind.AVOID, 1.0, "rib_*"),
        LabelRule(5, "aorta", RuleKind.AVOID, 2.0, "aorta"),
    }


def test_a_label_that_no_rule_names_is_an_error_that_lists_all_such() -> None:
    with refused("no_rule", "rib_left_8"):
        chosen(avoid={})
    with refused("labels_without_names"):
        chosen(present=(1, 9))


def test_the_most_specific_pattern_holds() -> None:
    """Its own name, then the most characters that are no wildcards, whatever the order; the asterisk is the rest."""
    for avoid, rules, rib in (
        ({"rib_*": 1.0, "*": 9.0}, {}, ("avoid", 1.0)),
        ({"*": 9.0, "rib_*": 1.0, "rib_left_*": 2.0}, {}, ("avoid", 2.0)),
        ({"rib_left_?": 2.0, "rib_*": 3.0, "*": 9.0}, {}, ("avoid", 2.0)),
        ({"rib_left_*": 2.0, "rib_left_?": 3.0, "*": 9.0}, {}, ("avoid", 3.0)),
        ({"rib_left_*": 2.0, "*": 9.0}, {"traverse": ["rib_left_7", "lung_*"]}, ("traverse", 0.0)),
        ({"rib_left_7": 0.5, "*": 9.0}, {"ignore": ["rib_left_*"]}, ("avoid", 0.5)),
        ({"*": 9.0}, {"traverse": ["lung_*", "rib_*"], "ignore": ["rib_left_[78]"]}, ("ignore", 0.0)),
        ({"aorta": 1.0}, {"traverse": ["*"]}, ("traverse", 0.0)),
    ):
        assert chosen(avoid=avoid, **rules)["rib_left_7"] == rib
        assert chosen(avoid=dict(reversed(avoid.items())), **rules)["rib_left_7"] == rib


def test_what_nobody_knows_demands_a_margin_and_is_no_free_space() -> None:
    """A table beside ``avoid``, under the same precedence; a smaller margin than another pattern's is told."""
    found = chosen(avoid={"*": 9.0}, unknown={"rib_*": 4.0, "rib_left_7": 1.0})
    assert (found["rib_left_7"], found["rib_left_8"]) == (("unknown", 1.0), ("unknown", 4.0))
    with refused("two_roles", "rib_*"):
        chosen(avoid={"*": 9.0, "rib_*": 1.0}, unknown={"rib_*": 1.0})
    told = select(NAMES, [2], avoid={"rib_left_*": 1.0}, unknown={"rib_*": 2.0}, where="case.toml").warnings
    assert "by unknown 'rib_*' = 2" in told[0]


def test_two_kinds_that_are_equally_specific_are_an_error() -> None:
    for rules in ({"ignore": ["rib_lef?_*"]}, {"traverse": ["lung_*", "aort?"]}, {"target": ["*"]}):
        with refused("two_roles"):
            chosen(avoid={"rib_?eft_*": 1.0, "a?rta": 5.0, "*": 2.0}, **rules)
    with refused("two_roles"):
        select(NAMES, [5], avoid={"aorta": 0.0}, ignore=["aorta"], where="case.toml")


def test_a_larger_margin_that_does_not_hold_is_told() -> None:
    """But not where the label's own name was written, and not of the rest."""
    selection = select(NAMES, [2], avoid={"rib_*": 1.0, "*_7": 3.0, "*": 9.0}, where="case.toml")
    assert [rule.margin_mm for rule in selection.rules] == [1.0]
    assert selection.warnings == (
        "case.toml: 'rib_left_7' is matched by avoid 'rib_*' and by avoid '*_7' = 3; the more specific applies: "
        "avoid 'rib_*', 1 mm",
    )
    assert select(NAMES, [2], avoid={"rib_left_7": 1.0, "*_7": 3.0}, where="case.toml").warnings == ()
    weaker = select(NAMES, [2], avoid={"*_7": 3.0}, traverse=["rib_*"], where="case.toml").warnings
    assert len(weaker) == 1 and "traverse 'rib_*'" in weaker[0]


def test_a_pattern_that_names_nothing_is_an_error_or_a_warning() -> None:
    """Unknown to a naming that knows all: refused with the nearest names. Known, or of one's own list: a warning."""
    with refused("no_match", "aotra*"):
        chosen(avoid={"rib_*": 1.0, "aotra*": 5.0})
    free = {"avoid": {"*": 5.0, "aotra*": 5.0}, "all_named": False, "where": "case.toml"}
    assert select(NAMES, [5], **free).warnings == ("case.toml: avoid pattern 'aotra*' matches no label present",)
    selection = select(NAMES, [5], avoid={"aorta": 0.0}, ignore=["lung_*"], where="case.toml")
    assert selection.warnings == ("case.toml: ignore pattern 'lung_*' matches no label present",)


def test_margins_are_finite_and_not_negative() -> None:
    """A margin below zero would let a needle in."""
    for margin in (-1.0, float("nan"), float("inf")):
        with refused("out_of_range"):
            chosen(avoid={"rib_*": margin, "aorta": 5.0})


READ = {1: "right lung", 7: "vein, portal"}


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("a.csv", 'id,name\n1,right lung\n\n7,"vein, portal"\n'),
        ("a.csv", 'label,name\n0,background\n1,right lung\n7,"vein, portal"\n'),
        ("a.csv", 'id,label\n1,right lung\n7,"vein, portal"\n'),
        ("a.csv", 'Name,Label Value,Color\nright lung,1,red\n"vein, portal",7,blue\n'),
        ("a.csv", 'LabelValue,Structure\n1,right lung\n7,"vein, portal"\n'),
        ("a.csv", 'index,class_name,volume\n1,right lung,3.2\n7,"vein, portal",4\n'),
        ("a.csv", "\ufeffvalue;name\r\n1;right lung\r\n7;vein, portal\r\n"),
        ("a.tsv", "label_id\torgan\n1\tright lung\n7\tvein, portal\n"),
        ("a.json", '{"1": "right lung", "7": "vein, portal"}'),
        ("a.json", '{"right lung": 1, "vein, portal": 7}'),
        ("a.json", '{"name": "x", "labels": {"background": 0, "right lung": 1, "vein, portal": 7}}'),
        ("a.json", '{"labels": {"0": "background", "1": "right lung", "7": "vein, portal"}}'),
        (
            "a.txt",
            '# ITK-SnAP Label Description File\n0 0 0 0 0 0 0 "Clear Label"\n1 255 0 0 1 1 1 "right lung"\n'
            ' 7   0 9 0        0.5  1  1    "vein, portal"\n',
        ),
        ("a.ctbl", '# Color table\n0 Background 0 0 0 0\n1 "right lung" 1 2 3 255\n7 "vein, portal" 1 2 3 255\n'),
    ],
)
def test_common_tables_are_read(file: str, text: str) -> None:
    assert parse_names(text.encode(), Path(file)) == READ


def test_an_apostrophe_in_a_colour_table_is_part_of_a_name() -> None:
    text = "# Color table\n1 Meckel's_cave 1 2 3 255\n2 \"Broca's area\" 1 2 3 255\n3 a\\b 1 2 3 255\n"
    assert parse_names(text.encode(), Path("a.ctbl")) == {1: "Meckel's_cave", 2: "Broca's area", 3: "a\\b"}


@pytest.mark.parametrize(
    ("file", "text", "match"),
    [
        ("a.csv", "", "wrong_columns"),
        ("a.csv", "id,name\n", "empty"),
        ("a.csv", "id,name\n1,a\n2,a\n", "duplicate_name"),
        ("a.csv", "id,name\n1,\n", "bad_name"),
        ("a.csv", b"id,name\n1,\xff\n", "not_text"),
        ("a.csv", 'id,name\n1,"a\n', "not_csv"),
        ("a.csv", "1,liver\n", "wrong_columns"),
        ("a.csv", "name,colour\nliver,red\n", "wrong_columns"),
        ("a.csv", "label,name\n0,liver\n", "bad_label"),
        ("a.csv", "label,name\n1,liver\n1,spleen\n", "duplicate_label"),
        ("a.csv", "label,name\n1.0,liver\n", "bad_label 1.0"),
        ("a.csv", "label,name\n99999,liver\n", "bad_label"),
        ("a.csv", "label,name\n1,liver,red\n", "ragged_row"),
        ("a.json", '{"1": "liver", "1": "spleen"}', "not_json"),
        ("a.json", '{"liver": [1, 2]}', "labels_of_regions"),
        ("a.json", '{"liver": {"a": 1}}', "wrong_format"),
        ("a.json", '["liver"]', "wrong_format"),
        ("a.json", "{}", "empty"),
        ("a.txt", "1 liver\n", "unknown_line"),
        ("a.txt", '1 255 0 0 1 1 1 "liver\n', "unknown_line"),
    ],
)
def test_what_is_no_table_is_refused(file: str, text: str | bytes, match: str) -> None:
    with refused(*match.split()):
        names_for(file, Path(), lambda _: text if isinstance(text, bytes) else text.encode(), map_with(None))


PLACES = {
    "liver": (-80, 0, 30), "spleen": (90, 40, 50), "kidney_left": (60, 50, -20), "kidney_right": (-60, 50, -30),
    "vertebrae_T12": (0, 80, 60), "vertebrae_L1": (0, 80, 20), "vertebrae_L3": (0, 80, -40),
    "vertebrae_L4": (0, 80, -70), "hip_left": (80, 40, -90), "hip_right": (-80, 40, -90),
}  # fmt: skip
"""Middles of organs, LPS mm."""


def numbered(table: Mapping[int, str], places: dict[str, tuple[int, int, int]]) -> LabelMap:
    labels = np.zeros((24, 24, 24), np.uint8)
    T = np.diag([10.0, 10.0, 10.0, 1.0])
    T[:3, 3] = -120.0
    numbers = {name: label for label, name in table.items()}
    for name, place in places.items():
        labels[tuple(((np.array(place) + 120) / 10).astype(int))] = numbers[name]
    return LabelMap(labels, T, None, "a.nii.gz")


@pytest.mark.parametrize(("table", "name"), [(V1, "totalsegmentator-v1"), (V2, "totalsegmentator-v2")])
def test_the_version_under_which_organs_lie_right_is_told(table: Mapping[int, str], name: str) -> None:
    assert likely_numbering(numbered(table, PLACES)) == name


def test_what_cannot_be_told_is_not_guessed() -> None:
    """The first six numbers are alike in both versions; a mirrored map fits none."""
    few = {name: PLACES[name] for name in ("liver", "spleen", "kidney_left", "kidney_right")}
    assert likely_numbering(numbered(V1, few)) is None
    mirrored = {name: (-x, y, -z) for name, (x, y, z) in PLACES.items()}
    assert likely_numbering(numbered(V1, mirrored)) is None
    assert likely_numbering(numbered(V2, mirrored)) is None


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real CT is not at {REAL}")
@pytest.mark.parametrize(
    ("file", "name"),
    [("labels_v1_normal.nii.gz", "totalsegmentator-v1"), ("labels_v2_fast.nii.gz", "totalsegmentator-v2")],
)
def test_the_version_of_real_maps_is_told(file: str, name: str) -> None:
    """Of the same patient, by both versions; also of the lower half alone."""
    whole = labelmap_of(read_volume(REAL / file))
    assert likely_numbering(whole) == name
    half = LabelMap(whole.labels[:, :, :60], whole.T_ct_index, None, whole.path)
    assert likely_numbering(half) == name
