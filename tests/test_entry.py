"""The angles (θ, β), the entry frame, and the needle that they place."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planning.case_file import EntryAxes
from planning.entry import angles, direction, entry_frame, grid, needle_pose, outward
from planning.errors import InputError
from planning.formats.spaces import Space

polar = st.one_of(st.floats(0, np.pi), st.sampled_from([0.0, 1e-12, 1e-8, np.pi / 2, np.pi - 1e-8, np.pi]))
azimuth = st.one_of(st.floats(0, 2 * np.pi, exclude_max=True), st.sampled_from([0.0, np.pi, 1.5 * np.pi]))


@given(polar, azimuth)
def test_angles_undo_outward(theta, beta):
    """From angles to a unit vector and back gives the same direction, at the poles too."""
    u = outward(theta, beta)
    assert np.linalg.norm(u) == pytest.approx(1, abs=1e-15)
    theta_back, beta_back = angles(u)
    assert theta_back == pytest.approx(theta, abs=1e-12)
    np.testing.assert_allclose(outward(theta_back, beta_back), u, atol=1e-12)
    assert 0 <= beta_back < 2 * np.pi


def test_outward_points_where_the_words_say():
    """θ = 0 is the entry frame's +z, θ = 90° with β = 0 its +x and with β = 90° its +y."""
    np.testing.assert_allclose(outward(0.0, 2.0), [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(outward(np.pi / 2, 0.0), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(outward(np.pi / 2, np.pi / 2), [0, 1, 0], atol=1e-15)


def test_bed_frame_has_head_right_and_front():
    """In LPS the bed frame's x is the head (+z), y the patient's right (-x), z the front (-y)."""
    R = entry_frame("bed", Space.LPS)
    np.testing.assert_array_equal(R.T, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    assert np.linalg.det(R) == pytest.approx(1)


def test_prone_frame():
    """For a patient lying on the front, z is posterior and y = z × x the patient's left."""
    R = entry_frame(EntryAxes(z="posterior", x="head"), Space.LPS)
    np.testing.assert_array_equal(R.T, [[0, 0, 1], [1, 0, 0], [0, 1, 0]])


def test_ct_frame_of_a_ras_case_has_ras_axes():
    """Frame "ct" means the axes of the case's own space, seen in LPS."""
    np.testing.assert_array_equal(entry_frame("ct", Space.RAS), np.diag([-1.0, -1.0, 1.0]))
    np.testing.assert_array_equal(entry_frame("ct", Space.LOCAL), np.eye(3))


def test_explicit_axes_are_made_orthonormal():
    """Explicit vectors keep z; x is turned to a right angle."""
    R = entry_frame(EntryAxes(z=(0, 0, 2), x=(1, 0, 1)), Space.LPS)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-15)


def test_parallel_axes_are_refused():
    """Axes that do not span a frame are named."""
    with pytest.raises(InputError, match="parallel"):
        entry_frame(EntryAxes(z=(0, 0, 1), x=(0, 0, -3)), Space.LPS)


def test_grid_counts_every_cell_once():
    """A hemisphere at 1° has 91 x 360 rows; β = 360° repeats β = 0 and is left out."""
    found = grid((0, np.pi / 2), (0, 2 * np.pi), np.radians(1), np.eye(3))
    assert len(found) == 91 * 360
    assert np.degrees(found.theta.max()) == pytest.approx(90)
    assert np.degrees(found.beta.max()) == pytest.approx(359)
    np.testing.assert_allclose(np.linalg.norm(found.outward_ct, axis=1), 1, atol=1e-15)


def test_grid_of_a_partial_range_keeps_both_ends():
    """A range that is no full circle keeps its last azimuth."""
    found = grid((0.1, 0.1), (0, np.radians(90)), np.radians(30), np.eye(3))
    np.testing.assert_allclose(np.degrees(found.beta), [0, 30, 60, 90], atol=1e-9)


def test_needle_points_at_the_target():
    """Tip and top lie on the ray from the target: at r and at r + l (Chen 2019, Eq. 12-15)."""
    target = np.array([1.0, 2.0, 3.0])
    u = direction(0.4, 1.1, np.eye(3)).outward_ct[0]
    pose = needle_pose(target, u, standoff=150.0, length=401.0)
    np.testing.assert_allclose(pose.tip_ct, target + 150 * u)
    np.testing.assert_allclose(pose.top_ct, target + 551 * u)
