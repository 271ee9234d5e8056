"""Names of labels, and the rules that patterns give them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import REAL_CT
from refusals import refused

from puncture_twin.planning.formats.labels.labelmaps import LabelMap
from puncture_twin.planning.formats.labels.naming import V1, V2, LabelRule, RuleKind, names_for, select

REAL = REAL_CT
NAMES = {1: "liver", 2: "rib_left_7", 3: "rib_left_8", 4: "lung_lower_lobe_left", 5: "aorta"}


def map_with(names: dict[int, str] | None) -> LabelMap:
    """A label map of nothing but its names."""
    return LabelMap(np.ones((2, 2, 2), dtype=np.int32), np.eye(4), names, Path("a.seg.nrrd"))


def chosen(present: tuple[int, ...] = (1, 2, 3, 4, 5), **rules: Any) -> dict[str, tuple[str, float]]:
    """Name to kind and margin."""
    given = {"avoid": {"rib_*": 1.0, "aorta": 5.0}, "traverse": ["lung_*"], "target": ["liver"], **rules}
    selection = select(NAMES, present, where="case.toml", **given)
    return {rule.name: (str(rule.kind), rule.margin_mm) for rule in selection.rules}


def test_tables_have_their_sizes_and_the_versions_differ() -> None:
    """104 and 117 classes with distinct names; the aorta is 7 or 52."""
    assert (len(V1), len(V2)) == (104, 117)
    assert len(set(V1.values())) == 104
    assert len(set(V2.values())) == 117
    assert (V1[7], V1[104], V2[52], V2[117]) == ("aorta", "urinary_bladder", "aorta", "costal_cartilages")
    with pytest.raises(TypeError):
        V1[7] = "liver"  # type: ignore[index]


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real CT is not at {REAL}")
@pytest.mark.parametrize(("table", "name"), [(V1, "labels_v1_normal.json"), (V2, "labels_v2_fast.json")])
def test_tables_agree_with_the_real_label_maps(table: dict[int, str], name: str) -> None:
    """Each name that comes with the data is the table's."""
    named = json.loads((REAL / name).read_text())
    assert {int(label): text for label, text in named.items()} == {int(label): table[int(label)] for label in named}


def read_from(folder: Path) -> Callable[[str], bytes]:
    """Gives the bytes of a file of this folder."""
    return lambda name: (folder / name).read_bytes()


def test_namings_by_name_by_file_and_by_the_map_itself(tmp_path: Path) -> None:
    """All four ways to name labels."""
    (tmp_path / "names.csv").write_text('id,name\n1,liver\n\n7,"vein, portal"\n', encoding="utf-8")
    assert names_for("totalsegmentator-v1", tmp_path, read_from(tmp_path), map_with(None))[7] == "aorta"
    assert names_for("totalsegmentator-v2", tmp_path, read_from(tmp_path), map_with(None))[52] == "aorta"
    assert names_for("names.csv", tmp_path, read_from(tmp_path), map_with(None)) == {1: "liver", 7: "vein, portal"}
    assert names_for(None, tmp_path, read_from(tmp_path), map_with({3: "x"})) == {3: "x"}
    assert names_for("seg.nrrd", tmp_path, read_from(tmp_path), map_with({3: "x"})) == {3: "x"}


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "wrong_columns"),
        (b"id,name\n", "empty"),
        (b"id,name\n0,a\n", "bad_label"),
        (b"id,name\n-1,a\n", "bad_label"),
        (b"id,name\n1.5,a\n", "bad_label"),
        (b"id,name\n1,a\n2,a\n", "duplicate_name"),
        (b"id,name\n1,\n", "bad_name"),
        (b"id,name\n1,\xff\n", "not_text"),
        (b'id,name\n1,"a\n', "not_csv"),
    ],
)
def test_broken_name_tables_are_refused(tmp_path: Path, content: bytes, match: str) -> None:
    """By line where there is one."""
    (tmp_path / "names.csv").write_bytes(content)
    with refused(*match.split()):
        names_for("names.csv", tmp_path, read_from(tmp_path), map_with(None))


def test_unknown_namings_are_refused_with_the_nearest(tmp_path: Path) -> None:
    """A misspelt naming, a map without names, and a map that names two labels alike."""
    with refused("unknown_naming"):
        names_for("totalsegmentator_v2", tmp_path, read_from(tmp_path), map_with(None))
    with refused("labels_without_names"):
        names_for(None, tmp_path, read_from(tmp_path), map_with(None))
    with refused("duplicate_name"):
        names_for(None, tmp_path, read_from(tmp_path), map_with({1: "a", 2: "a"}))


def test_patterns_give_every_label_its_rule() -> None:
    """Kinds and margins come from the pattern that matches."""
    assert chosen() == {
        "liver": ("target", 0.0),
        "rib_left_7": ("avoid", 1.0),
        "rib_left_8": ("avoid", 1.0),
        "lung_lower_lobe_left": ("traverse", 0.0),
        "aorta": ("avoid", 5.0),
    }
    first = select(NAMES, [5], avoid={"aorta": 2}, where="case.toml").rules
    assert first == (LabelRule(5, "aorta", RuleKind.AVOID, 2.0, "aorta"),)


def test_a_label_that_no_rule_names_is_an_error_that_lists_all_such() -> None:
    """What is present and not spoken of is never silently free."""
    with refused("no_rule", "rib_left_8"):
        chosen(avoid={})
    with refused("labels_without_names"):
        chosen(present=(1, 9))


@pytest.mark.parametrize(
    ("avoid", "rules", "rib"),
    [
        ({"rib_*": 1.0, "*": 9.0}, {}, ("avoid", 1.0)),
        ({"*": 9.0, "rib_*": 1.0, "rib_left_*": 2.0}, {}, ("avoid", 2.0)),
        ({"rib_left_?": 2.0, "rib_*": 3.0, "*": 9.0}, {}, ("avoid", 2.0)),
        ({"rib_left_*": 2.0, "rib_left_?": 3.0, "*": 9.0}, {}, ("avoid", 3.0)),
        ({"rib_left_*": 2.0, "*": 9.0}, {"traverse": ["rib_left_7", "lung_*"]}, ("traverse", 0.0)),
        ({"rib_left_7": 0.5, "*": 9.0}, {"ignore": ["rib_left_*"]}, ("avoid", 0.5)),
        ({"*": 9.0}, {"traverse": ["lung_*", "rib_*"], "ignore": ["rib_left_[78]"]}, ("ignore", 0.0)),
        ({"aorta": 1.0}, {"traverse": ["*"]}, ("traverse", 0.0)),
    ],
)
def test_the_most_specific_pattern_holds(
    avoid: dict[str, float], rules: dict[str, list[str]], rib: tuple[str, float]
) -> None:
    """Its own name, then the most characters that are no wildcards, whatever the order; the asterisk is the rest."""
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


@pytest.mark.parametrize("rules", [{"ignore": ["rib_lef?_*"]}, {"traverse": ["lung_*", "aort?"]}, {"target": ["*"]}])
def test_two_kinds_that_are_equally_specific_are_an_error(rules: dict[str, list[str]]) -> None:
    """Nothing says which is meant; both are named."""
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


def test_names_with_spaces_can_be_named() -> None:
    """As Slicer writes them: in every kind, whole or by pattern."""
    names = {1: "right lung", 2: "left lung", 3: "liver lesion 1"}
    found = select(names, names, avoid={"left lung": 2.0}, traverse=["right *"], target=["liver lesion*"], where="c")
    assert [str(rule.kind) for rule in found.rules] == ["traverse", "avoid", "target"]


def test_a_pattern_that_names_nothing_is_an_error_or_a_warning() -> None:
    """Unknown to a naming that knows all: refused with the nearest names. Known, or of one's own list: a warning."""
    with refused("no_match", "aotra*"):
        chosen(avoid={"rib_*": 1.0, "aotra*": 5.0})
    free = {"avoid": {"*": 5.0, "aotra*": 5.0}, "all_named": False, "where": "case.toml"}
    assert select(NAMES, [5], **free).warnings == ("case.toml: avoid pattern 'aotra*' matches no label present",)
    selection = select(NAMES, [5], avoid={"aorta": 0.0}, ignore=["lung_*"], where="case.toml")
    assert selection.warnings == ("case.toml: ignore pattern 'lung_*' matches no label present",)


@pytest.mark.parametrize("margin", [-1.0, float("nan"), float("inf")])
def test_margins_are_finite_and_not_negative(margin: float) -> None:
    """A margin below zero would let a needle in."""
    with refused("out_of_range"):
        chosen(avoid={"rib_*": margin, "aorta": 5.0})
