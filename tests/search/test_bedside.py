"""The skin entry in words that can be measured on the patient, and the needle's angles in the scanner."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.search.bedside import Landmark, entry_facts, entry_place, needle_planes
from puncture_twin.planning.search.context import prepare
from tests.case_world import write_case

LEFT, BACK, HEAD = np.eye(3)
FRONT = -BACK
WORDS = {
    "to the left": LEFT,
    "to the right": -LEFT,
    "toward the back": BACK,
    "toward the front": FRONT,
    "toward the head": HEAD,
    "toward the feet": -HEAD,
}
"""LPS, written out once more."""


def walked(text, start):
    steps = re.findall(r"(\d+) mm (to the \w+|toward the \w+)", text)
    return start + sum((float(mm) * WORDS[way] for mm, way in steps), np.zeros(3))


coordinates = st.tuples(*[st.floats(-300, 300)] * 3).map(np.array)


@given(entry=coordinates, markers=st.lists(coordinates, min_size=1, max_size=4))
def test_who_follows_the_words_from_the_nearest_marker_arrives_at_the_entry(entry, markers):
    """To half a millimetre an axis, whatever the space of the case: the words are of the body."""
    landmarks = [Landmark(f"marker {number}", point) for number, point in enumerate(markers)]
    place = entry_place(entry, landmarks)
    distances = [float(np.sqrt(((entry - point) ** 2).sum())) for point in markers]
    assert place.distance_mm == pytest.approx(min(distances))
    for space in (Space.LPS, Space.RAS):
        assert np.abs(walked(place.text(space), place.landmark.point_ct) - entry).max() <= 0.5 + 1e-9


@pytest.mark.parametrize(
    ("offset", "text"),
    [
        ((-52.2, 0.3, -31.8), "52 mm to the right and 32 mm toward the feet of marker A"),
        ((3.0, -4.0, 5.0), "3 mm to the left, 5 mm toward the head and 4 mm toward the front of marker A"),
        ((0.0, 0.4, 0.0), "at marker A"),
    ],
)
def test_the_words(offset, text):
    """Across first, then along the body, then front or back; what a ruler does not show is left out."""
    place = entry_place(np.array(offset) + 7.0, [Landmark("marker A", np.full(3, 7.0))])
    assert place.text(Space.RAS) == text


def test_without_an_entry_or_anatomy_words_are_fewer():
    place = entry_place(np.array([10.0, -20.0, 0.0]), [Landmark("marker A", np.zeros(3))])
    assert place.text(Space.LOCAL) == "10 mm along +x and 20 mm along -y from marker A"
    assert entry_place(np.full(3, np.nan), [Landmark("marker A", np.zeros(3))]) is None


@given(st.floats(-179, 179), st.floats(-89, 89))
def test_a_needle_that_is_turned_by_the_angles_is_the_needle(in_plane_deg, out_of_plane_deg):
    axis = Rotation.from_rotvec(np.radians(in_plane_deg) * HEAD)  # front (-y) turns to the left (+x) about the head
    in_slice = axis.apply(FRONT)
    lifted = Rotation.from_rotvec(-np.radians(out_of_plane_deg) * np.cross(HEAD, in_slice)).apply(in_slice)
    found = needle_planes(lifted)
    assert np.degrees(found.out_of_plane) == pytest.approx(out_of_plane_deg, abs=1e-6)
    assert np.degrees(found.in_plane) == pytest.approx(in_plane_deg, abs=1e-6)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda u: np.linalg.norm(u) > 0.1))
def test_a_slice_that_is_tilted_so_holds_the_needle(direction):
    """The slice's normal, turned about the left-right axis, is across the needle; its top leans as it is said."""
    u = np.array(direction) / np.linalg.norm(direction)
    tilt = needle_planes(u).gantry_tilt
    turn = Rotation.from_rotvec(tilt * LEFT)  # takes the top, the front, toward the feet for a positive tilt
    assert (turn.apply(FRONT) @ -HEAD) == pytest.approx(np.sin(tilt), abs=1e-12)
    assert turn.apply(HEAD) @ u == pytest.approx(0.0, abs=1e-9)
    assert abs(tilt) <= np.pi / 2


def test_a_needle_along_the_patient_has_no_angle_in_the_slice():
    found = needle_planes(HEAD)
    assert np.isnan(found.in_plane)
    assert found.summary()["in_plane_deg"] is None
    assert "along the patient" in dict(found.rows())["in-plane angle"]


def test_check_answers_in_the_space_that_was_typed_and_from_the_nearest_marker(tmp_path):
    context = prepare(write_case(tmp_path, ('space = "LPS"', 'space = "RAS"')), arm=False)
    found = context.explain(np.radians(10), np.radians(90))
    summary = found.summary()
    np.testing.assert_allclose(np.multiply(summary["entry_mm"], [-1, -1, 1]), summary["entry_ct_mm"])
    markers = {"A": (0, 0, 80), "B": (50, 0, 75), "C": (0, 60, 70), "D": (-40, -30, 72)}
    lps = {name: np.multiply(point, [-1.0, -1.0, 1.0]) for name, point in markers.items()}
    entry = np.array(summary["entry_ct_mm"])
    nearest = min(lps, key=lambda name: np.linalg.norm(entry - lps[name]))
    assert summary["entry_from"]["of"] == f"marker {nearest}"
    text = found.text()
    assert "mm RAS" in text and f"of marker {nearest}" in text and "gantry tilt" in text
    np.testing.assert_allclose(walked(summary["entry_from"]["text"], lps[nearest]), entry, atol=0.5)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_the_slice_of_an_entry_is_counted_from_the_feet(up):
    """Whichever way the file's slices run; a point beyond them is in none; the laser lines by their signs."""
    T = np.diag([1.0, 1.0, 3.0 * up, 1.0])
    T[:3, 3] = [-50.0, -60.0, 100.0 if up > 0 else 100.0 + 3.0 * 19]
    grid = SimpleNamespace(shape=(100, 120, 20), T_ct_index=T)
    for z, number in ((100.0, 1), (101.0, 1), (157.0, 20), (160.0, 21)):
        facts = entry_facts(CASE, (), np.array([-29.0, 12.0, z]), HEAD, grid)
        assert (facts.scanned.slice, facts.scanned.slices) == (number, 20)
    rows = dict(facts.rows())
    assert rows["slice of the entry"] == "outside of the image"
    assert rows["laser lines"].startswith("29 mm to the right of the sagittal one, 12 mm behind the coronal one")


@pytest.mark.parametrize(("path", "length"), [(50.0, 120.0), (95.0, 150.0), (140.0, 200.0), (160.0, np.nan)])
def test_the_needle_to_take_is_the_shortest_that_reaches(path, length):
    """Shafts of 70, 100 and 150 mm; 160 mm in the body is reached by none."""
    found = entry_facts(CASE, (), np.array([0.0, 0.0, path]), HEAD)
    assert found.needle_mm == length or (np.isnan(length) and np.isnan(found.needle_mm))


CASE = SimpleNamespace(
    space=Space.LPS, target_ct=np.zeros(3), needle=Needle(200.0, 150.0, 1.2, None, 10.0, 30.0, (200.0, 120.0, 150.0))
)
