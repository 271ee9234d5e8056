"""The edge test by itself: gradients, placements, z, and the refined place, each against a plain oracle."""

import numpy as np
import pytest

from benchmarks.placements import meshes_of, phantoms
from puncture_twin.planning.evidence.edges import (
    Placement,
    axis_slips,
    compare,
    edge_image,
    refined,
    sample_surfaces,
    scalings,
    shifts,
)
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply, exp_rotation


@pytest.fixture(scope="module")
def trunk():
    """A CT of a trunk at 3 mm with eight organs, and their surfaces."""
    patient = dict(phantoms())["trunk"]
    return patient, edge_image(patient.hu, patient.T), sample_surfaces(list(meshes_of(patient).values()), 4000)


def test_the_strength_of_a_ramp_is_its_slope_along_the_normal(rng):
    """A CT that rises by (3, -2, 1) HU/mm, on skewed voxels: |g . n| is exact, whatever the normal is."""
    T = np.eye(4)
    T[:3, :3] = exp_rotation([0.2, -0.1, 0.3]) @ np.diag([2.5, 3.0, 4.0])
    index = np.stack(np.meshgrid(*(np.arange(20.0),) * 3, indexing="ij"), axis=-1)
    slope = np.array([3.0, -2.0, 1.0]) / 4
    image = edge_image(apply(T, index.reshape(-1, 3)).reshape(20, 20, 20, 3) @ slope, T)
    points = apply(T, rng.uniform(6, 13, (50, 3)))
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(image.strength(points, normals), np.abs(normals @ slope), atol=2e-3)
    assert np.isnan(image.strength(apply(T, np.array([[-1.0, 5, 5], [5, 5, 19.5]])), normals[:2])).all()


def test_a_fine_ct_is_averaged_in_place(rng):
    """Voxels of 0.7 x 0.7 x 1 mm become 1.4 x 1.4 x 2 mm, whose centres lie between those that were averaged."""
    hu = np.clip(rng.normal(0, 300, (8, 10, 6)), -2000, 2000).astype(np.int16)
    image = edge_image(hu, np.diag([0.7, 0.7, 1.0, 1.0]))
    np.testing.assert_allclose(image.T_ct_index @ [0, 0, 0, 1], [0.35, 0.35, 0.5, 1])
    np.testing.assert_allclose(np.diag(image.T_ct_index), [1.4, 1.4, 2.0, 1.0])
    assert image.values.shape == (4, 5, 3)
    blocks = np.clip(hu, -200, 400).reshape(4, 2, 5, 2, 3, 2).mean(axis=(1, 3, 5))
    assert abs(image.values.mean() - blocks.mean()) < 12.0  # smoothing keeps the mean but for the borders


def test_z_is_that_of_the_plain_sum_over_patches(trunk):
    _, image, sample = trunk
    T = np.eye(4)
    T[:3, 3] = (0.0, 9.0, 0.0)
    fit = compare(image, sample, [Placement("shift", T)]).fits[0]
    here, there = image.strength(sample.points_ct, sample.normals_ct), image.strength(*sample.placed(T))
    sums = []
    for patch in range(int(sample.patch.max()) + 1):
        rows = (sample.patch == patch) & np.isfinite(here) & np.isfinite(there)
        sums.append(float(np.sum(there[rows] - here[rows])))
    assert fit.z == pytest.approx(sum(sums) / np.sqrt(sum(one**2 for one in sums)), abs=1e-6)
    both = np.isfinite(here) & np.isfinite(there)
    assert fit.ratio == pytest.approx(there[both].sum() / here[both].sum(), abs=1e-6)


def test_normals_follow_a_scaled_and_mirrored_surface(trunk):
    """A placed surface is sampled with the normals of the placed triangles, to their sign."""
    patient, _, _ = trunk
    mesh = meshes_of(patient)["1"]
    T = np.diag([1.1, -0.9, 1.3, 1.0])
    each = [TriangleMesh(mesh.vertices, face[None]) for face in mesh.faces[::40]]
    sample = sample_surfaces(each, 500)
    _, normals = sample.placed(T)
    a, b, c = np.moveaxis(mesh.transformed(T).triangles[::40][sample.structure], 1, 0)
    wanted = np.cross(b - a, c - a)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(normals * wanted, axis=1)), 1.0, atol=1e-9)


def test_every_exchange_and_sign_of_axes_is_tried_once():
    """47 of the 48, about each point, which stays in place."""
    point = np.array([10.0, -20.0, 30.0])
    slips = list(axis_slips([point], exp_rotation([0.1, 0.2, 0.3])))
    assert len(slips) == 47
    assert len({tuple(np.round(one.T, 6).ravel()) for one in slips}) == 47
    for one in slips:
        np.testing.assert_allclose(one.T[:3, :3] @ one.T[:3, :3].T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(apply(one.T, point[None])[0], point, atol=1e-9)


def test_shifts_start_at_a_voxel_and_a_half_and_scales_keep_their_point():
    """Thick slices are tried from 15 mm, others from 6 mm."""
    lengths = [np.linalg.norm(one.T[:3, 3]) for one in shifts(np.eye(3), np.array([1.0, 3.0, 10.0]))]
    assert sorted(set(np.round(lengths, 6))) == [6.0, 12.0, 15.0, 24.0, 30.0, 48.0]
    for one in scalings([np.array([5.0, 6.0, 7.0])]):
        np.testing.assert_allclose(apply(one.T, np.array([[5.0, 6.0, 7.0]]))[0], (5.0, 6.0, 7.0))


def test_the_refined_place_is_the_true_one(trunk):
    """Surfaces that are 13 mm, 5 degrees and 4 % off are brought back to 1.5 mm (half a voxel)."""
    patient, image, _ = trunk
    T = np.eye(4)
    T[:3, :3] = exp_rotation(np.radians([3.0, -2.0, 3.5])) * 1.04
    T[:3, 3] = (6.0, -11.0, 4.0)
    sample = sample_surfaces([mesh.transformed(T) for mesh in meshes_of(patient).values()], 6000)
    start = np.eye(4)
    start[:3, 3] = (0.0, 12.0, 0.0)
    found = refined(image, sample, Placement("shift", start))
    errors = np.linalg.norm(apply(found.T @ T, sample.points_ct) - sample.points_ct, axis=1)
    assert np.sqrt(np.mean(errors**2)) < 1.5
    near = refined(image, sample, Placement("shift", np.eye(4)), most_mm=3.0)
    assert np.linalg.norm(apply(near.T, sample.points_ct) - sample.points_ct, axis=1).max() < 3.5
