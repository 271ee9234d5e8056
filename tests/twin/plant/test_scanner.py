"""The scanner against what can be computed otherwise: volumes, boxes at fractions of a voxel, dense sampling."""

import itertools

import numpy as np
import pytest
import trimesh
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.meshes.mesh_files import read_mesh
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose
from puncture_twin.planning.geometry.spaces import Space, Unit
from puncture_twin.twin.plant.scanner.case_scene import scan_frame
from puncture_twin.twin.plant.scanner.coverage import cut_solids
from puncture_twin.twin.plant.scanner.image import (
    HIGHEST_HU,
    ScanSettings,
    Solid,
    ball,
    box,
    check_closed,
    rod,
    scan_solids,
)

STILL = ScanSettings(noise_hu=0.0, blur_mm=1e-3)


def cut(meshes, shape, fills=None, labels=None, spacing=(1.0, 1.0, 1.0), empty=0.0):
    corners = np.concatenate([mesh.triangles for mesh in meshes])
    owners = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    fills = np.ones(len(meshes)) if fills is None else np.array(fills, dtype=float)
    labels = np.arange(1, len(meshes) + 1, dtype=np.uint8) if labels is None else np.array(labels, np.uint8)
    return cut_solids(corners, owners, fills, labels[None], shape, spacing_mm=np.array(spacing), empty=empty)


def grid(shape, spacing=1.0, low=0.0):
    T = np.diag([spacing, spacing, spacing, 1.0])
    T[:3, 3] = low
    return VolumeGrid(shape, T, {})


def turned_box(centre, size, w):
    """A box, and the function that says which points lie in it."""
    T = pose(exp_rotation(np.array(w)), np.array(centre))
    half = np.array(size) / 2

    def holds(points):
        return np.all(np.abs(apply(np.linalg.inv(T), points)) < half, axis=-1)

    return box(np.zeros(3), np.array(size)).transformed(T), holds


def test_overlapping_solids_agree_with_dense_sampling():
    """Three turned boxes that fill each other's place: the mean over each voxel is that of 16^3 points in it."""
    shape, steps = (7, 6, 5), 16
    made = [
        turned_box((3.0, 2.6, 2.1), (4.0, 3.0, 2.5), (0.3, 0.5, -0.2)),
        turned_box((2.2, 3.0, 2.4), (2.0, 3.3, 1.7), (-0.7, 0.1, 0.4)),
        turned_box((4.1, 2.2, 1.8), (1.2, 1.9, 3.0), (0.2, -0.9, 1.1)),
    ]
    fills = (100.0, -50.0, 700.0)
    found = cut([mesh for mesh, _ in made], shape, fills, spacing=(1.0, 2.0, 2.0), empty=-1000.0)
    offsets = (np.arange(steps) + 0.5) / steps - 0.5
    within = np.array(list(itertools.product(offsets, repeat=3)))
    points = np.indices(shape).reshape(3, -1).T[:, None] + within
    values = np.full(points.shape[:2], -1000.0)
    labels = np.zeros(points.shape[0], int)
    for number, ((_, holds), fill) in enumerate(zip(made, fills, strict=True), start=1):
        values[holds(points)] = fill
        labels[holds(np.indices(shape).reshape(3, -1).T)] = number
    wanted = values.mean(axis=1).reshape(shape)
    assert np.abs(found.values - wanted).max() < 0.03 * 1700
    assert np.abs(found.values - wanted).mean() < 0.003 * 1700
    assert np.array_equal(found.labels[0], labels.reshape(shape))


@pytest.mark.parametrize("low", [(0.0, 0.0, 0.0), (0.5, 0.5, 0.5), (0.25, 1.0, 0.125)])
def test_a_box_along_the_rows_is_exact(low):
    """Also where its corners and edges lie on lines and planes of the grid: nothing leaks, along x to the last bit."""
    low = np.array(low)
    mesh = box(low + [1.5, 2.0, 1.0], np.array([3.0, 4.0, 2.0]))
    found = cut([mesh], (6, 8, 6)).values
    edges = np.arange(7) - 0.5
    along = np.clip(np.minimum(edges[1:], low[0] + 3.0) - np.maximum(edges[:-1], low[0]), 0.0, 1.0)
    full = found[:, int(low[1]) + 2, int(low[2]) + 1]
    assert np.allclose(full, along, atol=1e-6)
    assert found.sum() == pytest.approx(24.0, rel=0.06)
    assert set(np.unique(found[:, 7]).tolist()) == {0.0}


def test_the_way_a_surface_is_wound_does_not_matter():
    """Turned inside out, and in two pieces that overlap, a solid is what it is."""
    one = ball(np.array([4.0, 4.0, 4.0]), 5.0)
    out = TriangleMesh(one.vertices, one.faces[:, ::-1])
    both = joined([one, one.transformed(pose(np.eye(3), [0.7, 0.0, 0.0]))])
    plain = cut([one], (9, 9, 9)).values
    assert np.array_equal(cut([out], (9, 9, 9)).values, plain)
    apart = cut([one, one.transformed(pose(np.eye(3), [0.7, 0.0, 0.0]))], (9, 9, 9)).values
    assert np.allclose(cut([both], (9, 9, 9)).values, apart, atol=1e-6)


def test_a_hollow_is_empty():
    """A ball with an inner surface that is wound the other way: a shell."""
    outer, inner = ball(np.full(3, 5.0), 8.0), ball(np.full(3, 5.0), 4.0)
    shell = joined([outer, TriangleMesh(inner.vertices, inner.faces[:, ::-1])])
    found = cut([shell], (11, 11, 11)).values
    assert found[5, 5, 5] == 0.0 and found[5, 5, 2] == 1.0
    assert found.sum() == pytest.approx(4 / 3 * np.pi * (4**3 - 2**3), rel=0.01)


def test_the_liver_has_its_volume():
    """To 1e-4, at slices of 5 mm too."""
    mesh = read_mesh(folder() / "abdomen" / "liver.ply", unit=Unit.MM, space=Space.LPS)
    corners = mesh.triangles
    wanted = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    spacing = np.array([1.7, 1.7, 5.0])
    low, high = mesh.bounds
    shape = tuple(int(n) for n in np.ceil((high - low) / spacing) + 2)
    T = np.diag([*spacing, 1.0])
    T[:3, 3] = low - 0.3
    inside = mesh.transformed(np.linalg.inv(T))
    found = cut([inside], shape, spacing=spacing).values.sum(dtype=float) * spacing.prod()
    assert found == pytest.approx(wanted, rel=1e-4)


def test_metal_is_clipped_and_air_is_air():
    """A voxel wholly of metal has what 12 bits hold; noise is as stated, blur keeps the sum."""
    metal = Solid("metal", box(np.full(3, 10.0), np.full(3, 6.0)), 8000.0)
    image = scan_solids([metal], grid((20, 20, 20)), STILL, np.random.default_rng(0))
    assert image.hu.max() == HIGHEST_HU and image.hu[0, 0, 0] == -1000
    water = Solid("water", box(np.full(3, 10.0), np.full(3, 6.0)), 0.0)
    bath = Solid("bath", box(np.full(3, 10.0), np.full(3, 60.0)), 0.0)
    noisy = scan_solids([bath], grid((20, 20, 20)), ScanSettings(noise_hu=15.0), np.random.default_rng(1))
    assert np.std(noisy.hu) == pytest.approx(15.0, rel=0.03)
    soft = scan_solids([water], grid((20, 20, 20)), ScanSettings(noise_hu=0.0), np.random.default_rng(0))
    sharp = scan_solids([water], grid((20, 20, 20)), STILL, np.random.default_rng(0))
    assert np.sum(soft.hu + 1000.0) == pytest.approx(np.sum(sharp.hu + 1000.0), rel=2e-3)


def test_the_same_seed_gives_the_same_scan():
    """And another seed another noise."""
    solids = [Solid("rod", rod(np.full(3, 3.0), np.full(3, 9.0), 3.0), 40.0)]
    first, again, other = (
        scan_solids(solids, grid((12, 12, 12)), ScanSettings(), np.random.default_rng(seed)).hu for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_an_open_surface_is_refused():
    """What fills it is not known."""
    whole = box(np.zeros(3), np.ones(3))
    with refused("open_mesh"):
        check_closed(Solid("bag", TriangleMesh(whole.vertices, whole.faces[:-1]), 0.0), "here")


def test_a_frame_of_its_own_is_laid_on_the_bed_by_a_rotation():
    """The carton's x runs along the bed and its z is up: determinant 1, where the first mapping in mind is a mirror."""
    R = scan_frame(load_case(folder() / "carton" / "case_m.toml"), 0.0)[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(R @ [1, 0, 0], [0, 0, 1]) and np.allclose(R @ [0, 0, 1], [0, -1, 0])
    assert np.allclose(scan_frame(load_case(folder() / "abdomen"), 0.0), np.eye(4))


@pytest.mark.parametrize("seed", range(3))
def test_no_part_of_a_whole_solid_is_far_from_its_label(seed):
    """A turned sheet, a rod and a ball, all thinner than a voxel: each point of them has their label within a diagonal.

    A ball as thick as the voxels keeps the label of the centres.
    """
    rng = np.random.default_rng(seed)
    sheet, _ = turned_box(rng.uniform(16, 18, 3), (18.0, 0.2, 14.0), rng.normal(size=3))
    middle, along = rng.uniform(12, 16, 3), rng.normal(size=3)
    thin = {"sheet": sheet, "rod": rod(middle, middle + 9 * along / np.linalg.norm(along), 0.3)}
    thin["ball"] = ball(rng.uniform(8, 24, 3), 0.6)
    solids = [Solid(name, mesh, 50.0, number, whole=True) for number, (name, mesh) in enumerate(thin.items(), start=1)]
    solids.append(Solid("organ", ball(np.array([25.0, 8.0, 20.0]), 9.0), 50.0, 4, whole=True))
    T = np.diag([1.0, 1.3, 2.0, 1.0])
    image = scan_solids(solids, VolumeGrid((34, 26, 17), T, {}), STILL, np.random.default_rng(0))
    bare = [solid._replace(whole=False) for solid in solids]
    plain = scan_solids(bare, VolumeGrid((34, 26, 17), T, {}), STILL, np.random.default_rng(0))
    for solid in solids[:3]:
        mesh = trimesh.Trimesh(solid.mesh.vertices, solid.mesh.faces)
        points = np.asarray(trimesh.sample.sample_surface(mesh, 2000, seed=seed)[0])
        voxel = np.diag(T)[:3]
        shown = np.argwhere(np.isin(image.labels[0], range(solid.label, 5))) * voxel  # what fills its place counts
        beyond = np.maximum(np.abs(points[:, None] - shown) - voxel / 2, 0.0)  # of each voxel's box
        assert np.linalg.norm(beyond, axis=2).min(axis=1).max() < np.linalg.norm(voxel)
    assert image.thin["sheet"] > 20 and "organ" not in image.thin
    np.testing.assert_array_equal(image.labels[0] == 4, plain.labels[0] == 4)
    np.testing.assert_array_equal(image.hu, plain.hu)
