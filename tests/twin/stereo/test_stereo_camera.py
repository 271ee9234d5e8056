"""One camera and a pair: projection, rays, distortion, triangulation. OpenCV is the second engine."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused

from puncture_twin.twin.guidance.stereo.cameras.camera import (
    Camera,
    distort,
    distortion_slope,
    fold,
    looking_at,
    stereo_pair,
    tangent_axes,
    undistort,
)
from puncture_twin.twin.guidance.stereo.cameras.triangulation import triangulate

LENS = (-0.3, 0.1, 1e-3, -2e-3)


@pytest.fixture
def pair():
    """The pair of the figures: 1280 x 960, 500 mm apart, 1 m away, a distorting lens."""
    return stereo_pair(1280, 960, 2560, 500, 1000, LENS)


def test_pixels_are_opencvs(pair, rng):
    """The same model, order of coefficients and pixel convention as OpenCV."""
    points = rng.uniform(-200, 200, (500, 3))
    for camera in pair:
        turn = cv2.Rodrigues(camera.T_camera_c[:3, :3])[0]
        theirs = cv2.projectPoints(points, turn, camera.T_camera_c[:3, 3], camera.K, camera.distortion)[0][:, 0]
        np.testing.assert_allclose(camera.project(points), theirs, atol=1e-9)


def test_the_room_centre_is_the_middle_of_both_pictures_and_the_baseline_is_kept(pair):
    """Pixel centres are at integers: the middle of 1280 pixels is 639.5."""
    for camera in pair:
        pixel = camera.pinhole().project(np.zeros(3))
        np.testing.assert_allclose(pixel, [639.5, 479.5], atol=1e-9)
    left, right = (camera.center_c for camera in pair)
    np.testing.assert_allclose(right - left, [500, 0, 0], atol=1e-9)
    np.testing.assert_allclose((left + right) / 2, [0, 0, -1000], atol=1e-9)


@settings(max_examples=40)
@given(st.tuples(*[st.floats(-0.3, 0.3)] * 2, *[st.floats(-0.005, 0.005)] * 2), st.integers(0, 2**32 - 1))
def test_undistortion_inverts_distortion(coefficients, seed):
    """To 1e-12 inside the picture, for every lens whose picture does not fold there."""
    points = np.random.default_rng(seed).uniform(-0.3, 0.3, (50, 2))
    coefficients = np.array(coefficients)
    np.testing.assert_allclose(undistort(distort(points, coefficients), coefficients), points, atol=1e-12)


def test_rays_pass_through_the_points_that_were_projected(pair, rng):
    points = rng.uniform(-150, 150, (500, 3))
    for camera in pair:
        toward = points - camera.center_c
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        np.testing.assert_allclose(camera.rays(camera.project(points)), toward, atol=1e-12)


def test_slopes_are_finite_differences(pair, rng):
    flat, h = rng.uniform(-0.2, 0.2, (20, 2)), 1e-6
    lens = np.array(LENS)
    by_lens = np.stack([(distort(flat + h * e, lens) - distort(flat - h * e, lens)) / (2 * h) for e in np.eye(2)], -1)
    np.testing.assert_allclose(distortion_slope(flat, lens), by_lens, atol=1e-8)
    points, h = rng.uniform(-100, 100, (20, 3)), 1e-3
    camera = pair[0]
    by_point = np.stack(
        [(camera.project(points + h * e) - camera.project(points - h * e)) / (2 * h) for e in np.eye(3)], -1
    )
    np.testing.assert_allclose(camera.jacobian(points), by_point, atol=1e-6)


def test_what_lies_behind_or_beyond_the_lens_has_no_pixel(pair):
    """A point behind the camera, and one where the barrel distortion folds back into the picture, are NaN."""
    camera = looking_at(np.zeros(3), np.array([0, 0, 1.0]), (1280, 960), 300.0, distortion=(-0.3, 0, 0, 0))
    assert fold(camera.distortion) == pytest.approx(np.sqrt(1 / 0.9))
    assert np.isnan(camera.project(np.array([0, 0, -100.0]))).all()
    folded = distort(np.array([1.5, 0.0]), camera.distortion) * 300 + [camera.cx, camera.cy]
    assert camera.sees(folded), "without the guard this point would appear in the picture"
    assert np.isnan(camera.project(np.array([150.0, 0.0, 100.0]))).all()
    assert not camera.sees(np.array([np.nan, np.nan]))


def test_the_matrix_is_the_camera_without_its_lens(pair, rng):
    """z [u v 1] = M [x y z 1]."""
    points = rng.uniform(-100, 100, (10, 3))
    image = np.column_stack([points, np.ones(10)]) @ pair[1].matrix.T
    np.testing.assert_allclose(image[:, :2] / image[:, 2:], pair[1].pinhole().project(points), atol=1e-9)


def test_a_balls_radius_is_that_of_its_outline(pair, rng):
    """The outline, traced ray by ray, encloses the area of a circle with the radius predicted."""
    for point in rng.uniform(-150, 150, (5, 3)):
        camera = pair[0]
        toward = point - camera.center_c
        distance = np.linalg.norm(toward)
        around = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
        half = np.arcsin(4.0 / distance)
        rim = (
            np.cos(half) * toward / distance
            + np.sin(half) * np.stack([np.cos(around), np.sin(around)], 1) @ tangent_axes(toward / distance).T
        )
        u, v = camera.project(camera.center_c + rim).T
        area = abs(np.sum(u * np.roll(v, -1) - v * np.roll(u, -1))) / 2
        assert camera.ball_radius_px(point, 4.0) == pytest.approx(np.sqrt(area / np.pi), rel=1e-4)


def test_a_moved_frame_changes_nothing_in_the_picture(pair, rng):
    """moved(T_c_other) sees the same points given in the other frame."""
    T = looking_at(np.array([10.0, 20, 30]), np.array([1.0, 2, 3]), (10, 10), 1.0).T_camera_c
    points = rng.uniform(-100, 100, (10, 3))
    np.testing.assert_allclose(
        pair[0].moved(T).project(points), pair[0].project(points @ T[:3, :3].T + T[:3, 3]), atol=1e-9
    )


def test_triangulation_returns_the_points(pair, rng):
    points = rng.uniform(-200, 200, (100, 3))
    found = triangulate(pair, np.stack([camera.project(points) for camera in pair]))
    np.testing.assert_allclose(found.points_c, points, atol=1e-7)


def test_triangulations_covariance_is_honest(pair, rng):
    points = rng.uniform(-100, 100, (2000, 3))
    covariance = np.array([[0.04, 0.01], [0.01, 0.02]])
    noise = rng.multivariate_normal(np.zeros(2), covariance, (2, 2000))
    pixels = np.stack([camera.project(points) for camera in pair]) + noise
    found = triangulate(pair, pixels, np.broadcast_to(covariance, (2, 2000, 2, 2)))
    error = found.points_c - points
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
    assert squared.mean() == pytest.approx(3.0, abs=3 * np.sqrt(6 / 2000))


def test_a_pixel_that_is_missing_leaves_its_point_unknown(pair):
    pixels = np.stack([camera.project(np.zeros((2, 3))) for camera in pair])
    pixels[1, 0] = np.nan
    found = triangulate(pair, pixels).points_c
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1], 0, atol=1e-7)


def test_wrong_cameras_are_refused(pair):
    scaled = np.diag([2.0, 2.0, 2.0, 1.0])
    with refused("not_rigid"):
        Camera(10, 10, 1.0, 1.0, 0.0, 0.0, np.zeros(4), scaled)
    with refused("not_positive"):
        Camera(10, 10, 0.0, 1.0, 0.0, 0.0, np.zeros(4), np.eye(4))
    with refused("wrong_shape"):
        Camera(10, 10, 1.0, 1.0, 0.0, 0.0, np.zeros(5), np.eye(4))
    with refused("wrong_shape"):
        triangulate(pair[:1], np.zeros((1, 2, 2)))
    with refused("not_positive"):
        stereo_pair(10, 10, 1.0, 0.0, 100.0)
