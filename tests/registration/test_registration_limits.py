"""Each limit of a registration from both sides, on crosses of four markers whose fit is known without computing.

A cross has its markers at (±50, 0, h) and (0, ±50, -h). Moved outward along x and inward along y by as much, it is
fitted by the identity, and each marker misses by what it was moved.
"""

import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.fits import fit_affine, fit_triad
from puncture_twin.planning.registration.marker_pairs import MarkerPairs, match
from puncture_twin.planning.registration.registration import leverage, register

TARGET = np.array([10.0, 20.0, 30.0])
NAMES = ("a", "b", "c", "d")


def cross(arm=50.0, other=None, height=0.0):
    other = arm if other is None else other
    return np.array([[arm, 0, height], [-arm, 0, height], [0, other, -height], [0, -other, -height]])


def registered(points_ct, points_base, **settings):
    return register(MarkerPairs(NAMES, points_ct, points_base), method="rigid", target_ct=TARGET, **settings)


def test_what_the_residuals_say():
    """Two markers miss by 4 mm and two by 3: each, their mean, and their root mean square."""
    found = registered(cross(), cross(54.0, 47.0))
    np.testing.assert_allclose(found.T_base_ct, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(found.residual_mm, [4, 4, 3, 3], atol=1e-12)
    np.testing.assert_allclose(found.residuals[[0, 2]], [[-4, 0, 0], [0, 3, 0]], atol=1e-12)
    assert found.mean_error_mm == pytest.approx(3.5)
    assert found.fre_mm == pytest.approx(np.sqrt(12.5))
    assert found.method == "rigid" and found.markers.names == NAMES and len(found.markers) == 4
    assert not found.T_base_ct.flags.writeable


def test_the_expected_error_is_the_noise_times_the_leverage():
    found = registered(cross(height=7.0), cross(54.0, 47.0, 7.0))
    points = np.array([[10.0, 20, 30], [0, 0, 0], [200, 0, -90]])
    expected = found.fle_mm * leverage(cross(height=7.0), points)
    np.testing.assert_allclose(found.expected_tre_mm(points), expected, rtol=1e-12)
    low, high = found.residual_test.fle_interval_mm
    interval = found.expected_tre_interval_mm(points[2])
    np.testing.assert_allclose([interval.low, interval.high], np.array([low, high]) / found.fle_mm * expected[2])


@pytest.mark.parametrize("side", ["CT", "base"])
@pytest.mark.parametrize("size", [5.0, 100.0])
def test_a_hundredth_of_its_length_is_the_least_width_of_a_set(side, size):
    thin, wide = cross(size, 0.0098 * size), cross(size, 0.0102 * size)
    with refused("markers_collinear", side):
        registered(*((thin, wide) if side == "CT" else (wide, thin)))
    with refused("markers_collinear"):
        registered(wide, np.tile(wide[0], (4, 1)))
    assert registered(wide, wide).fre_mm == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("ct", "base", "wrong"), [(1, 4.9, 0), (1, 5.1, 1), (4.9, 1, 0), (5.1, 1, 1)])
def test_five_times_as_wide_is_a_slip_of_unit(ct, base, wrong):
    """Either way; below that it is residuals that must explain it (here of 4 mm)."""
    if wrong:
        with refused("wrong_unit"):
            registered(cross(ct), cross(base))
    else:
        assert registered(cross(ct), cross(base)).fre_mm == pytest.approx(3.9)


@pytest.mark.parametrize(("size", "wrong"), [(0.05, 1), (2.49, 1), (2.51, 0)])
def test_markers_that_span_less_than_5_mm_are_in_another_unit(size, wrong):
    """Both lists in metres fit each other, with an exit code of 0 and a patient of half a millimetre."""
    if wrong:
        with refused("wrong_unit", "a, b, c, d", f"{2 * size:.2g}"):
            registered(cross(size), cross(size))
    else:
        assert registered(cross(size), cross(size)).fre_mm == pytest.approx(0, abs=1e-9)


def test_a_marker_that_misses_by_more_than_15_mm_is_named():
    """At 14.9 mm the case may accept it, at 15.1 mm nobody; the worst of all is named."""
    assert registered(cross(), cross(50 + 14.0, 50 - 14.9), accept_residuals=True).residual_mm.max() < 15
    with refused("marker_misses", "15.1"):
        registered(cross(), cross(50 + 14.0, 50 - 15.1), accept_residuals=True)


@pytest.mark.parametrize(("moved", "proper", "wrong"), [(0, 0.8, 0), (0, 1.2, 1), (5, 10.7, 0), (5, 11.3, 1)])
def test_a_mirrored_fit_that_is_twice_as_good_and_a_millimetre_more_is_a_mirrored_side(moved, proper, wrong):
    """Mirrored at z = 0 the heights miss by 2 h each, and beside them all markers by as much as they were moved."""
    height = 0.5 * np.sqrt(proper**2 - moved**2)
    ct, base = cross(height=height), cross(50.0 + moved, 50.0 - moved, -height)
    if wrong:
        with refused("markers_mirrored", moved, "00", f"{proper:.2f}"):
            registered(ct, base, accept_residuals=True)
    else:
        assert registered(ct, base, accept_residuals=True).fre_mm == pytest.approx(proper)


def test_markers_that_are_not_finite_are_named_and_no_others():
    ct, base = cross(), cross()
    ct[1, 2], base[3, 0] = np.inf, np.nan
    with refused("not_finite"):
        registered(ct, base)


def test_three_markers_are_enough_and_two_are_not():
    points = np.array([[0.0, 0, 0], [80, 0, 0], [10, 60, 0]])
    for method in ("triad", "rigid"):
        found = register(MarkerPairs(NAMES[:3], points, points), method=method, target_ct=TARGET)
        np.testing.assert_allclose(found.T_base_ct, np.eye(4), atol=1e-12)
        assert found.method == method
        with refused("too_few_markers"):
            register(MarkerPairs(NAMES[:2], points[:2], points[:2]), method=method, target_ct=TARGET)


def test_a_triad_keeps_the_first_side_and_the_plane_and_spreads_the_rest(rng):
    """The first edge's direction and the triangle's plane are met exactly, and the residuals sum to nothing."""
    ct = np.array([[0.0, 0, 0], [80, 10, 5], [10, 60, -20]])
    base = ct + [500.0, -300, 20] + rng.normal(0, 2.0, (3, 3))
    T = fit_triad(ct, base)
    fitted = apply(T, ct)
    np.testing.assert_allclose(np.sum(fitted - base, axis=0), 0, atol=1e-9)
    for edges in (fitted, base):
        edges -= edges.mean(axis=0)
    first, wanted = fitted[1] - fitted[0], base[1] - base[0]
    assert first @ wanted == pytest.approx(np.linalg.norm(first) * np.linalg.norm(wanted), rel=1e-12)
    assert np.cross(wanted, base[2] - base[0]) @ first == pytest.approx(0, abs=1e-6)
    assert np.cross(wanted, base[2] - base[0]) @ (fitted[2] - fitted[0]) == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_an_affine_fit_of_three_markers_is_the_smallest():
    """Not unique: all three are met, and no other solution has a smaller norm; its last row is that of a motion."""
    ct = np.array([[10.0, 0, 5], [0, 20, 5], [30, 0, -5]])
    T = fit_affine(ct, 2.0 * ct)
    np.testing.assert_allclose(apply(T, ct), 2.0 * ct, atol=1e-9)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    free = np.linalg.svd(np.column_stack([ct, np.ones(3)]))[2][3]
    np.testing.assert_allclose(T[:3] @ free, 0, atol=1e-12)


def named(names):
    return NamedPoints(tuple(names), np.array([[ord(n), 0.0, 0] for n in names]), Space.LPS)


def test_names_pair_whatever_their_order():
    """Without a choice both sides must have the same names; the CT's order is kept."""
    found = match(named("cab"), named("abc"), use=None)
    assert found.names == ("c", "a", "b")
    np.testing.assert_array_equal(found.points_ct, found.points_base)
    chosen = match(named("cabx"), named("yabc"), use=("b", "c"))
    np.testing.assert_array_equal(chosen.points_base[:, 0], [ord("b"), ord("c")])


@pytest.mark.parametrize(
    ("ct", "base", "use", "says"),
    [
        ("abcd", "ab", None, "markers_missing"),
        ("ab", "abdc", None, "markers_missing"),
        ("ab", "abc", ("a", "z", "c"), "markers_missing"),
        ("abc", "ab", ("a", "c"), "markers_missing"),
        ("abc", "abc", ("a", "a", "b"), "duplicate_name"),
    ],
)
def test_all_names_that_a_side_lacks_are_listed(ct, base, use, says):
    with refused(says):
        match(named(ct), named(base), use=use)
