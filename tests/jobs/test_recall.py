"""The truth by which recall is counted, against closed forms; and one small image from its making to its row.

The cylinder lies along z about the origin; the target lies off its axis, a rod beside the target.
"""

import math

import numpy as np
import pytest
import trimesh

from benchmarks.recall.images import Image, phantom
from benchmarks.recall.oracle import Grid, Needle, Oracle, Scene, filled
from benchmarks.recall.rows import judged

RADIUS, HALF = 60.0, 100.0
TARGET, ROD, ROD_RADIUS, MARGIN = np.array([10.0, 0.0, 0.0]), -25.0, 6.0, 2.0
NEEDLE = Needle(200.0, 150.0, 0.6, 15.0, math.radians(60.0), lambda path, angle: path + 20.0)
VOXEL = 3.0
DIAGONAL = VOXEL * math.sqrt(3.0)


def scene(*, image_half=159.0, slab=None):
    """A cylinder with a rod along z at x = ROD; `slab`: y from which a table lies below it."""
    grid = Grid.of((-120, -120, -159), (120, 120, 159), VOXEL)
    image = Grid.of((-120, -120, -image_half), (120, 120, image_half), VOXEL)
    x, y, z = grid.axes()
    body = (np.hypot(x, y) <= RADIUS) & (abs(z) <= HALF)
    foreign = np.zeros(grid.shape, bool)
    if slab is not None:
        foreign |= (y >= slab) & (y <= slab + 20.0)
    rod = (np.hypot(x - ROD, y) <= ROD_RADIUS) & (abs(z) <= HALF)
    return Scene(grid, image, body, foreign, {"rod": rod}, TARGET, margins={"rod": MARGIN})


def in_plane(degrees):
    """Directions across the cylinder's axis, by their angle from the left."""
    angle = np.radians(degrees)
    return np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)


def test_path_and_angle_at_a_cylinder_s_skin():
    """A chord from a point off the axis; the angle between it and the radius at its end."""
    u = in_plane(np.arange(0.0, 360.0, 7.0))
    truth = Oracle(scene(), NEEDLE)(u)
    along = u @ TARGET
    path = -along + np.sqrt(along**2 - TARGET @ TARGET + RADIUS**2)
    entry = TARGET + path[:, None] * u
    angle = np.arccos(np.einsum("ni,ni->n", entry, u) / RADIUS)
    assert np.abs(truth.path - path).max() < VOXEL
    assert np.abs(truth.angle - angle).max() < math.radians(6.0)


def test_what_is_near_a_rod_is_neither_free_nor_within_it_right():
    """Distance of a line from the rod's axis: within radius + margin - diagonal wrong, beyond + diagonal free."""
    degrees = np.arange(120.0, 240.0, 1.5)
    truth = Oracle(scene(), NEEDLE)(in_plane(degrees))
    apart = np.abs(np.sin(np.radians(degrees))) * (TARGET[0] - ROD) - ROD_RADIUS - MARGIN
    assert np.abs(truth.near - apart)[apart > -5.0].max() < VOXEL
    assert truth.wrong[apart < NEEDLE.radius - DIAGONAL - 1.0].all()
    assert not truth.wrong[apart > NEEDLE.radius - DIAGONAL + 1.0].any()
    assert truth.free[apart > NEEDLE.hub + DIAGONAL + 1.0].all()
    assert not truth.free[apart < NEEDLE.radius + DIAGONAL - 1.0].any()


def test_what_passes_beyond_a_cut_face_is_unseen_and_the_rest_is_not():
    """The image ends at z = 72 within the cylinder: needles end at path + 220 mm, the holder is 15 mm wide."""
    tilt = np.radians(np.concatenate([np.arange(0.0, 20.0, 1.0), np.arange(160.0, 181.0, 4.0)]))
    u = np.stack([np.cos(tilt), 0.0 * tilt, np.sin(tilt)], axis=1)
    one = scene(image_half=72.0)
    truth = Oracle(one, NEEDLE)(u)
    flange = truth.path + NEEDLE.length + 20.0
    s = np.arange(0.0, 400.0)
    points = TARGET + s[:, None] * u[:, None]
    wide = np.where(s >= NEEDLE.shaft, NEEDLE.hub, NEEDLE.radius)
    ahead = np.abs(points[..., 2]) + wide - 72.0
    aside = np.hypot(points[..., 0], points[..., 1]) - RADIUS - 150.0 - wide

    def passes(by):
        return ((ahead > by) & (aside < -by) & (s <= flange[:, None] - by)).any(axis=1)

    assert truth.unseen[passes(4.0)].all()
    assert not truth.unseen[~passes(-4.0)].any()
    assert 4 < truth.unseen.sum() < len(u) - 4
    assert not (truth.free & truth.unseen).any()
    assert not Oracle(scene(), NEEDLE)(u).unseen.any()


def test_a_table_beneath_is_passed_by_what_points_down():
    """It touches the cylinder; straight down is wrong, straight up and to the sides is not."""
    truth = Oracle(scene(slab=RADIUS), NEEDLE)(in_plane(np.array([90.0, 270.0, 0.0])))
    assert truth.wrong.tolist() == [True, False, False]
    assert truth.free.tolist() == [False, True, True]


def test_a_closed_surface_becomes_the_mask_that_it_encloses():
    """A ball: each voxel a millimetre within or without is told right, and the volume is the ball's."""
    ball = trimesh.creation.icosphere(4, 40.0)
    grid = Grid.of((-60, -60, -60), (60, 60, 60), 2.0)
    mask = filled(ball, grid)
    radius = np.sqrt(sum(axis**2 for axis in grid.axes()))
    assert mask[radius < 39.5].all()
    assert not mask[radius > 40.5].any()
    assert mask.sum() * 8.0 == pytest.approx(4 / 3 * math.pi * 40.0**3, rel=0.01)


def test_one_small_image_from_its_making_to_its_row(tmp_path, monkeypatch):
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE", "")
    row = judged(tmp_path, Image("small", phantom("cylinder", False, 5.0)))
    assert row["free"] > 500
    assert row["wrong"] == 0
    assert row["safe_of_free"] + sum(row["refused_by"].values()) == row["free"]
    assert row["recall"] == pytest.approx(row["safe_of_free"] / row["free"], abs=5e-4)
