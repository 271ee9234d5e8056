"""Registration: laws, the literature's formulas, and each refusal by name."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from scipy.spatial.transform import Rotation

from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.fits import fit_affine, fit_rigid, fit_triad
from puncture_twin.planning.registration.marker_pairs import MarkerPairs, match
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.registration.residuals import conditioning, leverage
from puncture_twin.twin.experiment.chen2019 import TABLE_1, TABLE_2, TABLE_4

TARGET = np.array([50.0, 130.0, 63.0])
MARKERS = np.array([TABLE_1[name] for name in "ABCE"], dtype=float)


def rigid(seed):
    """A random rigid motion with metres of translation."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-2000, 2000, 3)
    return T


def pairs(points_ct, points_base, names=None):
    """Matched markers with made-up names."""
    return MarkerPairs(tuple(names or (f"m{i}" for i in range(len(points_ct)))), points_ct, points_base)


def named(names, points):
    return NamedPoints(tuple(names), np.asarray(points, float), Space.LPS)


@given(st.integers(0, 2**32 - 1), st.integers(3, 8))
@settings(max_examples=60)
def test_rigid_fit_recovers_any_motion(seed, count):
    """Exact markers give back the motion to 1e-9."""
    points = np.random.default_rng(seed).uniform(-150, 150, (count, 3))
    T = rigid(seed)
    np.testing.assert_allclose(fit_rigid(points, apply(T, points)), T, atol=1e-9)
    np.testing.assert_allclose(fit_triad(points[:3], apply(T, points[:3])), T, atol=1e-8)


def test_rigid_fit_is_the_least_squares():
    """No small turn or shift of the fit has smaller residuals: the gradient vanishes and the fit is a minimum."""
    rng = np.random.default_rng(3)
    base = apply(rigid(5), MARKERS) + rng.normal(0, 1, MARKERS.shape)
    T = fit_rigid(MARKERS, base)
    best = np.sum((apply(T, MARKERS) - base) ** 2)
    for _ in range(200):
        nudged = T.copy()
        nudged[:3, :3] = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).as_matrix() @ T[:3, :3]
        nudged[:3, 3] += rng.normal(0, 0.1, 3)
        assert np.sum((apply(nudged, MARKERS) - base) ** 2) > best


def test_rigid_agrees_with_scipy():
    """A second implementation (Kabsch, scipy) finds the same rotation under noise."""
    rng = np.random.default_rng(8)
    base = apply(rigid(9), MARKERS) + rng.normal(0, 2, MARKERS.shape)
    R = Rotation.align_vectors(base - base.mean(axis=0), MARKERS - MARKERS.mean(axis=0))[0].as_matrix()
    np.testing.assert_allclose(fit_rigid(MARKERS, base)[:3, :3], R, atol=1e-9)


def test_affine_recovers_a_shear():
    """The 12-parameter fit follows what a rigid one cannot."""
    shear = np.eye(4)
    shear[0, 1] = 0.3
    np.testing.assert_allclose(fit_affine(MARKERS, apply(shear, MARKERS)), shear, atol=1e-9)


def test_expected_tre_agrees_with_monte_carlo():
    """Fitzpatrick's formula is within 3 % of 4,000 simulated registrations (spec: within 2 %, plus sampling)."""
    rng = np.random.default_rng(1)
    fle = 1.0
    errors = []
    for _ in range(4000):
        noisy = MARKERS + rng.normal(0, fle / np.sqrt(3), MARKERS.shape)
        errors.append(np.sum((apply(fit_rigid(MARKERS, noisy), TARGET) - TARGET) ** 2))
    simulated = np.sqrt(np.mean(errors))
    assert leverage(MARKERS, TARGET[None])[0] * fle == pytest.approx(simulated, rel=0.03)


def test_estimated_fle_is_unbiased_in_the_square():
    """FLE from FRE, averaged over many registrations, is the FLE that was put in."""
    rng = np.random.default_rng(2)
    squares = []
    for _ in range(500):
        noisy = MARKERS + rng.normal(0, 1 / np.sqrt(3), MARKERS.shape)
        squares.append(register(pairs(MARKERS, noisy), method="rigid", target_ct=TARGET).fle_mm ** 2)
    assert np.mean(squares) == pytest.approx(1.0, rel=0.08)


@pytest.mark.parametrize(("names", "flags"), [("ABC", 0), ("ABE", 0), ("ACD", 3), ("ABCE", 0), ("ABCDE", 0)])
def test_the_three_flags_trip_on_acd_alone(names, flags):
    """Of the paper's marker sets only A-C-D is weak, and by all three measures."""
    markers = np.array([TABLE_1[name] for name in names], dtype=float)
    found = conditioning(markers, TARGET)
    assert len(found.flags) == flags
    if flags:
        assert found.spread_ratio == pytest.approx(0.11, abs=0.005)
        assert found.altitude_mm == pytest.approx(15, abs=0.5)
        assert found.leverage == pytest.approx(6.4, abs=0.05)


def test_rigid_fit_beats_the_papers_affine():
    """The rigid fit of A-B-C-E errs by 2.24 mm at M, the affine one by 3.55 (spec section 1)."""
    base = np.array([TABLE_4[name] for name in "ABCE"])
    error = np.linalg.norm(apply(fit_rigid(MARKERS, base), TARGET) - TABLE_4["M"])
    assert error == pytest.approx(2.24, abs=0.005)


def test_small_residuals_do_not_mean_a_small_error():
    """A-B-E has FRE 0.20 mm and misses M by 2.47 mm: FRE is not the accuracy."""
    ct = np.array([TABLE_1[name] for name in "ABE"], dtype=float)
    base = np.array([TABLE_4[name] for name in "ABE"])
    found = register(pairs(ct, base), method="rigid", target_ct=TARGET)
    assert found.fre_mm == pytest.approx(0.20, abs=0.01)
    assert np.linalg.norm(apply(found.T_base_ct, TARGET) - TABLE_4["M"]) > 2.4


def test_match_by_name_takes_the_order_of_use():
    """Markers pair by name whatever the order of the files; ``use`` chooses and orders."""
    left = named(["b", "a", "c", "x"], np.arange(12).reshape(4, 3))
    right = named(["c", "b", "a"], 10 * np.arange(9).reshape(3, 3))
    found = match(left, right, use=("a", "b", "c"))
    assert found.names == ("a", "b", "c")
    np.testing.assert_array_equal(found.points_ct, [[3, 4, 5], [0, 1, 2], [6, 7, 8]])
    np.testing.assert_array_equal(found.points_base, [[60, 70, 80], [30, 40, 50], [0, 10, 20]])


@pytest.mark.parametrize(
    ("ct", "base", "use", "message"),
    [
        ("abcd", "abc", None, "markers_missing"),
        ("abc", "abce", None, "markers_missing"),
        ("abc", "abc", ("a", "b", "z"), "markers_missing"),
        ("abc", "abc", ("a", "b", "b"), "duplicate_name"),
    ],
)
def test_unmatched_names_are_refused_by_name(ct, base, use, message):
    """A name that one side lacks is an error that says which and where."""
    points = np.random.default_rng(0).uniform(0, 100, (4, 3))
    with refused(message):
        match(named(ct, points[: len(ct)]), named(base, points[: len(base)]), use=use)


def _swapped(points):
    return points[[1, 0, 2, 3]]


def _with_nan(points):
    spoiled = points.copy()
    spoiled[2, 1] = np.nan
    return spoiled


@pytest.mark.parametrize(
    ("ct", "base", "message"),
    [
        (MARKERS[:2], MARKERS[:2], "too_few_markers"),
        (np.outer([0, 1, 2.5, 4], [30.0, 40, 50]), MARKERS, "markers_collinear"),
        (MARKERS, np.outer([0, 1, 2.5, 4], [30.0, 40, 50]), "markers_collinear"),
        (MARKERS, np.tile(MARKERS[0], (4, 1)), "markers_collinear"),
        (MARKERS, MARKERS * [-1, 1, 1], "markers_mirrored"),
        (MARKERS, MARKERS / 1000, "wrong_unit"),
        (MARKERS * 10, MARKERS, "wrong_unit"),
        (MARKERS, _swapped(MARKERS), "marker_misses"),
        (_with_nan(MARKERS), MARKERS, "not_finite m2"),
    ],
)
def test_markers_that_cannot_be_trusted_are_refused_by_name(ct, base, message):
    """Too few, collinear, mirrored, slipped, swapped, NaN: each has its own words."""
    with refused(*message.split()):
        register(pairs(ct, base), method="rigid", target_ct=TARGET)


def test_affine_is_refused_for_planning():
    with refused("method_bends"):
        register(pairs(MARKERS, MARKERS), method="affine", target_ct=TARGET)


def test_triad_takes_three():
    with refused("wrong_count"):
        register(pairs(MARKERS, MARKERS), method="triad", target_ct=TARGET)


def test_noise_does_not_look_mirrored():
    """Nearly flat, noisy marker sets are not mistaken for mirrored ones."""
    rng = np.random.default_rng(4)
    for _ in range(200):
        flat = MARKERS * [1, 1, 0.01]
        register(pairs(flat, flat + rng.normal(0, 1.5, flat.shape)), method="rigid", target_ct=TARGET)


def test_setup_1_is_what_the_paper_had():
    """The paper's A-B-C of setup 1 registers without a flag, with 1.43 mm mean error (Eq. 16)."""
    ct = np.array([TABLE_1[name] for name in "ABC"], dtype=float)
    base = np.array([TABLE_2[name] for name in "ABC"])
    found = register(pairs(ct, base), method="triad", target_ct=TARGET)
    assert found.conditioning.flags == ()
    assert found.mean_error_mm == pytest.approx(1.43, abs=0.005)
