"""The angles (θ, β), the entry frame, and the needle that they place."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from refusals import refused

import puncture_twin.planning.case.entry
from puncture_twin.planning.case.case import view_frame
from puncture_twin.planning.case.entry import angles, direction, entry_frame, grid, needle_pose, outward
from puncture_twin.planning.case.tables import EntryAxes
from puncture_twin.planning.geometry.spaces import Space

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


@pytest.mark.parametrize(
    ("axes", "space", "rows"),
    [
        ("bed", Space.LPS, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
        (EntryAxes(z="posterior", x="head"), Space.LPS, [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        ("ct", Space.RAS, np.diag([-1.0, -1.0, 1.0])),
        ("ct", Space.LOCAL, np.eye(3)),
        (EntryAxes(z=(0, 0, 2), x=(1, 0, 1)), Space.LPS, np.eye(3)),
    ],
)
def test_axes_of_an_entry_frame(axes, space, rows):
    """A bed's x is the head (+z), y the patient's right (-x), z the front (-y); z of stated axes is kept."""
    np.testing.assert_allclose(entry_frame(axes, space).T, rows, atol=1e-15)


@pytest.mark.parametrize("space", [Space.LPS, Space.RAS, Space.LOCAL])
def test_oblique_axes_give_an_orthonormal_frame(rng, space):
    """Axes of any length and angle: orthonormal, right-handed, z kept, x in the plane of both."""
    for _ in range(50):
        z, x = rng.normal(0, [[30.0], [0.2]], (2, 3))
        R = entry_frame(EntryAxes(z=tuple(z), x=tuple(x)), space)
        signs = np.array([-1.0, -1.0, 1.0]) if space is Space.RAS else np.ones(3)
        z, x = z * signs / np.linalg.norm(z), x * signs / np.linalg.norm(x)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1, abs=1e-12)
        np.testing.assert_allclose(R[:, 2], z, atol=1e-12)
        assert R[:, 0] @ x > 0
        assert R[:, 1] @ x == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("length", [0.01, 1.0, 70.0])
def test_parallel_axes_are_refused(length):
    """Opposite, zero, or 2 degrees apart, of any length; axes 3 degrees apart span a frame."""
    two, three = np.radians([2, 3])
    for z, x in ((1, (0, 0, -3)), (1, (0, 0, 0)), (1, (np.sin(two), 0, np.cos(two))), (0, (1, 0, 0))):
        with refused("axes_parallel"):
            entry_frame(EntryAxes(z=(0, 0, z * length), x=x), Space.LPS)
    R = entry_frame(EntryAxes(z=(0.0, 0.0, length), x=(-np.sin(three), 0, np.cos(three))), Space.LPS)
    np.testing.assert_allclose(R.T, [[-1, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-12)


def test_a_frame_that_is_not_known_is_refused():
    """And what is allowed is named; without a frame a patient has the bed's, a local case its own axes."""
    with refused("unknown_frame", "table"):
        entry_frame("table", Space.LPS)
    np.testing.assert_array_equal(entry_frame(None, Space.LPS), entry_frame("bed", Space.LPS))
    np.testing.assert_array_equal(entry_frame(None, Space.LOCAL), np.eye(3))


def test_the_bodys_directions_are_those_of_lps():
    """L, P and S are +x, +y and +z; unit vectors, each opposite to its counterpart."""
    expected = {"left": (1, 0, 0), "posterior": (0, 1, 0), "head": (0, 0, 1)}
    expected |= {"right": (-1, 0, 0), "anterior": (0, -1, 0), "feet": (0, 0, -1)}
    assert dict(puncture_twin.planning.case.entry.ANATOMICAL_LPS) == expected


def test_the_view_frame_stands_on_the_target():
    """T_ct_entry maps the entry frame's origin to the target and its axes to the columns; nobody can write to it."""
    R, target = entry_frame("bed", Space.LPS), np.array([10.0, -20.0, 30.0])
    T = view_frame(R, target)
    np.testing.assert_array_equal(T, [[0, -1, 0, 10], [0, 0, -1, -20], [1, 0, 0, 30], [0, 0, 0, 1]])
    assert not T.flags.writeable


def test_angles_of_many_directions():
    """One angle pair per row, whatever the shape; the azimuth is 0 at the poles, for any sign of zero."""
    u = np.array([[0.0, 0, 1], [-0.0, 0, 1], [0, -0.0, -1], [1, 0, 0], [0, -1, 0]])
    theta, beta = angles(u)
    np.testing.assert_allclose(np.degrees(theta), [0, 0, 180, 90, 90], atol=1e-12)
    np.testing.assert_allclose(np.degrees(beta), [0, 0, 0, 0, 270], atol=1e-12)
    for shape in ((1, 5, 3), (5, 1, 3)):
        np.testing.assert_array_equal(angles(u.reshape(shape))[1].ravel(), beta)


@pytest.mark.parametrize(
    ("low", "high", "step", "expected"),
    [
        (200, 340, 70, [200, 270, 340]),
        (0, 180, 90, [0, 90, 180]),
        (90, 450, 180, [90, 270]),
        (0, 360, 360, [0]),
        (0, 90, 30, [0, 30, 60, 90]),
        (30, 30, 10, [30]),
        (10, 35, 10, [10, 20, 30]),
        (-90, 270, 120, [-90, 30, 150]),
        (0, 359.9, 359.9, [0, 359.9]),
    ],
)
def test_azimuths_of_a_range(low, high, step, expected):
    """From the lower end by steps, the upper end where a step meets it, and a full circle without its repetition."""
    found = grid((0.3, 0.3), (np.radians(low), np.radians(high)), np.radians(step), np.eye(3))
    np.testing.assert_allclose(np.degrees(found.beta), expected, atol=1e-9)
    np.testing.assert_array_equal(found.theta, 0.3)


def test_puncture_angles_of_a_range_are_outermost_and_read_only():
    """Each puncture angle with all azimuths, then the next; directions are those of the angles in the CT frame."""
    R = entry_frame("bed", Space.LPS)
    found = grid((0.5, 0.7), (0, 1), 0.1, R)
    assert len(found) == 33
    np.testing.assert_allclose(found.theta[::11], [0.5, 0.6, 0.7])
    np.testing.assert_allclose(found.beta[:11], np.linspace(0, 1, 11))
    np.testing.assert_allclose(found.outward_ct, outward(found.theta, found.beta) @ R.T, atol=1e-15)
    assert not any(column.flags.writeable for column in (found.theta, found.beta, found.outward_ct))


@pytest.mark.parametrize(("short", "count"), [(0.7e-9, 11), (1.5e-9, 10), (-0.7e-9, 11)])
def test_rounding_of_a_billionth_of_a_step_loses_no_end(short, count):
    """A range that lacks less than 1e-9 of a step to its last point has it; one that lacks more does not."""
    assert len(grid((0, 10 - short), (0, 0), 1.0, np.eye(3))) == count


def test_needle_points_at_the_target():
    """Tip and top lie on the ray from the target: at r and at r + l (Chen 2019, Eq. 12-15); r by row goes with u."""
    target, u = np.array([1.0, 2.0, 3.0]), direction(0.4, 1.1, np.eye(3)).outward_ct
    for standoff in (150.0, np.array([10.0, 20.0, 30.0])):
        rows = u if np.ndim(standoff) == 0 else u.repeat(3, axis=0)
        pose, r = needle_pose(target, rows, standoff=standoff, length=401.0), np.reshape(standoff, (-1, 1))
        np.testing.assert_allclose(pose.tip_ct, target + r * rows)
        np.testing.assert_allclose(pose.top_ct, target + (r + 401.0) * rows)


def angle_grid(theta_deg, beta_deg, step_deg):
    return grid(tuple(np.radians(theta_deg)), tuple(np.radians(beta_deg)), np.radians(step_deg), np.eye(3)).grid


@pytest.mark.parametrize(
    ("theta_deg", "beta_deg"),
    [((0, 90), (0, 360)), ((0, 180), (0, 360)), ((20, 60), (0, 360)), ((10, 40), (30, 120)), ((0, 40), (30, 120))],
)
def test_solid_angles_are_those_of_the_whole_range(theta_deg, beta_deg):
    """(cos θ0 - cos θ1) Δβ, however the range lies."""
    found = angle_grid(theta_deg, beta_deg, 2.0)
    (low, high), width = np.radians(theta_deg), np.radians(beta_deg[1] - beta_deg[0])
    assert found.solid_angle().sum() == pytest.approx((np.cos(low) - np.cos(high)) * width, rel=1e-12)
    assert len(found.solid_angle()) == len(found)


def test_neighbours_are_at_most_a_step_apart_and_each_row_has_all_of_its_own():
    """Four neighbours inside, along the full circle too; all rows at the pole are one direction."""
    found = angle_grid((0, 60), (0, 360), 10.0)
    pairs = found.neighbours()
    vectors = outward(np.repeat(found.theta, len(found.beta)), np.tile(found.beta, len(found.theta)))
    apart = np.arccos(np.clip((vectors[pairs[:, 0]] * vectors[pairs[:, 1]]).sum(axis=1), -1, 1))
    assert apart.max() <= np.radians(10.0) + 1e-7
    counts = np.bincount(pairs.ravel(), minlength=len(found)).reshape(7, 36)
    assert (counts[1:-1] == 4).all() and (counts[-1] == 3).all()
    at_pole = {tuple(sorted(pair)) for pair in pairs.tolist() if max(pair) < 36}
    assert {(i, i + 1) for i in range(35)} <= at_pole


def test_an_open_range_of_azimuths_has_ends():
    found = angle_grid((10, 30), (0, 350), 10.0)
    assert not found.full_circle
    assert {(0, 35), (35, 0)}.isdisjoint(map(tuple, found.neighbours().tolist()))


def test_beyond_lies_one_step_outside():
    """Around the cap alone for a full circle; on all four sides otherwise; nowhere for the whole sphere."""
    theta, beta = angle_grid((0, 60), (0, 360), 10.0).beyond()
    np.testing.assert_allclose(np.degrees(theta), 70.0)
    assert len(beta) == 36
    theta, beta = np.degrees(angle_grid((20, 60), (30, 90), 10.0).beyond())
    assert {10.0, 70.0} <= set(np.round(theta, 9)) and {20.0, 100.0} <= set(np.round(beta, 9))
    assert len(angle_grid((0, 180), (0, 360), 10.0).beyond()[0]) == 0
