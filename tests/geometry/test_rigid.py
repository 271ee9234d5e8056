"""The laws of rigid motions: closure, inverse, exponential and logarithm, Jacobian, and frames that are frames."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from puncture_twin.planning.geometry import rigid, rigid as frames, rigid as rotations
from puncture_twin.planning.geometry.rigid import SERIES_BELOW, about_fixed_axes, exp_rotation, rotation_angle

SEED = 20260122
ANGLES = (0.0, 1e-12, 1e-8, 0.99e-6, 1.01e-6, 1e-4, 0.1, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-8)
"""rad: identity, near it, on both sides of the Jacobian's small angle, and near a half turn."""

STEP = 1e-6
"""Of central differences, rad: their error is about STEP^2 + 1e-16 / STEP."""


def rotation_vectors(angle):
    """Twenty rotation vectors of one length, (20, 3)."""
    axes = np.random.default_rng(SEED).normal(size=(20, 3))
    return angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)


def poses(n=20):
    rng = np.random.default_rng(SEED)
    return rigid.pose(rotations.exp_rotation(rng.normal(size=(n, 3))), rng.normal(0.0, 300.0, (n, 3)))


def units(n=20):
    """Random unit vectors (n, 3), with the axes themselves among them."""
    v = np.random.default_rng(SEED).normal(size=(n, 3))
    return np.concatenate([v / np.linalg.norm(v, axis=1, keepdims=True), np.eye(3), -np.eye(3)])


def assert_rotation(R):
    np.testing.assert_allclose(np.swapaxes(R, -1, -2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)


def test_skew_is_the_cross_product():
    v, a = np.random.default_rng(SEED).normal(size=(2, 20, 3))
    np.testing.assert_allclose((rotations.skew(v) @ a[..., None])[..., 0], np.cross(v, a), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_undoes_the_exponential(angle):
    w = rotation_vectors(angle)
    np.testing.assert_allclose(rotations.log_rotation(rotations.exp_rotation(w)), w, rtol=1e-9, atol=1e-14)


def test_exponential_undoes_the_logarithm_at_a_half_turn():
    R = rotations.exp_rotation(rotation_vectors(np.pi))
    w = rotations.log_rotation(R)
    np.testing.assert_allclose(np.linalg.norm(w, axis=1), np.pi, atol=1e-7)
    np.testing.assert_allclose(rotations.exp_rotation(w), R, atol=1e-7)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_is_the_slope_of_the_exponential(angle):
    for w in rotation_vectors(angle):
        R = rotations.exp_rotation(w)
        ends = [rotations.log_rotation(rotations.exp_rotation(w + h * np.eye(3)) @ R.T) for h in (STEP, -STEP)]
        slope = (ends[0] - ends[1]).T / (2 * STEP)
        np.testing.assert_allclose(rotations.left_jacobian(w), slope, atol=1e-9)


def test_poses_form_a_group():
    """Products and inverses are poses; the inverse undoes; the product applies one after the other."""
    T, other = poses(), poses()[::-1]
    points = np.random.default_rng(SEED).normal(0.0, 100.0, (7, 3))
    assert_rotation((T @ other)[:, :3, :3])
    np.testing.assert_allclose(rigid.inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    np.testing.assert_allclose(rigid.inverse(T @ other), rigid.inverse(other) @ rigid.inverse(T), atol=1e-11)
    for one, two in zip(T, other, strict=True):
        np.testing.assert_array_equal((one @ two)[3], [0.0, 0.0, 0.0, 1.0])
        twice = rigid.apply(one, rigid.apply(two, points))
        np.testing.assert_allclose(rigid.apply(one @ two, points), twice, atol=1e-11)
        np.testing.assert_allclose(rigid.apply(rigid.inverse(one), rigid.apply(one, points)), points, atol=1e-11)


def test_a_turn_about_a_point_leaves_it():
    center, shift = np.array([10.0, -20.0, 30.0]), np.array([1.0, 2.0, 3.0])
    for T, w in zip(poses(), rotation_vectors(0.7), strict=True):
        moved = rigid.rotated_about(T, center, np.concatenate([w, shift]))
        there = rigid.apply(rigid.inverse(T), center)
        np.testing.assert_allclose(rigid.apply(moved, there), center + shift, atol=1e-11)
        np.testing.assert_allclose(moved[:3, :3], rotations.exp_rotation(w) @ T[:3, :3], atol=1e-14)


def test_frames_from_axes_keep_the_first_and_lean_to_the_second():
    for z, other in zip(units(), np.roll(units(), 1, axis=0) * 3.0, strict=True):
        of_axes, along, about = frames.frame_of_axes(5 * z, other), frames.frame_along(z, other), frames.frame_about(z)
        for R in (of_axes, along, about):
            assert_rotation(R)
            np.testing.assert_allclose(R[:, 2], z, atol=1e-15)
        assert of_axes[:, 0] @ other > 0
        assert abs(of_axes[:, 1] @ other) < 1e-14
        assert along[:, 1] @ other > 0
        assert abs(along[:, 0] @ other) < 1e-14
        np.testing.assert_allclose(frames.frame_xz(about[:, 0], z), about, atol=1e-15)
        np.testing.assert_allclose(frames.frame_yz(about[:, 1], z), about, atol=1e-15)


def test_the_frame_of_three_points_moves_with_them():
    """Its x axis leads from the first to the second, the third lies on the side of +y in the xy plane."""
    points = np.random.default_rng(SEED).normal(0.0, 100.0, (3, 3))
    R = frames.frame_of_points(points)
    assert_rotation(R)
    in_frame = (points - points[0]) @ R
    np.testing.assert_allclose(in_frame[:, 2], 0.0, atol=1e-12)
    assert in_frame[1, 0] > 0
    assert abs(in_frame[1, 1]) < 1e-12
    assert in_frame[2, 1] > 0
    for T in poses():
        moved = frames.frame_of_points(rigid.apply(T, points))
        np.testing.assert_allclose(moved, T[:3, :3] @ R, atol=1e-12)


SIZES = (1e-12, 1e-5, SERIES_BELOW, 0.1, 1.0, 30.0)
"""Of rotation vectors, rad: from nothing to several turns, about the border of the series among them."""


@pytest.mark.parametrize("size", SIZES)
def test_the_exponential_is_scipys_to_the_bit(size: float) -> None:
    """Of many vectors, of one, and of vectors in a grid; those just at the border of the series too."""
    w = np.random.default_rng(1).normal(size=(5000, 3)) * size
    w[:50] *= SERIES_BELOW / np.linalg.norm(w[:50], axis=1, keepdims=True)
    expected = Rotation.from_rotvec(w).as_matrix()
    assert exp_rotation(w).tobytes() == expected.tobytes()
    assert exp_rotation(w[7]).tobytes() == expected[7].tobytes()
    assert exp_rotation(w.reshape(50, 100, 3)).tobytes() == expected.tobytes()


def test_no_rotation_is_the_identity_and_no_vectors_are_no_rotations() -> None:
    assert np.array_equal(exp_rotation(np.zeros(3)), np.eye(3))
    assert np.array_equal(exp_rotation([0.0, 0.0, np.pi]).round(12), np.diag([-1.0, -1.0, 1.0]))
    assert exp_rotation(np.zeros((0, 3))).shape == (0, 3, 3)


def test_what_is_not_finite_gives_no_rotation() -> None:
    for bad in (np.inf, -np.inf, np.nan):
        assert np.isnan(exp_rotation([bad, 0.0, 0.0])).all()
        assert np.isnan(about_fixed_axes([bad, 0.0, 0.0])).any()


def test_fixed_axes_are_scipys_to_the_bit() -> None:
    """Of any angles, and of the quarter turns that a URDF is full of."""
    rng = np.random.default_rng(2)
    any_turn = rng.normal(size=(3000, 3)) * rng.choice([1e-9, 1e-3, 1.0, 10.0], size=(3000, 1))
    quarters = np.pi / 2 * rng.integers(-4, 5, size=(500, 3))
    for angles in np.concatenate([any_turn, quarters, [[1.570796325, 0.0, -1.570796325]]]):
        assert np.array_equal(about_fixed_axes(angles), Rotation.from_euler("xyz", angles).as_matrix())


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi / 2, 3.0, np.pi - 1e-4, np.pi])
def test_the_angle_of_a_rotation_is_found_again(angle: float) -> None:
    """About any axis; near half a turn, where the trace hardly changes, to 1e-8."""
    for axis in np.random.default_rng(4).normal(size=(50, 3)):
        found = rotation_angle(exp_rotation(angle * axis / np.linalg.norm(axis)))
        assert abs(found - angle) < 2e-8
        assert abs(found - angle) < 1e-15 + 1e-6 * angle or angle > 3.0


def test_scipy_is_not_loaded_for_them() -> None:
    """A new process computes both and has no module of scipy's spatial room."""
    program = (
        "import sys; from puncture_twin.planning.geometry.rigid import about_fixed_axes, exp_rotation;"
        "exp_rotation([0.1, 0.2, 0.3]); about_fixed_axes([0.1, 0.2, 0.3]);"
        "sys.exit(any(name.startswith('scipy') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
