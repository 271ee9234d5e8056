"""From the image to the calibration frame: the weighted fit and the error that it expects of itself."""

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid, fit_triad
from puncture_twin.planning.registration.residuals import leverage
from puncture_twin.twin.guidance.stereo.servo_law import SeenMarkers, map_head

NAMES = ("M1", "M2", "M3", "M4", "M5")
MARKERS = np.array([[-40.0, -80, 26], [40, -80, 26], [-76, 5, 26], [76, 5, 26], [0, -101, -12]])
TARGETS = np.array([[30.0, 0, 10], [-20, 30, -5]])
T_TRUE = np.eye(4)
T_TRUE[:3, :3] = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
T_TRUE[:3, 3] = [12.0, -40.0, 900.0]


def seen(covariances, rng):
    errors = np.array([rng.multivariate_normal(np.zeros(3), cov) for cov in covariances])
    return SeenMarkers(apply(T_TRUE, MARKERS) + errors, np.asarray(covariances))


def test_equal_round_errors_give_the_plain_fit():
    """Then it is the rigid least squares of the planner, and Fitzpatrick's expected error."""
    rng = np.random.default_rng(1)
    markers = seen(np.tile(0.04 * np.eye(3), (5, 1, 1)), rng)
    found = map_head(NAMES, markers, MARKERS, 0.0, TARGETS)
    assert found.T_c_m == pytest.approx(fit_rigid(MARKERS, markers.points_c), abs=1e-8)
    expected = np.sqrt(3 * 0.04) * leverage(MARKERS, TARGETS)
    assert found.expected_tre_mm(TARGETS) == pytest.approx(expected, rel=0.01)
    assert found.fre_mm == pytest.approx(np.sqrt(np.mean(np.sum(found.residuals**2, axis=1))))


def test_expected_error_is_the_error_that_comes():
    """Long errors along the view, one bad marker, 500 draws: the rms is the expected one, below the plain fit's."""
    rng = np.random.default_rng(2)
    covariances = np.tile(np.diag([0.01, 0.01, 0.6]), (5, 1, 1))
    covariances[3] *= 9.0
    ours, plain = [], []
    for _ in range(500):
        markers = seen(covariances, rng)
        read = MARKERS + rng.normal(0.0, 0.1, MARKERS.shape)
        found = map_head(NAMES, markers, read, 0.1, TARGETS)
        ours.append(found.to_c(TARGETS) - apply(T_TRUE, TARGETS))
        plain.append(apply(fit_rigid(read, markers.points_c), TARGETS) - apply(T_TRUE, TARGETS))
    rms = np.sqrt(np.mean(np.sum(np.square(ours), axis=2), axis=0))
    assert rms == pytest.approx(found.expected_tre_mm(TARGETS), rel=0.08)
    assert np.all(rms < 0.95 * np.sqrt(np.mean(np.sum(np.square(plain), axis=2), axis=0)))


def test_covariance_at_a_target_holds_the_directions_too():
    rng = np.random.default_rng(3)
    covariances = np.tile(np.diag([0.01, 0.04, 0.3]), (5, 1, 1))
    squared = []
    for _ in range(300):
        found = map_head(NAMES, seen(covariances, rng), MARKERS, 0.0, TARGETS)
        miss = found.to_c(TARGETS) - apply(T_TRUE, TARGETS)
        squared.append(np.einsum("ni,nij,nj->n", miss, np.linalg.inv(found.covariance_at(TARGETS)), miss))
    assert np.mean(squared) == pytest.approx(3.0, rel=0.12)


def test_a_target_read_badly_errs_by_that_too():
    found = map_head(NAMES, seen(np.tile(1e-4 * np.eye(3), (5, 1, 1)), np.random.default_rng(4)), MARKERS, 0.3, TARGETS)
    alone, with_own = found.expected_tre_mm(TARGETS), found.expected_tre_mm(TARGETS, 0.2)
    assert with_own**2 - alone**2 == pytest.approx(3 * 0.2**2)


@pytest.mark.parametrize(
    ("points", "what"),
    [(MARKERS[:2], "too_few_markers"), (MARKERS * [1, 1, -1], "markers_mirrored"), (MARKERS / 10, "wrong_unit")],
)
def test_bad_marker_sets_are_refused_by_name(points, what):
    markers = SeenMarkers(points, np.tile(np.eye(3), (len(points), 1, 1)))
    with refused(what):
        map_head(NAMES[: len(points)], markers, MARKERS[: len(points)], 0.1, TARGETS)


def test_three_markers_without_error_are_mapped_exactly():
    three = apply(T_TRUE, MARKERS[:3])
    found = map_head(NAMES[:3], SeenMarkers(three, np.tile(0.01 * np.eye(3), (3, 1, 1))), MARKERS[:3], 0.1, TARGETS)
    assert found.T_c_m == pytest.approx(fit_triad(MARKERS[:3], three), abs=1e-8)
