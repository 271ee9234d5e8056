"""An image that ends in the body: the flange must stay inside of it, inserted and while the tip waits at its standoff.

The trunk is a box of 400 x 160 x 240 mm, cut at the head 60 mm from the target, which lies 80 mm below the front. A
needle tilted by t toward the head leaves the image 60 / sin(t) mm from the target, its path is 80 / cos(t) long, and it
meets the skin at the angle t. Nothing says where the arms lie: beyond the plane of the cut all is unknown.
"""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import trimesh
from case_world import case_text, structure
from refusals import refused

from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.entry import Directions, outward
from puncture_twin.planning.certify.certificate import read_certificate, write_certificate
from puncture_twin.planning.certify.checker import verify
from puncture_twin.planning.certify.subdivision import certify
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates

DEG = np.pi / 180.0
LENGTH = 210.0
CAP = {"theta": (4 * DEG, 40 * DEG), "beta": (-30 * DEG, 30 * DEG)}
"""Toward the head; angles from 0 to 25 degrees are imaged, waited for beyond the image, or inserted beyond it."""


def cut_case(folder, standoff="", more=""):
    """The trunk with its image's end, prepared without an arm."""
    for name, size, middle in (
        ("skin", (400, 160, 240), (0, 0, 0)),
        ("lesion", (10, 10, 10), (0, 0, 60)),
        ("spine", (30, 30, 200), (0, 50, 0)),
    ):
        mesh = trimesh.creation.box(extents=size)
        mesh.apply_translation(middle)
        mesh.export(folder / f"{name}.stl")
    text = case_text(
        structure("skin", "skin", cut=["head"]),
        structure("lesion", "target"),
        structure("spine", "avoid", margin_mm=2.0) + more,
        target='position_mm = [0.0, 0.0, 60.0]\nstructure = "lesion"',
        needle=f"length_mm = 210.0\nshaft_mm = 150.0\ndiameter_mm = 1.2\n{standoff}",
        search="step_deg = 2.0\nmax_skin_angle_deg = 60",
    )
    (folder / "case.toml").write_text(text)
    return prepare(folder / "case.toml", arm=False)


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """The trunk, whose tips wait just outside the skin."""
    return cut_case(tmp_path_factory.mktemp("cut"))


@pytest.fixture(scope="module")
def certified(cut):
    return certify(cut.case, cut.anatomy, size=0.5 * DEG, **CAP)


def gap(angle):
    """From the waiting tip to the skin, as docs/concepts/search.md states it, mm."""
    return np.maximum(10.0, 5.0 + (0.6 + 5.0) * np.tan(angle) + 1.0)


KEPT = 0.6 + 2.0
"""The needle's radius, and the margin of what is unknown, mm."""


def leaves_while_waiting(tilt):
    """By school geometry: the flange at standoff lies beyond the image's end, or too near to it."""
    return 60.0 - (LENGTH + 80.0 / np.cos(tilt) + gap(tilt)) * np.sin(tilt) < KEPT


def rated(context, theta, beta):
    theta, beta = np.atleast_1d(theta), np.broadcast_to(beta, np.shape(np.atleast_1d(theta)))
    directions = Directions(theta, beta, outward(theta, beta) @ context.case.T_ct_entry[:3, :3].T)
    return organ_candidates(context.case, context.anatomy, context.engine, directions)


def test_an_inserted_flange_inside_and_a_waiting_one_outside_is_unknown(cut):
    """14 degrees: the image ends 248 mm from the target, the flange comes from 302 mm; the reason names that depth."""
    found = cut.check(14 * DEG, 0.0)
    assert found.verdict.reason[0] == Reason.UNKNOWN_REGION
    assert found.verdict.structure[0] == "beyond_image"
    assert found.verdict.depth[0] == pytest.approx(60.0 / np.sin(14 * DEG))
    assert LENGTH < found.verdict.depth[0] < LENGTH + 80.0 / np.cos(14 * DEG) + 10.0


def test_each_directions_own_standoff_decides(cut):
    """Safe and unknown part where the own flange leaves, not where the flange of the longest path would."""
    tilt = np.arange(4.0, 30.0, 0.01) * DEG
    found = rated(cut, tilt, 0.0)
    np.testing.assert_array_equal(found.safe, ~leaves_while_waiting(tilt))
    assert (found.verdict.reason[~found.safe] == Reason.UNKNOWN_REGION).all()
    longest = LENGTH + 150.0 + gap(60 * DEG)
    assert found.safe[60.0 - longest * np.sin(tilt) < KEPT].sum() > 100


def test_a_stated_standoff_decides(tmp_path):
    """With standoff_mm the flange waits as far out along every path: the image must reach beyond 330 mm."""
    context = cut_case(tmp_path, "standoff_mm = 120.0")
    tilt = np.arange(4.0, 30.0, 0.01) * DEG
    np.testing.assert_array_equal(rated(context, tilt, 0.0).safe, 60.0 - (LENGTH + 120.0) * np.sin(tilt) >= KEPT)


def test_a_path_without_a_standoff_keeps_its_reason(cut):
    """Where no tip ever waits, the constraint that forbids it is the reason, here a path of 170 mm to the side."""
    found = cut.check(62 * DEG, 80 * DEG)
    assert found.verdict.reason[0] == Reason.TOO_LONG


def test_the_certificate_agrees_with_the_search(cut, certified, rng):
    """Random directions of the cap: none of a safe cell is refused, none of a rejected one safe; few are undecided."""
    theta, beta = rng.uniform(*CAP["theta"], 2000), rng.uniform(*CAP["beta"], 2000)
    found = rated(cut, theta, beta)
    letters = certified.at(theta, beta)
    assert found.safe[letters == "S"].all()
    assert not found.safe[letters == "R"].any()
    assert min((letters == "S").sum(), (letters == "R").sum()) > 150
    assert certified.fraction("U") < 0.05
    verify(certified, cut.case, cut.anatomy)


def beyond_image(case, certificate):
    """Rejected cells all of whose needles are imaged when inserted, and not while the tip waits."""
    sine = np.sin(certificate.leaves.theta) * np.cos(np.abs(certificate.leaves.beta))
    middle = certificate.leaves.centres() @ case.T_ct_entry[:3, :3].T
    own = LENGTH + 80.0 / -middle[:, 1] + 10.0
    return (certificate.verdict == "R") & (60.0 / sine.max(axis=1) > LENGTH + 1.0) & (60.0 / middle[:, 2] < own - 3.0)


def forged(certificate, rows, tmp_path):
    """The certificate as a file in which cells are claimed safe, whole and agreeing with itself."""
    write_certificate(claiming(certificate, rows, "S", ""), tmp_path / "c.json")
    return read_certificate(tmp_path / "c.json")


def claiming(certificate, rows, letter, why):
    """The certificate with another verdict and reason of cells."""
    verdict, reason, beside = certificate.verdict.copy(), certificate.reason.copy(), certificate.structure.copy()
    verdict[rows], reason[rows] = letter, why
    beside[rows] = "" if letter == "S" else beside[rows]
    letters = iter(verdict)
    tree = tuple("".join(x if x.islower() else str(next(letters)) for x in level) for level in certificate.tree)
    return replace(certificate, tree=tree, verdict=verdict, reason=reason, structure=beside)


def test_a_cell_forged_safe_whose_waiting_flange_leaves_the_image_is_refused(cut, certified, tmp_path):
    """Several such cells, each by itself, and all at once: the checker names the cell."""
    rows = np.flatnonzero(beyond_image(cut.case, certified))
    assert len(rows) > 20
    for forgery in (*rows[:: len(rows) // 3, None], rows):
        with refused("cell_not_proven", forgery[0]):
            verify(forged(certified, forgery, tmp_path), cut.case, cut.anatomy)


def test_a_certificate_for_inserted_needles_alone_is_refused(cut, certified, monkeypatch):
    """Whole and true of the inserted needle: with the flange at the needle's length the maker proves too much safe."""
    module = import_module("puncture_twin.planning.certify.subdivision")
    monkeypatch.setattr(module, "any_flange", lambda *asked: np.full((asked[-1], 2), LENGTH))
    monkeypatch.setattr(module, "flange_bounds", lambda needle, question, skin: np.full((len(skin.count), 2), LENGTH))
    careless = certify(cut.case, cut.anatomy, size=0.5 * DEG, **CAP)
    assert careless.fraction("S") > certified.fraction("S") + 0.05
    with refused("cell_not_proven"):
        verify(careless, cut.case, cut.anatomy)


def test_a_cell_forged_out_of_the_image_is_refused(cut, certified, tmp_path):
    """A safe cell beside the border, claimed to leave the image: not proven either."""
    row = int(np.flatnonzero(certified.verdict == "S")[-1])
    with refused("cell_not_proven", row):
        verify(claiming(certified, row, "R", Reason.UNKNOWN_REGION.value), cut.case, cut.anatomy)


def test_another_gap_is_another_question(cut, certified):
    """The certificate states what its standoffs follow from: with another gap or standoff it is refused."""
    for needle in (replace(cut.case.needle, skin_gap_mm=11.0), replace(cut.case.needle, standoff_mm=170.0)):
        with refused("certificate_of_another"):
            verify(certified, replace(cut.case, needle=needle), cut.anatomy)


LAMP = '[[obstacle]]\nname = "lamp"\nframe = "ct"\ncenter_mm = [0.0, {y}, 60.0]\nsize_mm = [40.0, 10.0, 40.0]'


@pytest.mark.parametrize(("before", "safe"), [(40.0, True), (0.7, True), (0.5, False), (-4.0, False)])
def test_an_obstacle_counts_up_to_the_flange_of_its_direction(tmp_path, before, safe):
    """The flange waits at 300 mm straight in (a path of 150 mm would need 370): a lamp behind it is as far as it is."""
    context = cut_case(tmp_path, more=LAMP.format(y=-(300.0 + before + 5.0)))
    found = context.check(0.0, 0.0)
    column = found.clearance.structures.index("lamp")
    assert found.safe[0] == safe
    assert found.clearance.by_structure[0, column] == pytest.approx(max(before, 0.0) - 0.6, abs=1e-6)
    assert safe or found.verdict.depth[0] <= 300.0
    assert context.cross_check(50).largest_mm < 1e-6


def test_no_reported_depth_exceeds_the_flange(tmp_path):
    """A lamp across many directions, some of whose flanges wait before it: each depth lies before its own flange."""
    context = cut_case(tmp_path, more=LAMP.format(y=-300.0).replace("40.0, 10.0, 40.0", "400.0, 10.0, 400.0"))
    tilt = np.linspace(0.0, 30.0, 301) * DEG
    found = rated(context, tilt, np.pi)
    flange = LENGTH + found.path.length + gap(found.path.skin_angle)
    close = found.verdict.structure == "lamp"
    assert 20 < close.sum() < 300
    assert (found.verdict.depth[close] <= flange[close] + 1e-9).all()
    np.testing.assert_array_equal(close, 295.0 - np.cos(tilt) * flange < 0.6)


def test_a_catalogue_says_what_a_case_with_that_needle_says(tmp_path):
    """Each needle's count is that of a case of its own; the shortest that fits the best path, straight in, is named."""
    context = cut_case(tmp_path, "lengths_mm = [110.0, 210.0, 160.0]")
    context = replace(context, case=replace(context.case, search=replace(context.case.search, step=10 * DEG)))
    (said,) = (one for one in context.search().findings if one.code == "needle_catalogue")
    expected = []
    for shaft in (50.0, 100.0, 150.0):
        needle = replace(context.case.needle, length_mm=shaft + 60.0, shaft_mm=shaft, lengths_mm=())
        expected.append(replace(context, case=replace(context.case, needle=needle)).search().safe.sum())
    assert said.numbers["lengths_mm"] == [110.0, 160.0, 210.0]
    assert said.numbers["safe"] == expected
    assert expected[0] == 0 and min(expected[1:]) > 100
    assert said.numbers["shortest_mm"][0] == 160.0


@pytest.mark.parametrize("lengths", ["[160.0]", "[60.0, 210.0]"])
def test_a_catalogue_without_the_needle_or_with_one_that_has_no_shaft_is_refused(tmp_path, lengths):
    """``length_mm`` is one of them, and each is longer than the holder by 10 mm at least."""
    with refused("out_of_range", "lengths_mm"):
        cut_case(tmp_path, f"lengths_mm = {lengths}")
