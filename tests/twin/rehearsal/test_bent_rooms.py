"""Rooms in which the needle bends to a side of its own, against what is believed of them."""

import numpy as np
import pytest

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.uncertainty.pose_error import Bend, _bend_covariance
from puncture_twin.twin.plant.true_needle import TrueNeedle
from puncture_twin.twin.rehearsal.trials import bent

BEND, COUNT = Bend(2.5, 150.0), 100_000
Q = np.radians([20, -70, 90, -60, -80, 0])


def needles():
    T = flange_pose(ur_model("ur3"), Q)
    tips = np.broadcast_to(T[:3, 3] + 210 * T[:3, 2], (COUNT, 3))
    return TrueNeedle(tips, np.broadcast_to(T[:3, :3], (COUNT, 3, 3)))


def rotation_vectors(R):
    return 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)


def test_a_bent_needle_ends_where_its_bevel_took_it(rng):
    """Off by the deflection across itself; where it is held it stays, to second order."""
    straight = needles()
    found = bent(straight, BEND, rng.uniform(0, 2 * np.pi, COUNT))
    off = found.tip_base - straight.tip_base
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), BEND.tip_mm)
    np.testing.assert_allclose(np.einsum("na,na->n", off, straight.R_base_needle[:, :, 2]), 0.0, atol=1e-12)
    held = [one.tip_base - BEND.clamped_mm * one.R_base_needle[:, :, 2] for one in (found, straight)]
    assert np.linalg.norm(held[0] - held[1], axis=1).max() < BEND.tip_mm**2 / BEND.clamped_mm
    squares = found.R_base_needle @ np.swapaxes(found.R_base_needle, 1, 2)
    assert np.abs(squares - np.eye(3)).max() < 1e-9


def test_what_is_believed_of_the_bend_is_what_the_rooms_show(rng):
    """All 36 entries of the covariance of tip and rotation."""
    straight = needles()
    found = bent(straight, BEND, rng.uniform(0, 2 * np.pi, COUNT))
    turned = rotation_vectors(found.R_base_needle @ np.swapaxes(straight.R_base_needle, 1, 2))
    errors = np.concatenate([found.tip_base - straight.tip_base, turned], axis=1)
    scale = np.repeat([BEND.tip_mm, BEND.tip_mm / BEND.clamped_mm], 3)
    realised, believed = np.cov((errors / scale).T), _bend_covariance(ur_model("ur3"), Q[None], BEND)[0]
    np.testing.assert_allclose(realised, believed / np.outer(scale, scale), atol=0.01)
    assert np.trace(believed[:3, :3]) == pytest.approx(BEND.tip_mm**2)
