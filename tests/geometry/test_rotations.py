"""Rotations are scipy's to the last bit, and scipy is not loaded for them."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from puncture_twin.planning.geometry.rigid import SERIES_BELOW, about_fixed_axes, exp_rotation, rotation_angle

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
