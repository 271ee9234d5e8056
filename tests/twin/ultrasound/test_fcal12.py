"""Real tracked images of an N-wire phantom (PLUS, BSD-3): the published matrix and our own fit, by their distances."""

from itertools import product

import numpy as np
import places
import pytest
from plus_wires import WireFrames, Wires, fit_image, point_to_wire_mm, read_results, read_wires
from refusals import refused

DATA = places.DATA / "plus_uscal_fcal12"
DEVICE_SET = DATA / "PlusDeviceSet_fCal_Sim_SpatialCalibration_1.2.xml"
RESULTS = DATA / "FreehandCalibration3NWires.results.xml"
real = pytest.mark.skipif(not DATA.is_dir(), reason="the real wire calibration is not on this machine")


@pytest.fixture(scope="module")
def fcal():
    """Wires and frames."""
    wires = read_wires(DEVICE_SET)
    return wires, read_results(RESULTS, wires)


@real
def test_the_published_matrix_reaches_what_was_published(fcal):
    """188 and 94 frames of nine wires; mean point-to-wire distance .467 mm (calibration) and .724 mm (validation)."""
    wires, results = fcal
    assert results.calibration.points_px.shape == (188, 9, 2)
    assert results.validation.points_px.shape == (94, 9, 2)
    both = results.calibration, results.validation
    distances = [point_to_wire_mm(results.T_probe_image, frames, wires).mean() for frames in both]
    assert distances == pytest.approx([0.467, 0.724], abs=0.0006)


@real
def test_our_fit_of_the_same_unknowns_is_nearer(fcal):
    """Fitted on the calibration frames alone: at most .45 and .67 mm on calibration and validation, and the least.

    A step along any unknown, either way, is worse.
    """
    wires, results = fcal
    own = fit_image(results.calibration, wires)
    distances = point_to_wire_mm(own, results.calibration, wires)
    assert distances.mean() <= 0.45
    assert point_to_wire_mm(own, results.validation, wires).mean() <= 0.67
    published = np.linalg.norm(results.T_probe_image[:3, :2], axis=0)
    assert np.linalg.norm(own[:3, :2], axis=0) == pytest.approx(published, rel=0.02)
    for row, (column, size) in product(range(3), ((0, 1e-5), (1, 1e-5), (3, 1e-2), (0, -1e-5), (1, -1e-5), (3, -1e-2))):
        moved = own.copy()
        moved[row, column] += size
        assert (point_to_wire_mm(moved, results.calibration, wires) ** 2).sum() > (distances**2).sum()


@real
def test_a_swapped_wire_is_seen(fcal):
    """The figures depend on which point belongs to which wire: two exchanged ones make them far worse."""
    wires, results = fcal
    frames = results.validation
    swapped = WireFrames(frames.T_reference_probe, frames.points_px[:, [1, 0, *range(2, 9)]])
    assert point_to_wire_mm(results.T_probe_image, swapped, wires).mean() > 1.5


def test_exact_frames_give_the_matrix_back(rng):
    """Points computed on the wires: the fit is exact, and its distances are zero."""
    wires = Wires(("a", "b", "c"), rng.uniform(-20, 20, (3, 3)), np.linalg.qr(rng.normal(size=(3, 3)))[0])
    image = np.eye(4)
    image[:3, 0], image[:3, 1], image[:3, 3] = [0.08, 0.01, 0.0], [0.0, 0.075, 0.01], [10.0, -5.0, 3.0]
    T, points = random_views(rng, image, wires, 6)
    frames = WireFrames(T, points)
    assert point_to_wire_mm(image, frames, wires).max() < 1e-9
    assert np.abs(fit_image(frames, wires) - image)[:3, [0, 1, 3]].max() < 1e-9


def random_views(rng, image, wires, n):
    """Probe poses, and the pixels at which each wire meets the image plane."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    T[:, :3, :3] *= np.sign(np.linalg.det(T[:, :3, :3]))[:, None, None]
    T[:, :3, 3] = rng.uniform(-30, 30, (n, 3))
    points = np.empty((n, len(wires.names), 2))
    for i in range(n):
        for k, (a, d) in enumerate(zip(wires.points, wires.directions, strict=True)):
            axes = T[i, :3, :3] @ image[:3, :2]
            system = np.column_stack([axes, -d])
            points[i, k] = np.linalg.solve(system, a - T[i, :3, :3] @ image[:3, 3] - T[i, :3, 3])[:2]
    return T, points


def test_a_probe_that_stands_still_is_refused(rng):
    """The same view three times leaves unknowns free."""
    wires = Wires(("a", "b"), rng.uniform(-20, 20, (2, 3)), np.array([[0.0, 1, 0], [0.6, 0.8, 0]]))
    frames = WireFrames(np.tile(np.eye(4), (3, 1, 1)), np.tile(rng.uniform(0, 500, (1, 2, 2)), (3, 1, 1)))
    with refused("undetermined"):
        fit_image(frames, wires)
