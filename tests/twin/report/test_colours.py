"""Colours that a reader with deuteranopia tells apart, and that look as they do in the field."""

from itertools import combinations

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab

from puncture_twin.planning.base.reasons import REASON_COLOURS, SAFE, UNSEEN_AIR, Reason
from puncture_twin.twin.report.map.map_raster import HATCH, HATCH_AIR
from puncture_twin.twin.report.palette import CUSTOM_COLOURS, ORGAN_COLOURS, SAFE_HIGH, SAFE_LOW, organ_colours

DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
PROTANOPIA = np.array(
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
)
"""Of linear RGB, severity 1 (Machado et al. 2009, table 1)."""

READERS = {"any": np.eye(3), "deuteranopia": DEUTERANOPIA, "protanopia": PROTANOPIA}

TRUNK = (
    "lesion", "aorta", "hepatic_veins", "portal_vein", "ribs_right", "costal_cartilages", "psoas_muscle", "liver",
    "kidney_left", "spleen", "pancreas", "gallbladder", "stomach", "duodenum", "small_bowel", "colon", "oesophagus",
    "lung_right", "heart", "adrenal_gland_left",
)  # fmt: skip
"""What lies side by side in one picture."""

AIM_AND_VESSELS = TRUNK[:4]


def as_seen(colour, reader=DEUTERANOPIA):
    """A colour in Lab as a reader with deuteranopia, or another, sees it."""
    rgb = np.asarray(colour) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(reader @ linear, 0, 1)
    return rgb2lab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))


def difference(first, second, reader=DEUTERANOPIA):
    """CIEDE2000 between two colours as that reader sees them."""
    return float(deltaE_ciede2000(as_seen(first, reader), as_seen(second, reader)))


@pytest.mark.parametrize(
    ("reader", "vessel", "organ"), [("any", 18, 11.5), ("deuteranopia", 10, 5), ("protanopia", 10, 5)]
)
def test_organs_of_one_picture_are_told_apart(reader, vessel, organ):
    """Lesion and vessels from everything at a glance; other organs from each other."""
    colours = organ_colours(TRUNK)
    for first, second in combinations(TRUNK, 2):
        least = vessel if {first, second} & set(AIM_AND_VESSELS) else organ
        found = difference(colours[first], colours[second], READERS[reader])
        assert found > least, f"{first} and {second} differ by {found:.1f}"


def test_structures_without_a_custom_are_no_vessels():
    """To every reader, and each is told from the next."""
    aimed = organ_colours(AIM_AND_VESSELS).values()
    for colour in ORGAN_COLOURS:
        assert min(difference(colour, one, READERS["any"]) for one in aimed) > 15
    assert min(difference(a, b, READERS["any"]) for a, b in combinations(ORGAN_COLOURS, 2)) > 10


def test_a_structure_keeps_its_colour_in_any_company():
    """One of custom looks alike beside whatever else a case names; vessels in the liver are no liver."""
    alone = {name: organ_colours((name,))[name] for name in TRUNK}
    assert organ_colours(("spare", *reversed(TRUNK), "other")).items() >= alone.items()
    vessels = organ_colours(("liver_vessels", "lung_vessels"))
    assert len({*vessels.values()}) == 1 and not {*vessels.values()} & {alone["liver"], alone["lung_right"]}


def test_the_difference_is_that_of_equal_and_of_opposite_colours():
    """Nothing between equal ones, 100 between black and white, little between the red and green they confuse."""
    assert difference(SAFE, SAFE) == 0 and difference((0, 0, 0), (255, 255, 255)) == pytest.approx(100, abs=1e-3)
    confused = [(161, 105, 56), (110, 131, 60)]
    assert difference(*confused) < 8 < float(deltaE_ciede2000(*(rgb2lab(np.array(c) / 255) for c in confused)))


@pytest.mark.parametrize("shade", [SAFE, SAFE_LOW, SAFE_HIGH])
def test_safe_is_told_from_unknown_by_more_than_its_hue(shade):
    """Unknown is hatched, in lines that differ from its own ground by more than 30; no shade of safe is hatched."""
    unknown = REASON_COLOURS[Reason.UNKNOWN_REGION]
    assert difference(unknown, HATCH) > 30
    assert min(difference(shade, unknown), difference(shade, HATCH)) > 5


def test_what_is_unknown_in_the_body_is_told_from_what_is_beside_it():
    """By ground and by lines, to every reader; neither pair is of one lightness."""
    for reader in READERS.values():
        assert difference(REASON_COLOURS[Reason.UNKNOWN_REGION], UNSEEN_AIR, reader) > 20
        assert difference(UNSEEN_AIR, HATCH_AIR, reader) > 30


@pytest.mark.parametrize("reason", [r for r in REASON_COLOURS if r is not Reason.UNKNOWN_REGION])
def test_no_other_reason_looks_safe(reason):
    """To the same reader, beside the legend's green: 10 is a difference that is seen at a glance."""
    assert difference(REASON_COLOURS[reason], SAFE) > 10


def test_no_structure_is_green_as_safe_is():
    """To every reader: what is green in the scene is where a needle may go."""
    for colour in (*ORGAN_COLOURS, *(colour for colour, _ in CUSTOM_COLOURS)):
        for shade in (SAFE, SAFE_HIGH):
            lab = (rgb2lab(np.array(one) / 255) for one in (colour, shade))
            assert float(deltaE_ciede2000(*lab)) > 15, colour


def test_right_and_left_are_one_colour():
    """Of custom or by turn, in any way of naming sides; others differ from their neighbours."""
    pairs = [("rib_right_9", "rib_left_9"), ("ovary_right", "ovary_left"), ("Right eye", "Left eye")]
    colours = organ_colours(tuple(name for pair in pairs for name in pair))
    assert all(colours[first] == colours[second] for first, second in pairs)
    assert colours["ovary_right"] != colours["Right eye"]
