"""Where the patient truly lies: from a file of true positions, drawn from marker errors, or as believed."""

import numpy as np
import pytest
from bare_case import bare_case
from places import ROOT
from refusals import refused
from scipy.spatial.transform import Rotation

from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.settings import RobotSettings
from puncture_twin.planning.case.tables import MarkerSection, RehearsalSection
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.planning.registration.registration import leverage
from puncture_twin.twin.plant.truth import draw_truth, registration_error

MESHES = ROOT / "meshes"
MARKERS = np.array([[10.0, 20, 147], [110, 120, 147], [60, -10, 80], [90, -10, 20], [20, 150, 147]])
NAMES = ("A", "B", "C", "D", "E")
TARGET = np.array([50.0, 130, 63])


def pose(seed):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = rng.uniform(-500, 500, 3)
    return T


def write_points(path, names, points):
    rows = [f"{name},{x:.9f},{y:.9f},{z:.9f}" for name, (x, y, z) in zip(names, points, strict=True)]
    path.write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n")


def files_in(folder):
    files = InputFiles(folder)
    for path in sorted(folder.glob("*.csv")):
        files.add(path.stem, path.name, path.read_bytes())
    return files


def case(folder, *, markers=True, method="rigid", **rehearsal):
    """A case with the carton's markers; target M."""
    registration = None
    if markers:
        write_points(folder / "ct.csv", NAMES, MARKERS)
        write_points(folder / "base.csv", NAMES, apply(pose(0), MARKERS))
        use = ("A", "B", "C") if method == "triad" else None
        registration = MarkerSection(method=method, markers_ct="ct.csv", markers_base="base.csv", use=use)
    return bare_case(
        TARGET,
        path=folder / "case.toml",
        target_name="M",
        registration=registration,
        robot=RobotSettings("ur3", None, None if markers else pose(0)),
        rehearsal=RehearsalSection(**rehearsal),
        files=files_in(folder),
    )


def test_without_markers_truth_is_belief_and_says_so(tmp_path):
    """A stated mount has no error to draw; the joint offsets are drawn all the same."""
    truth = draw_truth(case(tmp_path, markers=False), pose(0))
    np.testing.assert_array_equal(truth.T_base_ct_true, pose(0))
    assert "belief" in truth.source
    assert np.all(truth.joint_offsets != 0)


def test_same_seed_same_truth_other_seed_another(tmp_path):
    one, again, other = (draw_truth(case(tmp_path, seed=seed), pose(0)) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.T_base_ct_true, again.T_base_ct_true)
    np.testing.assert_array_equal(one.joint_offsets, again.joint_offsets)
    assert not np.array_equal(one.T_base_ct_true, other.T_base_ct_true)
    assert (one.seed, other.seed) == (5, 6)
    overridden = draw_truth(case(tmp_path, seed=6), pose(0), seed=5)
    np.testing.assert_array_equal(overridden.T_base_ct_true, one.T_base_ct_true)
    R = one.T_base_ct_true[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0 and not one.T_base_ct_true.flags.writeable


def test_no_error_means_truth_is_belief(tmp_path):
    exact = case(tmp_path, fle_ct_mm=0.0, fle_touch_mm=0.0, joint_offset_deg=0.0)
    truth = draw_truth(exact, pose(0))
    np.testing.assert_allclose(truth.T_base_ct_true, pose(0), atol=1e-9)
    np.testing.assert_array_equal(truth.joint_offsets, np.zeros(6))


@pytest.mark.parametrize(("ct_mm", "touch_mm"), [(0.5, 0.1), (0.0, 0.4)])
def test_drawn_errors_are_those_that_fitzpatrick_expects(ct_mm, touch_mm):
    """Root mean square distance of truth and belief at the target = FLE times the markers' leverage, within 4 %.

    2000 draws leave 1.6 % (one standard deviation, three degrees of freedom at the least).
    """
    rng, T = np.random.default_rng(11), pose(3)
    squares = []
    for _ in range(2000):
        error = registration_error(MARKERS, T, fit_rigid, (ct_mm, touch_mm), rng)
        T_true = T @ np.linalg.inv(error)
        squares.append(np.sum((apply(T, TARGET) - apply(T_true, TARGET)) ** 2))
    fle = np.sqrt(3 * (ct_mm**2 + touch_mm**2))
    expected = fle * leverage(MARKERS, TARGET[None])[0]
    assert np.sqrt(np.mean(squares)) == pytest.approx(expected, rel=0.04)


def test_triad_cases_draw_triad_errors(tmp_path):
    """The error is that of the case's own method and markers: the same noise, another truth."""
    rigid, triad = (draw_truth(case(tmp_path, method=method), pose(0)) for method in ("rigid", "triad"))
    assert not np.allclose(rigid.T_base_ct_true, triad.T_base_ct_true, atol=1e-3)


def test_file_of_true_positions_is_found_again(tmp_path):
    """With markers that disagree by a few mm the target is still put on its own true place."""
    place = apply(pose(9), TARGET)
    for off_mm in (0.0, 2.0):
        markers = apply(pose(9), MARKERS) + np.random.default_rng(2).normal(0, off_mm, MARKERS.shape)
        write_points(tmp_path / "true.csv", (*NAMES, "M"), np.vstack([markers, place]))
        truth = draw_truth(case(tmp_path, truth_base="true.csv"), pose(0))
        np.testing.assert_allclose(apply(truth.T_base_ct_true, TARGET), place, atol=1e-6)
        assert np.allclose(truth.T_base_ct_true, pose(9), atol=1e-6) == (off_mm == 0) and "true.csv" in truth.source


@pytest.mark.parametrize(
    ("names", "rows", "said"),
    [
        (("A", "M"), (0, 5), "too_few_points"),
        (("P", "Q", "R"), (0, 1, 2), "too_few_points"),
        (("A", "B", "D"), (0, 0, 0), "points_collinear"),
    ],
)
def test_too_few_or_collinear_true_points_are_refused(tmp_path, names, rows, said):
    """A file that cannot fix a pose is an input error that names what it has."""
    every = apply(pose(9), np.vstack([MARKERS, TARGET]))[list(rows)] + np.arange(len(rows))[:, None] * [1.0, 2.0, 3.0]
    write_points(tmp_path / "true.csv", names, every)
    with refused(said):
        draw_truth(case(tmp_path, truth_base="true.csv"), pose(0))


@pytest.mark.parametrize(("lesion", "error_mm"), [("l", 2.99), ("m", 2.94), ("h", 2.99)])
def test_papers_first_placement_gives_the_papers_error(lesion, error_mm):
    """Belief from A-B-C, truth from what was touched in the box: the errors of Chen 2019, Table 3."""
    carton = load_case(MESHES / "carton" / f"case_{lesion}.toml")
    placement = load_placement(carton)
    truth = draw_truth(carton, placement.T_base_ct)
    error = apply(placement.T_base_ct, carton.target_ct) - apply(truth.T_base_ct_true, carton.target_ct)
    assert np.linalg.norm(error) == pytest.approx(error_mm, abs=0.01)
