"""A scale, stretch or shear between the lists is named where there is one, and seldom where there is none."""

import numpy as np
import pytest
import scipy.stats

from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import KINDS, SIGNIFICANT, register
from puncture_twin.twin.experiment.chen2019 import TABLE_1, TABLE_4

TARGET = np.array(TABLE_1["M"], float)
MARKERS = np.array([TABLE_1[name] for name in "ABCDE"], float)
T_BASE_CT = pose(exp_rotation(np.array([0.4, -1.1, 2.0])), np.array([300.0, -200.0, 500.0]))


def registered(points_ct, points_base):
    """A registration of markers that are off by more than any test would take."""
    names = tuple("ABCDEFGH"[: len(points_ct)])
    return register(MarkerPairs(names, points_ct, points_base), method="rigid", target_ct=TARGET, accept_residuals=True)


def deformed(points, axes, amount):
    """Points moved as a deformation of the CT's frame about their middle moves them."""
    moved, center = points.copy(), points.mean(axis=0)
    if len(axes) == 2:
        first, second = ("xyz".index(axis) for axis in axes)
        moved[:, first] += amount * (points - center)[:, second]
    else:
        for axis in axes:
            moved[:, "xyz".index(axis)] += amount * (points - center)[:, "xyz".index(axis)]
    return moved


def test_the_paper_s_second_setup_is_out_of_square_in_y_against_z():
    """Its markers alone, no lesion: a shear of 1.84 degrees, by a search over k that shares no code with the check."""
    touched = np.array([TABLE_4[name] for name in "ABCDE"], float)
    found = registered(MARKERS, touched).distortion
    ks = np.linspace(0, 0.08, 801)
    sums = [_sse(deformed(MARKERS, "yz", k), touched) for k in ks]
    assert found.axes == "yz"
    assert np.degrees(np.arctan(found.amount)) == pytest.approx(1.84, abs=0.04)
    assert found.amount == pytest.approx(ks[np.argmin(sums)], rel=0.02)
    f = (_sse(MARKERS, touched) - min(sums)) / (min(sums) / 8)
    assert found.probability == pytest.approx(len(KINDS) * scipy.stats.f.sf(f, 1, 8), rel=0.3)
    assert found.brief().startswith("the CT's frame looks 1.8 degrees out of square, y against z")


def _sse(points_ct, points_base):
    return np.sum((apply(fit_rigid(points_ct, points_base), points_ct) - points_base) ** 2)


@pytest.mark.parametrize("axes", KINDS)
def test_a_deformation_is_named_by_its_kind(axes):
    """Its axes, its size, what it moves the markers by, what is left to the readings, and what it costs."""
    rng = np.random.default_rng(3)
    touched = apply(T_BASE_CT, deformed(MARKERS, axes, 0.03)) + rng.normal(0, 0.05, MARKERS.shape)
    found = registered(MARKERS, touched).distortion
    assert found.axes == axes
    assert found.significant
    assert found.finding().sentence in [flag.sentence for flag in registered(MARKERS, touched).flags]
    assert found.amount == pytest.approx(0.03, abs=0.004)
    assert found.moved_mm == pytest.approx(np.sqrt(_sse(deformed(MARKERS, axes, 0.03), MARKERS) / 5), rel=0.1)
    assert 0.02 < found.reading_mm < 0.1
    assert found.rms_without_mm < found.rms_mm


def test_a_list_1_6_percent_larger_is_named_in_9_of_10_and_never_as_something_else():
    """Six markers read with .3 mm a coordinate; the oracle of the size is the ratio of the two lists' spreads."""
    rng = np.random.default_rng(17)
    points = np.array(
        [[-110, -60, -70], [-60, -95, 60], [0, -105, -20], [55, -98, 75], [105, -62, -60], [20, -104, 30]]
    )
    said = []
    for _ in range(60):
        touched = apply(T_BASE_CT, points * 1.016) + rng.normal(0, 0.3, points.shape)
        found = registered(points, touched).distortion
        if found.significant:
            said.append(found.axes)
            ratio = np.linalg.norm(touched - touched.mean(axis=0)) / np.linalg.norm(points - points.mean(axis=0))
            assert found.axes != "xyz" or found.amount == pytest.approx(ratio - 1, abs=2e-4)
    assert len(said) >= 54
    assert said.count("xyz") >= 0.95 * len(said)


def test_the_probability_of_true_lists_follows_its_law():
    """Whatever the markers can show of the seven: the least p, sevenfold, is an upper bound."""
    rng = np.random.default_rng(5)
    for points in (MARKERS, MARKERS * [1, 1, 0] + [0, 0, 50]):
        draws = [apply(T_BASE_CT, points) + rng.normal(0, 0.4, points.shape) for _ in range(150)]
        found = [registered(points, touched).distortion for touched in draws]
        for level in (SIGNIFICANT, 0.1, 0.4):
            share = np.mean([one.probability < level for one in found])
            assert share <= level + 3.5 * np.sqrt(level * (1 - level) / len(found))
        assert np.mean([one.probability < 0.7 for one in found]) > 0.15


def test_lists_that_agree_to_rounding_are_not_called_deformed():
    found = registered(MARKERS, apply(T_BASE_CT, MARKERS * (1 + 1e-6))).distortion
    assert found.axes == "xyz"
    assert not found.significant


def test_flat_markers_cannot_show_what_leaves_their_plane():
    """Of the seven, those that move along the normal, or are a rotation there, have nothing to say."""
    flat = MARKERS * [1, 1, 0] + [0, 0, 50]
    touched = apply(T_BASE_CT, flat) + np.random.default_rng(2).normal(0, 0.3, flat.shape)
    found = registered(flat, touched).distortion
    assert "z" not in found.axes or found.axes == "xyz"
    assert registered(flat[:3], touched[:3]).distortion.axes in ("xyz", "x", "y", "xy")
