"""Permutations of marker names that fit as well: the search against all permutations, one by one."""

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration import marker_pairs as marker_ambiguity
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.marker_pairs import HARMLESS_MM, MarkerPairs, renamings

TARGET = np.array([10.0, -20.0, -90.0])
NAMES = tuple("ABCDEFGHIJKL")


def moved(points):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    T[:3, 3] = 300.0, -200.0, 100.0
    return apply(T, points)


def polygon(count, radius=60.0):
    """A regular polygon, in the plane z = 0."""
    angle = 2 * np.pi * np.arange(count) / count
    return radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])


def by_hand(points_ct, points_base):
    """Each order of the names with the FRE of its own rigid fit, and how far that moves markers or target at most."""
    found, given = {}, fit_rigid(points_ct, points_base)
    everything = np.vstack([TARGET, points_ct])
    for order in permutations(range(len(points_ct))):
        permuted = points_base[list(order)]
        T = fit_rigid(points_ct, permuted)
        fre = np.sqrt(np.mean(np.sum((apply(T, points_ct) - permuted) ** 2, axis=1)))
        found[order] = fre, np.linalg.norm(apply(T, everything) - apply(given, everything), axis=1).max()
    return found


def orders(found, count):
    result = set()
    for one in found:
        order = list(range(count))
        for name, touched in zip(one.names, one.touched_as, strict=True):
            order[NAMES.index(name)] = NAMES.index(touched)
        result.add(tuple(order))
    return result


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_all_permutations_that_fit_are_found(count):
    """Regular and irregular sets with noise: what the search finds is what 6 to 720 fits find that move something."""
    rng = np.random.default_rng(count)
    for spoil in (0.0, 2.0, 10.0, 40.0):
        points = polygon(count) + rng.normal(0, spoil, (count, 3))
        base = moved(points) + rng.normal(0, 0.3, points.shape)
        every = by_hand(points, base)
        for alike_mm in (0.5, 3.0, 12.0, 40.0):
            found = renamings(MarkerPairs(NAMES[:count], points, base), TARGET, alike_mm)
            fitting = {one for one, (fre, moves) in every.items() if fre <= alike_mm and moves > HARMLESS_MM}
            assert found.complete and orders(found.found, count) == fitting - {tuple(range(count))}


def test_a_square_has_its_seven_symmetries():
    """Four turns and four flips, less the names as given; the worst comes first and says where the target would be."""
    points = polygon(4)
    found = renamings(MarkerPairs(NAMES[:4], points, moved(points)), TARGET, 1.0).found
    assert len(found) == 7
    assert all(one.fre_mm < 1e-6 for one in found)
    assert [one.target_mm for one in found] == sorted((one.target_mm for one in found), reverse=True)
    assert found[0].target_mm > 150.0  # a flip puts the target to the other side of the square
    assert f"put the target {found[0].target_mm:.1f} mm away" in found[0].text()
    assert "rotated by 180 deg" in found[0].text()


def test_a_target_on_the_axis_does_not_hide_the_turn():
    """Three markers about the target: a third of a turn moves no target, and the patient all the same."""
    points = polygon(3)
    found = renamings(MarkerPairs(NAMES[:3], points, moved(points)), np.array([0.0, 0.0, -90.0]), 1.0).found
    third = [one for one in found if one.target_mm < 0.1]
    assert len(third) == 2
    assert all(np.degrees(one.turn) == pytest.approx(120.0, abs=0.1) for one in third)


def test_markers_that_all_but_coincide_may_be_swapped():
    """Two markers half a millimetre apart: either name gives the same registration."""
    points = np.vstack([polygon(3) * [1.0, 1.3, 1.0] + [5.0, 0.0, 0.0], [[65.0, 0.5, 0.0]]])
    points[:3] += [[0, 0, 0], [0, 20, 0], [0, 3, 30]]
    assert renamings(MarkerPairs(NAMES[:4], points, moved(points)), TARGET, 1.0).found == ()


def test_twelve_markers_on_a_circle_are_tested_completely():
    """Names beyond six: the distances leave 24 permutations of half a billion."""
    points = polygon(12)
    found = renamings(MarkerPairs(NAMES, points, moved(points)), TARGET, 1.0)
    assert found.complete
    assert len(found.found) == 23


def test_sets_too_alike_for_that_are_tested_for_swaps(monkeypatch):
    """Beyond the bound on memory swaps of two names are tested, and the result says that it is not complete."""
    monkeypatch.setattr(marker_ambiguity, "MAX_NUMBERS", 100)
    on_the_axis = [[0.0, y, 0.0] for y in (-70.0, -40.0, -20.0, 10.0, 50.0, 90.0)]
    points = np.array([[60.0, 0.0, 0.0], [-60.0, 0.0, 0.0], *on_the_axis])
    found = renamings(MarkerPairs(NAMES[:8], points, moved(points)), TARGET, 1.0)
    assert not found.complete
    assert [one.names for one in found.found] == [("A", "B")]  # a half turn about the axis on which the others lie
