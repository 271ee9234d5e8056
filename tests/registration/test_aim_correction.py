"""The aim corrected by what the residuals tell of the arm: against a plain fit of pose and arm, and what is refused."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from places import ROOT
from refusals import refused
from scipy.optimize import least_squares
from scipy.special import chdtri
from uncertainty_world import NO_ARM, declared, world

from puncture_twin.planning.arm.kinematics import error_jacobian
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, log_rotation, pose
from puncture_twin.planning.registration.fits import differenced_map, fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.placement import aim_at, aimed, aimed_fit, load_placement
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.uncertainty.pose_error import pose_error
from puncture_twin.twin.rehearsal.trials import draw_trials

NOMINAL = {"arm": "nominal", "tip_offset_mm": 1.0, "needle_direction_deg": 0.5, "joint_drift_deg": 0.0}
ABDOMEN = "abdomen/case.toml"


def changed_case(tmp_path, *lines, touch=None, errors=True):
    """The embedded abdomen with lines more in ``[registration]``."""
    folder = tmp_path / "abdomen"
    shutil.copytree(ROOT / "meshes" / "abdomen", folder)
    text = (folder / "case.toml").read_text("utf-8")
    text = text.replace('markers_base = "touch.csv"\n', "\n".join(['markers_base = "touch.csv"', *lines, ""]))
    if not errors:
        start, end = text.index("[errors]"), text.index("[robot]")
        text = text[:start] + text[end:]
    (folder / "case.toml").write_text(text, "utf-8")
    if touch is not None:
        (folder / "touch.csv").write_text(touch((folder / "touch.csv").read_text("utf-8")), "utf-8")
    return load_case(folder / "case.toml")


def noisy(w, rng):
    """The markers of a world, read and touched with errors that its declaration allows."""
    noise, there = w.puncture.noise, apply(w.puncture.T_base_ct, w.puncture.points_ct)
    whole = noise.covariance(w.puncture.T_base_ct[:3, :3]).whole
    off = rng.multivariate_normal(np.zeros(there.size), whole).reshape(-1, 3)
    return MarkerPairs(tuple(f"M{i}" for i in range(len(there))), w.puncture.points_ct, there + off)


def plain_fit(w, markers):
    """Shift and rotation at the target that a needle at the insertion is off by, by plain Gauss-Newton with a prior."""
    noise, T = w.puncture.noise, w.puncture.T_base_ct
    blocks = noise.blocks(T[:3, :3])
    roots = np.linalg.inv(np.linalg.cholesky(blocks))
    deviations = np.sqrt(noise.eta_variances)
    J = noise.arm_jacobian.reshape(len(markers), 3, -1)

    def moved(x):
        return pose(exp_rotation(x[3:6]) @ T[:3, :3], T[:3, 3] + x[:3])

    def residuals(x):
        eta = x[6:] * deviations
        z = markers.points_base - apply(moved(x), markers.points_ct) + J @ eta
        return np.concatenate([np.einsum("nab,nb->na", roots, z).ravel(), x[6:]])

    found = least_squares(residuals, np.zeros(6 + len(deviations)), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return moved(found.x), found.x[6:] * deviations


def test_pose_and_arm_are_those_of_a_plain_fit_of_both(rng):
    """Gauss-Newton over six and 28 unknowns, the arm's with their prior, commands the same pose."""
    w = world(ABDOMEN, "corrected", declared(**NOMINAL))
    markers, aim = noisy(w, rng), w.puncture.aim
    fitted = register(markers, method="joint", target_ct=aim.target_ct, noise=w.puncture.noise, accept_residuals=True)
    done = aimed(fitted, aim)
    T_plain, eta = plain_fit(w, markers)
    off = aim.arm_jacobian @ eta
    np.testing.assert_allclose(
        apply(done.T_base_ct, aim.target_ct), apply(T_plain, aim.target_ct) - off[:3], rtol=0, atol=2e-3
    )
    turn = log_rotation(done.T_base_ct[:3, :3] @ T_plain[:3, :3].T)
    np.testing.assert_allclose(turn, -off[3:], rtol=0, atol=1e-5)
    assert np.linalg.norm(off[:3]) > 0.3  # there was something to correct


def test_the_map_is_that_of_the_fit():
    """Central differences of the whole fit, its correction with it, give the linear map of the covariances."""
    w = world(ABDOMEN, "corrected", declared(**NOMINAL))
    noise, aim = w.puncture.noise, w.puncture.aim
    points, there = w.puncture.points_ct, apply(w.puncture.T_base_ct, w.puncture.points_ct)
    found = differenced_map(lambda ct, base: aimed_fit(ct, base, noise, fit_rigid(ct, base), aim), points, there)
    np.testing.assert_allclose(w.error.fit.fit_map, found, rtol=0, atol=1e-6)


@pytest.mark.parametrize("alike", [True, False])
def test_no_fit_of_the_markers_leaves_less(alike):
    """At its own insertion: neither least squares, nor weights, nor the joint fit without a corrected aim."""
    left = {}
    for method in ("rigid", "weighted", "joint", "corrected"):
        w = world(ABDOMEN, method, declared(**NOMINAL), touch_like_insertion=alike)
        left[method] = np.sqrt(np.trace(w.error.covariance(w.puncture.q_insertion[None])[0, :3, :3]))
    assert left["corrected"] < 0.9 * min(left[other] for other in ("rigid", "weighted", "joint"))


def test_without_an_arms_errors_it_is_the_weighted_fit():
    errors = declared(ct_in_plane_mm=0.3, ct_slice_mm=1.4, bed_axis=(1.0, 0.0, 0.0), **NO_ARM)
    one, other = (world("carton/case_m.toml", method, errors) for method in ("weighted", "corrected"))
    np.testing.assert_allclose(one.error.fit.fit_map, other.error.fit.fit_map, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.puncture.T_base_ct, other.puncture.T_base_ct, rtol=0, atol=1e-7)


def test_other_insertions_are_told_what_the_correction_leaves_there():
    """Rooms corrected for one insertion and driven along another err as the covariance of that other says."""
    w = world(ABDOMEN, "joint", declared(**NOMINAL))
    points, there = w.puncture.points_ct, apply(w.puncture.T_base_ct, w.puncture.points_ct)
    markers = MarkerPairs(tuple(f"M{i}" for i in range(len(points))), points, there)
    other = w.puncture.q_insertion + np.array([0.0, 0.1, -0.2, 0.3, 0.2, 1.0])
    aim = aim_at(w.error.model, w.error.tip_mm, w.puncture.target_ct, other)
    fitted = register(markers, method="joint", target_ct=aim.target_ct, noise=w.puncture.noise)
    error = replace(w.error, fit=aimed(fitted, aim).uncertainty)
    for aim_of_rooms, holds in (
        (aim, True),
        (None, False),
    ):  # rooms that are not corrected are told from those that are
        rooms = draw_trials(replace(w.puncture, aim=aim_of_rooms), w.errors, 8_000, np.random.default_rng(1))
        off, cov = rooms.tip_ct - rooms.target_ct, error.tip_covariance_ct(w.puncture.q_insertion[None])[0]
        ratio = np.sqrt(np.mean(np.sum(off**2, axis=1)) / np.trace(cov))
        inside = np.mean(np.einsum("na,ab,nb->n", off, np.linalg.inv(cov), off) <= chdtri(3, 0.05))
        assert (0.97 <= ratio <= 1.03 and 0.94 <= inside <= 0.96) == holds


def test_a_case_corrects_for_what_it_states(tmp_path):
    """The belief of the case is that of its key: another pose, and the covariance of that pose."""
    plain = load_case(ROOT / "meshes" / ABDOMEN)
    joints = "correct_joints_deg = [-147.21, 109.62, 134.40, -63.89, 57.14, -0.07]"
    case = changed_case(tmp_path, "correct = true", joints)
    one, other = (load_placement(each).registration for each in (plain, case))
    assert one.aim is None
    np.testing.assert_allclose(np.degrees(other.aim.q), [-147.21, 109.62, 134.40, -63.89, 57.14, -0.07])
    assert not np.allclose(one.T_base_ct, other.T_base_ct, rtol=0, atol=1e-3)
    q = other.aim.q[None]
    left = [np.trace(pose_error(each, fit).tip_covariance(q)[0]) for each, fit in ((plain, one), (case, other))]
    assert left[1] < left[0]
    J = error_jacobian(pose_error(case, other).model, q, case.needle.length_mm)
    np.testing.assert_array_equal(other.aim.arm_jacobian, J[0])


def without_joints(text):
    return "\n".join(",".join(line.split(",")[:4]) for line in text.splitlines()) + "\n"


@pytest.mark.parametrize(
    ("lines", "options", "code"),
    [
        (['method = "rigid"', "correct = true"], {}, "conflicting_keys"),
        (['method = "triad"', "correct = true"], {}, "conflicting_keys"),
        (["correct_joints_deg = [0, 0, 0, 0, 0, 0]"], {}, "keys_together"),
        (["correct = true", "correct_joints_deg = [0, 0, 0, 0, 0, 0]"], {}, "aim_beside_target"),
        (["correct = 1"], {}, "bad_value"),
        (["correct = true"], {"errors": False}, "missing_errors"),
        (["correct = true"], {"touch": without_joints}, "no_touch_joints"),
    ],
)
def test_what_contradicts_it_and_what_it_needs_is_refused(tmp_path, lines, options, code):
    with refused(code):
        load_placement(changed_case(tmp_path, *lines, **options))
