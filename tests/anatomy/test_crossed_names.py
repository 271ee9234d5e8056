"""Names that no table knows: what holds the target beside a lesion is crossed only if its whole name tells it."""

import pytest

from puncture_twin.planning.anatomy.crossed_names import BONES, ORGANS, QUALIFIERS, SOFT_TISSUES, named_as_crossed
from puncture_twin.planning.anatomy.default_roles import UNKNOWN_NAME, never_crossed
from puncture_twin.planning.init.roles import Holding, assign, chosen_target

DANGERS = {
    "abbreviations": ["AAA", "ICA", "SMA", "SMV", "CBD", "A. hepatica", "V. renalis", "hepatic a.", "Aa. renales"],
    "German": ["Rückenmark", "Herz", "Darm", "Galle", "Lungenvene", "Nierenvene", "Pfortader", "Bauchschlagader"],
    "French": ["moelle épinière", "cœur", "intestin", "vésicule", "artère pulmonaire", "veine rénale", "vaisseau"],
    "of an organ": ["liver veins", "kidney_pelvis", "lung vessels", "thyroid cartilage", "pancreas duct"],
    "of a lesion": ["Tumorvene", "Metastasenarterie", "hccvein", "GTVein", "Tumorgefäße", "tumor feeder"],
    "of an adjective": ["left middle cerebral", "posterior_inferior_cerebellar", "lymph", "femoris", "spinae"],
    "no names": ["Segment_1", "label 7", "structure", "left"],
}
CROSSED = [
    "Left Lung",
    "LIVER",
    "kidney-r",
    "vertebrae_L1",
    "liver tumour 2",
    "lung_upper_lobe_left",
    "L_adrenal gland",
    "left cerebral white matter",
    "erector spinae",
    "lymph node 3",
    "GTV1",
]


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
    for name in CROSSED:
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


@pytest.mark.parametrize("name", ["tumor-artery", "lung_lesion_vessels", "peritumoralVessels", "aneurysm mass"])
def test_a_vessel_of_a_lesion_is_a_vessel(name):
    """As a target it was a lesion by its name, and nothing kept the needle out of it."""
    line = never_crossed(name)
    assert line is not None and line.group == "other vessels"
    assert never_crossed("hypervascular lesion") is None and never_crossed("brainstem tumour") is None


def test_a_foreign_word_beside_known_ones_is_never_crossed(rng):
    """Drawn names: known words, one letter of one of them changed or one word more, and the whole is not known."""
    words = sorted(ORGANS | BONES | SOFT_TISSUES | QUALIFIERS)
    nouns = sorted(ORGANS | BONES | SOFT_TISSUES)
    for _ in range(500):
        known = [str(rng.choice(nouns)), *map(str, rng.choice(words, rng.integers(0, 3)))]
        rng.shuffle(known)
        assert named_as_crossed("_".join(known))
        foreign = "".join(rng.choice(list("aeiouvnrst"), rng.integers(2, 9)))
        if foreign in words:
            continue
        assert not named_as_crossed("_".join([*known, foreign]))
        assert not named_as_crossed("_".join([*known[:-1], known[-1] + foreign])) or known[-1] + foreign in words


def test_the_margin_is_the_tables():
    """Of a name that a line knows its margin, of others the largest."""
    rows = assign({1: "colon", 2: "AAA"}, "abdomen", Holding("tumor", frozenset({"colon", "AAA"})))
    assert [(row.kind, row.margin_mm) for row in rows] == [("unknown", 3.0), ("unknown", UNKNOWN_NAME.margin_mm)]
