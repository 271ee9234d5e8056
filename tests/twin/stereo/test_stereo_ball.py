"""The ball's picture and its measurement: the picture against brute force, the tracker against the truth."""

import numpy as np
import pytest

from puncture_twin.twin.devices import GreyImage
from puncture_twin.twin.guidance.stereo.ball import Circle, Detection, cone, consensus, find_ball, refit
from puncture_twin.twin.guidance.stereo.camera import stereo_pair, tangent_axes
from puncture_twin.twin.guidance.stereo.servo_law import Lost
from puncture_twin.twin.plant.ball_image import BallScene, _paint, render

LENS = (-0.2, 0.05, 5e-4, -5e-4)
CAMERA = stereo_pair(1280, 960, 2560, 500, 1000, LENS)[0]
SPHERE_MM = 4.0
ANY = {"no_circle", "few_inliers", "wrong_radius", "low_contrast"}


def scene(rng, **changes):
    """A ball somewhere, its rod and lamp pointing anywhere (the lamp from the camera's side)."""
    light = rng.normal(size=3)
    light[2] = -abs(light[2])
    drawn = {
        "center_c": rng.uniform(-1, 1, 3) * [150, 120, 100],
        "rod_c": rng.normal(size=3),
        "light_c": light,
        "hidden_from": rng.uniform(0, 2 * np.pi),
    }
    return BallScene(**(drawn | changes))


def tracked(rng, count, *, noise=2.0, hough_only=False, **changes):
    """What the tracker says of random pictures, and its errors in px, shape (found, 2)."""
    answers, errors = [], []
    for _ in range(count):
        ball = scene(rng, **changes)
        picture = render(CAMERA, ball, rng=rng, noise=noise, half_px=45)
        predicted = ball.center_c + rng.normal(0, 1, 3)
        found = find_ball(picture, CAMERA, predicted, SPHERE_MM, search_px=12, hough_only=hough_only)
        answers.append(found)
        if isinstance(found, Detection):
            errors.append(found.pixel - CAMERA.project(ball.center_c))
    return answers, np.array(errors)


def rms(errors):
    return np.sqrt(np.mean(np.sum(errors**2, axis=1)))


def test_the_picture_is_that_of_a_dense_plain_ray_caster(rng):
    """40 x 40 rays per pixel, each met with the sphere by the quadratic formula."""
    ball = scene(rng, rod=False)
    low = np.round(CAMERA.project(ball.center_c)).astype(int) - 13
    ours = np.full((27, 27), ball.background_grey)
    _paint(ours, low, CAMERA, ball, 1e-6)
    fine = (np.arange(40) + 0.5) / 40 - 0.5
    light = np.array(ball.light_c) / np.linalg.norm(ball.light_c)
    u, v, du, dv = np.meshgrid(np.arange(27), np.arange(27), fine, fine, indexing="xy", sparse=True)
    rays = CAMERA.rays(np.stack(np.broadcast_arrays(u + du, v + dv), -1) + low)
    to_ball = ball.center_c - CAMERA.center_c
    along = rays @ to_ball
    under = along**2 - to_ball @ to_ball + SPHERE_MM**2
    hit = (along - np.sqrt(np.maximum(under, 0)))[..., None] * rays
    cosine = np.clip((hit - to_ball) @ light / SPHERE_MM, 0, None)
    grey = np.where(under > 0, ball.ball_grey * (ball.diffuse + (1 - ball.diffuse) * cosine), ball.background_grey)
    plain = grey.mean(axis=(2, 3))
    assert np.abs(ours - plain).max() < 1.0
    places = np.indices((27, 27))
    centers = [np.sum(places * one, axis=(1, 2)) / one.sum() for one in (ours - 60, plain - 60)]
    assert np.abs(centers[0] - centers[1]).max() < 1e-3


def test_the_outlines_centre_is_not_the_balls(rng):
    """Off the axis the ellipse's centre lies off the projection of the ball's centre; the tracker does not follow it.

    The shift is f tan(t) (R/D)^2 / cos^2(t) to first order: a tenth of a pixel for a ball four times as large.
    """
    camera = stereo_pair(1280, 960, 2560, 500, 1000)[0]
    center, radius = np.array([0.0, 160.0, -100.0]), 16.0
    toward = center - camera.center_c
    distance = np.linalg.norm(toward)
    around = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    half = np.arcsin(radius / distance)
    axes = tangent_axes(toward / distance)
    rim = np.cos(half) * toward / distance + np.sin(half) * np.stack([np.cos(around), np.sin(around)], 1) @ axes.T
    u, v = camera.project(camera.center_c + rim).T
    cross = u * np.roll(v, -1) - np.roll(u, -1) * v
    centroid = np.array([np.sum((w + np.roll(w, -1)) * cross) for w in (u, v)]) / (3 * np.sum(cross))
    shift = np.linalg.norm(centroid - camera.project(center))
    tilt = np.arccos((toward / distance) @ camera.T_camera_c[2, :3])
    assert shift == pytest.approx(2560 * np.tan(tilt) / np.cos(tilt) ** 2 * (radius / distance) ** 2, rel=0.05)
    assert shift > 0.1
    ball = BallScene(center, radius_mm=radius, rod=False, diffuse=1.0)
    picture = render(camera, ball, rng=rng, noise=0.5, half_px=90)
    found = find_ball(picture, camera, center, radius, search_px=12)
    assert np.linalg.norm(found.pixel - camera.project(center)) < shift / 5


def test_an_occluder_hides_the_share_asked_for(rng):
    for share in (0.15, 0.5):
        plain = scene(rng, rod=False, diffuse=1.0, background_grey=0.0, occluder_grey=0.0)
        hidden = BallScene(**(vars(plain) | {"hidden_fraction": share}))
        whole, part = (
            render(CAMERA, one, rng=rng, noise=0.0, half_px=30).grey.astype(float).sum() for one in (plain, hidden)
        )
        assert 1 - part / whole == pytest.approx(share, abs=0.01)


def test_a_window_is_a_part_of_the_whole_picture(rng):
    """Without noise they agree pixel by pixel; a ball behind the camera leaves a flat picture."""
    ball = scene(rng)
    whole = render(CAMERA, ball, rng=rng, noise=0.0)
    part = render(CAMERA, ball, rng=rng, noise=0.0, half_px=30)
    column, row = part.offset
    assert whole.grey.shape == (960, 1280)
    np.testing.assert_array_equal(whole.grey[row : row + 61, column : column + 61], part.grey)
    behind = render(CAMERA, BallScene(np.array([0, 0, -3000.0]), rod=False), rng=rng, noise=0.0)
    assert np.all(behind.grey == 60)


@pytest.fixture(scope="module")
def clean():
    return tracked(np.random.default_rng(7), 24)


def test_the_measured_centre_is_fifteen_times_as_good_as_houghs(clean):
    """Diffuse light, rod and lamp anywhere: rms below .03 px, and Hough's at least fifteen times that."""
    _, errors = clean
    _, hough = tracked(np.random.default_rng(7), 24, hough_only=True)
    assert len(errors) == len(hough) == 24
    assert rms(errors) < 0.03
    assert rms(hough) > 15 * rms(errors)


@pytest.mark.parametrize("share", [0.15, 0.30])
def test_a_partly_hidden_ball_is_measured(rng, share):
    """Rms at most .08 px with 15 % and 30 % of the disc hidden; hardly one is refused."""
    _, errors = tracked(rng, 10, hidden_fraction=share)
    assert rms(errors) <= 0.08
    assert len(errors) >= 9


def test_the_covariance_is_honest(clean):
    """Under diffuse light the squared error is within a factor of two of what is claimed."""
    answers, errors = clean
    squared = [e @ np.linalg.solve(ball.covariance, e) / 2 for ball, e in zip(answers, errors, strict=True)]
    assert 0.4 < np.mean(squared) < 2.0


@pytest.mark.parametrize(
    ("changes", "reasons"),
    [
        ({"ball": False}, {"no_circle", "few_inliers", "low_contrast"}),
        ({"ball": False, "rod": False}, {"low_contrast"}),
        ({"ball": False, "texture_grey": 25.0}, ANY),
        ({"ball_grey": 66.0, "diffuse": 1.0, "rod": False}, {"low_contrast"}),
        ({"ball_grey": 66.0, "diffuse": 1.0, "texture_grey": 15.0}, ANY),
        ({"hidden_fraction": 0.65}, ANY),
        ({"radius_mm": 4.6}, {"wrong_radius"}),
    ],
    ids=["missing", "nothing at all", "missing, texture", "faint", "like its texture", "hidden", "larger"],
)
def test_a_ball_that_cannot_be_believed_is_lost(rng, changes, reasons):
    answers, _ = tracked(rng, 6, **changes)
    assert all(isinstance(answer, Lost) for answer in answers)
    assert {answer.reason for answer in answers} <= reasons


def test_a_prediction_out_of_view_is_named(rng):
    """Behind the camera, beside the picture, and beside the part given."""
    picture = GreyImage(np.full((960, 1280), 60, dtype=np.uint8))
    for predicted in ([0.0, 0.0, -3000.0], [400.0, 0.0, 0.0]):
        assert find_ball(picture, CAMERA, np.array(predicted), 4.0, search_px=12).reason == "not_in_view"
    part = GreyImage(picture.grey[:50, :50], (0, 0))
    assert find_ball(part, CAMERA, np.zeros(3), 4.0, search_px=12).reason == "not_in_view"


def test_the_consensus_ignores_what_is_not_on_the_circle(rng):
    """Half of the edges moved away: the circle of the others comes back, and its cone is the ball's."""
    around = 2 * np.pi * np.arange(72) / 72
    away = np.where(np.arange(72) < 33, rng.uniform(-0.3, 0.3, 72), 0.0)
    points = 0.004 * (np.stack([np.cos(around), np.sin(around)], 1) * (1 + away)[:, None] + [0.2, -0.1])
    scales = np.full(72, 2560.0)
    start = consensus(points, np.ones(72, dtype=bool), scales, 0.3)
    found = refit(points, scales, start, 0.3)
    np.testing.assert_allclose(found.circle.center, [0.0008, -0.0004], atol=2e-7)
    assert found.circle.radius == pytest.approx(0.004, abs=2e-7)
    direction = np.array([0.0, 0.0, 1.0])
    axes = tangent_axes(direction)
    axis, half = cone(Circle(found.circle.center, found.circle.radius), direction, axes)
    plane = found.circle.center + 0.004 * np.stack([np.cos(around), np.sin(around)], 1)
    square = np.sum(plane**2, axis=1, keepdims=True) / 4
    rays = ((1 - square) * direction + plane @ axes.T) / (1 + square)
    np.testing.assert_allclose(np.arccos(rays @ axis), half, atol=1e-6)
