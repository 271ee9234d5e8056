"""A shear of the CT's frame is named where there is one, and seldom where there is none."""

import numpy as np
import pytest

from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.planning.geometry.rotations import exp_rotation
from puncture_twin.planning.registration.checks.squareness import PLANES, check_squareness
from puncture_twin.planning.registration.fits.least_squares import fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register
from puncture_twin.twin.experiment.chen2019_tables import TABLE_1, TABLE_4

TARGET = np.array(TABLE_1["M"], float)
MARKERS = np.array([TABLE_1[name] for name in "ABCDE"], float)
T_BASE_CT = pose(exp_rotation(np.array([0.4, -1.1, 2.0])), np.array([300.0, -200.0, 500.0]))


def registered(points_ct, points_base):
    """A registration of markers that are off by more than any test would take."""
    names = tuple("ABCDEFGH"[: len(points_ct)])
    return register(MarkerPairs(names, points_ct, points_base), method="rigid", target_ct=TARGET, accept_residuals=True)


def sheared(points, plane, k):
    """Points moved by k along the plane's first axis per mm along its second."""
    moved = points.copy()
    moved[:, plane[0]] += k * (points[:, plane[1]] - points[:, plane[1]].mean())
    return moved


def test_the_paper_s_second_setup_is_out_of_square_in_y_against_z():
    """Its markers alone, no lesion: a shear of 1.84 degrees, by a search over k that shares no code with the check."""
    touched = np.array([TABLE_4[name] for name in "ABCDE"], float)
    found = check_squareness(registered(MARKERS, touched), TARGET)
    ks = np.linspace(0, 0.08, 801)
    sums = [_sse(sheared(MARKERS, (1, 2), k), touched) for k in ks]
    assert found.axes == ("y", "z")
    assert found.doubted
    assert np.degrees(found.angle) == pytest.approx(1.84, abs=0.04)
    assert found.skew == pytest.approx(ks[np.argmin(sums)], rel=0.02)
    assert found.f == pytest.approx((_sse(MARKERS, touched) - min(sums)) / (min(sums) / 8), rel=0.06)
    assert "1.8 degrees out of square, y against z" in found.text()


def _sse(points_ct, points_base):
    return np.sum((apply(fit_rigid(points_ct, points_base), points_ct) - points_base) ** 2)


@pytest.mark.parametrize("plane", PLANES)
def test_a_shear_is_found_in_its_plane(plane):
    """Its axes, its size, and what it costs at the target."""
    rng = np.random.default_rng(3)
    touched = apply(T_BASE_CT, sheared(MARKERS, plane, 0.03)) + rng.normal(0, 0.05, MARKERS.shape)
    found = check_squareness(registered(MARKERS, touched), TARGET)
    assert found.axes == tuple("xyz"[axis] for axis in plane)
    assert found.skew == pytest.approx(0.03, abs=0.004)
    assert found.rms_square_mm < found.rms_mm


def test_the_probability_of_a_square_frame_follows_its_law():
    """Flat markers show one plane only: its F follows F(1, 3 N - 7), and its probability counts three times."""
    rng = np.random.default_rng(5)
    flat = MARKERS * [1, 1, 0] + [0, 0, 50]
    draws = [apply(T_BASE_CT, flat) + rng.normal(0, 0.4, flat.shape) for _ in range(150)]
    found = np.array([check_squareness(registered(flat, touched), TARGET).probability for touched in draws])
    for below in (0.15, 0.5):
        deviation = np.sqrt(below / 3 * (1 - below / 3) / len(found))
        assert np.mean(found < below) == pytest.approx(below / 3, abs=3.5 * deviation)


def test_a_square_frame_is_seldom_called_askew():
    """Three planes are looked at: the probability of the best of them is an upper bound."""
    rng = np.random.default_rng(11)
    draws = [apply(T_BASE_CT, MARKERS) + rng.normal(0, 0.4, MARKERS.shape) for _ in range(150)]
    found = [check_squareness(registered(MARKERS, touched), TARGET) for touched in draws]
    assert np.mean([one.probability < 0.1 for one in found]) <= 0.1 + 3.5 * np.sqrt(0.1 * 0.9 / len(found))


def test_flat_markers_cannot_show_a_shear_that_leaves_their_plane():
    """Two of the three planes have nothing to say."""
    flat = MARKERS * [1, 1, 0] + [0, 0, 50]
    touched = apply(T_BASE_CT, flat) + np.random.default_rng(2).normal(0, 0.3, flat.shape)
    found = check_squareness(registered(flat, touched), TARGET)
    assert found.axes == ("x", "y")
