"""Normals where a surface is smooth, and where it is not: the angle at which a needle meets skin is taken from them."""

import numpy as np
import pytest
import trimesh

from puncture_twin.planning.geometry.mesh import TriangleMesh, smooth_normals, split_at_creases


def both_ways(faces, rng):
    return np.concatenate([faces, faces[:, ::-1]])


def some_turned(share):

    def turn(faces, rng):
        return np.where((rng.random(len(faces)) < share)[:, None], faces[:, ::-1], faces)

    return turn


def off_deg(normals, points):
    """Between normals and the radii of a ball, whichever way round, degrees."""
    cosine = np.abs(np.einsum("ij,ij->i", normals, points)) / np.linalg.norm(points, axis=1)
    return np.degrees(np.arccos(np.minimum(cosine, 1.0)))


@pytest.mark.parametrize(
    "wound",
    [
        pytest.param(lambda faces, rng: faces, id="alike"),
        pytest.param(both_ways, id="both ways round"),
        pytest.param(some_turned(0.5), id="half against the others"),
        pytest.param(some_turned(0.1), id="a tenth against the others"),
    ],
)
def test_normals_are_a_balls_however_its_triangles_are_wound(rng, wound):
    """Blended where triangles agree, off by a fraction of what flat ones are; by no more than twice that anywhere.

    Areas whose sum keeps half of them, each off by an angle, are off by no more than twice its sine together.
    """
    ball = trimesh.creation.icosphere(4, radius=100.0)
    flat = off_deg(np.repeat(ball.face_normals, 3, axis=0), ball.triangles.reshape(-1, 3)).max()
    mesh = split_at_creases(TriangleMesh(ball.vertices, wound(ball.faces, rng)))
    face = rng.integers(0, len(mesh.faces), 3000)
    points = np.einsum("ij,ijk->ik", rng.dirichlet([1, 1, 1], 3000), mesh.triangles[face])
    off = off_deg(smooth_normals(mesh, face, points), points)
    assert off.max() <= (flat / 5 if mesh.wound_alike else 2 * flat)


@pytest.mark.parametrize("wound", [lambda faces, rng: faces, both_ways, some_turned(0.5)])
@pytest.mark.parametrize("ridge_deg", [20.0, 40.0, 59.0, 90.0, 110.0])
def test_the_sides_of_a_ridge_keep_their_normals(rng, ridge_deg, wound):
    """However sharp: the normals of a ridge of 40 degrees lie 140 apart, though their lines only 40."""
    half = np.radians(ridge_deg / 2)
    left, right = np.array([-np.sin(half), -np.cos(half)]) * 50, np.array([np.sin(half), -np.cos(half)]) * 50
    prism = trimesh.creation.extrude_triangulation(np.array([left, right, [0.0, 0.0]]), [[0, 1, 2]], height=80.0)
    prism = prism.subdivide().subdivide()
    mesh = split_at_creases(TriangleMesh(prism.vertices, wound(prism.faces, rng)))
    face = np.arange(len(mesh.faces))
    found = smooth_normals(mesh, face, mesh.triangles.mean(axis=1))
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    own = np.cross(b - a, c - a)
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", found, own)), 1.0, atol=1e-9)
