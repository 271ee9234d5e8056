"""Registration: laws, the literature's formulas, and each refusal by name."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from scipy.spatial.transform import Rotation

from benchmarks.one_insertion import T, held, markers_of
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import singularity
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.geometry.rigid import apply, frame_about, pose
from puncture_twin.planning.registration.fits import fit_affine, fit_rigid, fit_triad
from puncture_twin.planning.registration.marker_noise import touching_configuration
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import conditioning, leverage, register
from puncture_twin.planning.uncertainty.hit import hit_in_ball, radius_for_chance
from puncture_twin.twin.experiment.chen2019 import TABLE_1, TABLE_4

TARGET = np.array([50.0, 130.0, 63.0])
MARKERS = np.array([TABLE_1[name] for name in "ABCE"], dtype=float)


def rigid(seed):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-2000, 2000, 3)
    return T


def pairs(points_ct, points_base, names=None):
    return MarkerPairs(tuple(names or (f"m{i}" for i in range(len(points_ct)))), points_ct, points_base)


@given(st.integers(0, 2**32 - 1), st.integers(3, 8))
@settings(max_examples=60)
def test_rigid_fit_recovers_any_motion(seed, count):
    points = np.random.default_rng(seed).uniform(-150, 150, (count, 3))
    T = rigid(seed)
    np.testing.assert_allclose(fit_rigid(points, apply(T, points)), T, atol=1e-9)
    np.testing.assert_allclose(fit_triad(points[:3], apply(T, points[:3])), T, atol=1e-8)


def test_rigid_agrees_with_scipy():
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


def test_small_residuals_do_not_mean_a_small_error():
    """A-B-E has FRE 0.20 mm and misses M by 2.47 mm: FRE is not the accuracy."""
    ct = np.array([TABLE_1[name] for name in "ABE"], dtype=float)
    base = np.array([TABLE_4[name] for name in "ABE"])
    found = register(pairs(ct, base), method="rigid", target_ct=TARGET)
    assert found.fre_mm == pytest.approx(0.20, abs=0.01)
    assert np.linalg.norm(apply(found.T_base_ct, TARGET) - TABLE_4["M"]) > 2.4


@pytest.mark.parametrize(
    ("method", "code"), [("affine", "method_bends"), ("triad", "wrong_count"), ("weighted", "method_without_errors")]
)
def test_no_affine_fit_no_triad_of_four_and_no_weights_without_a_declaration(method, code):
    with refused(code):
        register(pairs(MARKERS, MARKERS), method=method, target_ct=TARGET)


def test_noise_does_not_look_mirrored():
    """Nearly flat, noisy marker sets are not mistaken for mirrored ones."""
    rng = np.random.default_rng(4)
    for _ in range(60):
        flat = MARKERS * [1, 1, 0.01]
        register(pairs(flat, flat + rng.normal(0, 1.5, flat.shape)), method="rigid", target_ct=TARGET)


UR3 = ur_model("ur3")
NEEDLE_MM = 200.0
DOWN = np.array([0.0, 0.0, -1.0])


def points(count, seed):
    rng = np.random.default_rng(seed)
    side, away = rng.uniform(-1.0, 1.0, count), rng.uniform(200.0, 380.0, count)
    return np.column_stack([away * np.cos(side), away * np.sin(side), rng.uniform(-50.0, 100.0, count)])


def test_rounding_does_not_choose_between_mirrored_branches():
    """A point moved by less than any machine's rounding is touched in the same configuration."""
    rng = np.random.default_rng(1)
    for point in points(40, seed=0):
        q = touching_configuration(UR3, NEEDLE_MM, point, DOWN)
        for moved in point + rng.normal(scale=1e-12, size=(10, 3)):
            assert np.allclose(touching_configuration(UR3, NEEDLE_MM, moved, DOWN), q, atol=1e-9)


def test_no_other_configuration_of_the_least_tilt_is_farther_from_singular():
    """Against every branch of the poses that are tried; equals are there, of which the first is taken."""
    equals = 0
    for point in points(20, seed=2):
        q = touching_configuration(UR3, NEEDLE_MM, point, DOWN)
        every = inverse(UR3, pose(frame_about(DOWN), point - NEEDLE_MM * DOWN))[0]
        every = every[UR3.within_limits(every)]
        if not len(every) or singularity(UR3, every).least().max() < 0.05:
            continue
        least = singularity(UR3, every).least()
        assert singularity(UR3, q).least() >= least.max() - 1e-9
        equals += np.sum(least > least.max() - 1e-9) > 1
    assert equals > 5


@pytest.mark.parametrize("markers", [3, 4, 6, 8])
def test_it_holds_what_it_says_whether_the_noise_is_stated_or_found(markers):
    """5,000 draws of markers and target; the rms, which has no reading of the target, holds a sixth of them at most."""
    found = held(markers, 5000, np.random.default_rng(markers))
    assert found.stated == pytest.approx(0.95, abs=0.012)
    assert found.found == pytest.approx(0.95, abs=0.012)
    assert found.rms < 0.2


@pytest.mark.parametrize("freedom", [None, 3, 12])
def test_the_radius_is_the_chance_the_other_way_round(freedom):
    cov = np.diag([4.0, 0.3, 0.01])
    for chance in (0.5, 0.95):
        assert hit_in_ball(cov[None], radius_for_chance(cov, chance, freedom), freedom)[0] == pytest.approx(
            chance, abs=1e-3
        )
    assert radius_for_chance(np.zeros((3, 3)), 0.95, freedom) == 0.0


def test_without_declared_errors_it_is_fitzpatricks_formula():
    """The trace of the covariance, at the markers' middle and far away."""
    points = markers_of(5)
    pairs = MarkerPairs(tuple("ABCDE"), points, apply(T, points) + 0.2 * np.random.default_rng(2).normal(size=(5, 3)))
    found = register(pairs, method="rigid", target_ct=np.zeros(3), fle_mm=1.0)
    places = np.array([[0.0, 0.0, 40.0], [200.0, 100.0, -300.0]])
    np.testing.assert_allclose(found.expected_tre_mm(places), leverage(points, places), rtol=0.01)
    assert found.freedom is None
