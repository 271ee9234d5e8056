"""The chance to hit: against closed forms, and against a million draws."""

import numpy as np
import pytest
import trimesh
from scipy.special import chdtr, fdtr, ndtr, stdtr
from scipy.stats import chi2

from puncture_twin.planning.clearance.engine import normals_of
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.planning.search.chances import joint_touch_chance
from puncture_twin.planning.uncertainty.hit import (
    chance_within,
    hit_in_ball,
    hit_in_mesh,
    mean_over_faces,
    proximity,
    rays_to_ball,
    student_within,
    target_rays,
    touch_chance,
)

DRAWS = np.random.default_rng(3).normal(size=(1_000_000, 3))

DEVIATIONS = [(1.0, 1.0, 1.0), (1.0, 1.7, 0.5), (1.0, 10.0, 1.0), (10.0, 10.0, 1.0)]


def covariance(deviations, seed=0):
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return axes @ np.diag(np.square(deviations)) @ axes.T, axes


@pytest.mark.parametrize("deviations", DEVIATIONS)
@pytest.mark.parametrize("radius", [0.3, 2.5, 8.0])
def test_within_a_radius_as_a_million_draws_say(deviations, radius):
    found = hit_in_ball(covariance(deviations)[0][None], radius)[0]
    assert found == pytest.approx(np.mean(np.sum((DRAWS * deviations) ** 2, axis=1) < radius**2), abs=0.0015)


def test_equal_axes_are_a_chi_squared():
    """P(s |z| < a) to 1e-7; and two equal axes beside one that is nearly none are a Rayleigh distribution."""
    radii = np.array([[0.1, 0.7, 2.0, 5.0]])
    np.testing.assert_allclose(chance_within(np.full((1, 3), 4.0), radii)[0], chdtr(3, radii[0] ** 2 / 4), atol=1e-7)
    flat = chance_within(np.array([[1e-3, 1.0, 1.0]]), radii)[0]
    np.testing.assert_allclose(flat, 1 - np.exp(-(radii[0] ** 2) / 2), atol=1e-3)


def test_the_chance_grows_with_the_radius_and_is_never_above_one():
    radii = np.linspace(0, 200, 400)[None]
    for high in (1.0, 5.0, 30.0):
        found = chance_within(np.array([[1.0, 2.0, high**2]]), radii)[0]
        assert found[0] == 0
        assert np.all(np.diff(found) > -1e-7)
        assert 1 - 1e-6 < found[-1] <= 1


def test_a_size_that_is_all_but_known_gives_the_chance_of_a_known_one(ball):
    rays = target_rays(ball(8.0), np.array([3.0, 0.0, 0.0]))
    covs = np.array([covariance(size * np.array([1.0, 2.0, 3.0]))[0] for size in np.geomspace(0.1, 50.0, 20)])
    np.testing.assert_allclose(hit_in_mesh(rays, covs), hit_in_mesh(rays, covs, 10**7), atol=5e-6)


@pytest.mark.parametrize("deviations", DEVIATIONS)
@pytest.mark.parametrize("off", [0.0, 8.0, 12.0])
def test_within_a_ball_of_triangles_from_inside_on_its_face_and_outside(ball, deviations, off):
    deviations = 3 * np.array(deviations)
    cov, axes = covariance(deviations, seed=1)
    found = hit_in_mesh(target_rays(ball(8.0, subdivisions=4), np.array([off, 0.0, 0.0])), cov[None])[0]
    tips = (DRAWS * deviations) @ axes.T + [off, 0, 0]
    assert found == pytest.approx(np.mean(np.sum(tips**2, axis=1) < 64), abs=0.004)


@pytest.mark.parametrize(("surface", "off"), [(1.0, 0.0), (1.0, 6.0), (2.5, 8.0), (5.0, 0.0)])
def test_a_surface_that_lies_off_as_a_whole_makes_the_ball_larger_or_smaller(ball, surface, off):
    """By a normal number; a ball that is less than nothing is never hit."""
    cov, axes = covariance((2.0, 1.0, 1.5), seed=3)
    rays = target_rays(ball(8.0, subdivisions=4), np.array([off, 0.0, 0.0]))
    tips = (DRAWS * [2.0, 1.0, 1.5]) @ axes.T + [off, 0, 0]
    radius = 8.0 + surface * np.random.default_rng(4).normal(size=len(tips))
    truth = np.mean(np.linalg.norm(tips, axis=1) < radius)
    assert hit_in_mesh(rays, cov[None], surface_mm=surface)[0] == pytest.approx(truth, abs=0.02)


def test_the_mean_over_faces_is_that_of_the_directions_that_they_face(ball, box):
    S = np.diag([0.04, 0.09, 2.0])
    assert mean_over_faces(box((1000.0, 1000.0, 1e-3)), S) == pytest.approx(np.sqrt(2.0), rel=1e-3)
    assert mean_over_faces(ball(1.0), S) == pytest.approx(np.sqrt(2.13 / 3), rel=1e-3)


@pytest.mark.parametrize("deviations", DEVIATIONS)
@pytest.mark.parametrize("off", [0.0, 2.0, 5.0])
def test_within_a_radius_of_a_target_beside_which_the_tip_is_believed(deviations, off):
    """A known offset beside the covariance: to .004 of a million draws; without one it is Ruben's series."""
    cov, axes = covariance(deviations, seed=2)
    offset = off * np.array([0.6, 0.0, 0.8])
    found = hit_in_mesh(rays_to_ball(offset, 2.0), cov[None])[0]
    tips = (DRAWS * deviations) @ axes.T + offset
    assert found == pytest.approx(np.mean(np.sum(tips**2, axis=1) < 4), abs=0.004)
    if off == 0:
        assert found == pytest.approx(hit_in_ball(cov[None], 2.0)[0], abs=0.004)


def test_a_target_on_a_flat_face_is_hit_half_of_the_time_at_most(box):
    rays = target_rays(box([50.0, 50.0, 50.0]), np.array([25.0, 0.0, 0.0]))
    assert hit_in_mesh(rays, np.eye(3)[None])[0] == pytest.approx(0.5, abs=0.002)


def test_an_error_whose_size_was_estimated_follows_fishers_f(ball):
    cov, _ = covariance((1.0, 2.0, 0.7))
    size = np.sqrt(3 / np.random.default_rng(5).chisquare(3, len(DRAWS)))
    drawn = np.sum((DRAWS * [1.0, 2.0, 0.7] * size[:, None]) ** 2, axis=1) < 4
    assert hit_in_ball(cov[None], 2.0, 3)[0] == pytest.approx(drawn.mean(), abs=0.002)
    rays = target_rays(ball(2.0, subdivisions=4), np.zeros(3))
    assert hit_in_mesh(rays, cov[None], 3)[0] == pytest.approx(drawn.mean(), abs=0.006)


@pytest.mark.parametrize("freedom", [1, 2, 3, 5, 9, 30])
def test_within_a_radius_by_an_error_of_unknown_size(freedom):
    """Equal axes are Fisher's F; of others the mean of the series over chi-squared, by quadrature."""
    for radius in (0.3, 1.0, 3.0, 10.0, 80.0):
        assert hit_in_ball(4 * np.eye(3)[None], radius, freedom)[0] == pytest.approx(
            fdtr(3, freedom, radius**2 / 12), abs=1e-9
        )
        values, size = np.array([[0.3, 1.0, 9.0]]), np.linspace(-12.0, 6.0, 4001)  # logarithm of chi-squared
        density = np.exp(size) * chi2.pdf(np.exp(size), freedom)
        within = chance_within(values, radius * np.sqrt(np.exp(size) / freedom)[None])[0]
        averaged = np.trapezoid(within * density, size)
        missing = chdtr(freedom, np.exp(-12.0))  # of sizes larger than any there
        found = hit_in_ball(np.diag(values[0])[None], radius, freedom)[0]
        assert averaged - 1e-6 <= found <= averaged + missing + 1e-6


def test_students_t_of_whole_degrees():
    t = np.linspace(-40.0, 40.0, 321)
    for freedom in (1, 2, 3, 4, 7, 8, 35, 300):
        found = [student_within(x, freedom) for x in t]
        np.testing.assert_allclose(found, 2 * stdtr(freedom, t) - 1, atol=1e-13)


def test_no_error_hits_for_certain_and_outside_never(ball):
    for off, chance in ((0.0, 1.0), (3.0, 0.0)):
        assert hit_in_mesh(target_rays(ball(2.0, subdivisions=2), np.array([off, 0, 0])), np.zeros((1, 3, 3)))[
            0
        ] == pytest.approx(chance)
    assert hit_in_ball(np.zeros((1, 3, 3)), 0.5)[0] == pytest.approx(1.0)


LENGTH, RADIUS = 150.0, 0.6
UP = np.array([0.0, 0.0, 1.0])


def scene(*meshes):
    return [TriangleMesh(mesh.vertices, mesh.faces) for mesh in meshes]


def slab(x):
    box = trimesh.creation.box(extents=[40.0, 4000.0, 4000.0])
    box.apply_translation([x + 20.0, 0, 0])
    return box


def ball(radius, at):
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    mesh.apply_translation(at)
    return mesh


def near(meshes, cov, surface=0.0):
    engine = FastEngine(meshes)
    axes = engine.measure(np.zeros(3), UP[None], LENGTH)
    normal = normals_of(engine.triangles, np.zeros(3), UP[None], axes)
    return proximity(axes.distance, axes.depth, normal, UP[None], cov[None], surface)


def drawn(meshes, cov, count, threshold, seed=0):
    rng, engine = np.random.default_rng(seed), FastEngine(meshes)
    errors = rng.multivariate_normal(np.zeros(6), cov, count, method="eigh")
    met = np.empty((count, len(meshes)), bool)
    for row, error in enumerate(errors):
        outward = exp_rotation(error[3:]) @ UP
        met[row] = engine.measure(error[:3], outward[None], LENGTH).distance[0] < threshold
    return met.mean(axis=0), met.any(axis=1).mean()


def test_closed_forms_of_a_half_space_and_a_ball():
    cov = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    found = touch_chance(near(scene(slab(3.0)), cov), RADIUS)[0, 0]
    assert found == pytest.approx(ndtr(-(3.0 - RADIUS)), rel=1e-9)
    wider = touch_chance(near(scene(slab(3.0)), cov, surface=2.0), RADIUS)[0, 0]
    assert wider == pytest.approx(ndtr(-(3.0 - RADIUS) / np.sqrt(5.0)), rel=1e-9)
    s, phi = 0.4, 0.01
    cov = np.diag([s**2, 9.0, 9.0, phi**2, phi**2, 0.0])
    found = near(scene(ball(5.0, [8.0, 0.0, 100.0])), cov)
    assert found.deviation[0, 0] == pytest.approx(np.hypot(s, 100.0 * phi), rel=1e-3)
    assert found.distance[0, 0] == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize("distance", [1.5, 3.0])
def test_a_round_organ_is_near_what_draws_say(distance):
    cov = np.diag([1.0, 1.0, 0.5, 0.005**2, 0.005**2, 0.0])
    meshes = scene(ball(12.0, [12.0 + distance, 0.0, 60.0]))
    found = touch_chance(near(meshes, cov), RADIUS)[0, 0]
    realised = drawn(meshes, cov, 4000, RADIUS)[0][0]
    assert -0.015 < found - realised < 0.03


def test_any_is_below_the_sum_and_near_the_draws():
    cov = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    left = slab(2.0)
    left.apply_transform(np.diag([-1.0, 1, 1, 1]))
    left.invert()
    both = near(scene(slab(2.0), left), cov)
    twice = near(scene(slab(2.0), slab(2.0)), cov)
    one = ndtr(-(2.0 - RADIUS))
    assert joint_touch_chance(both, cov[None], RADIUS)[0] == pytest.approx(2 * one, abs=0.02)
    assert joint_touch_chance(twice, cov[None], RADIUS)[0] == pytest.approx(one, abs=0.02)
    assert touch_chance(twice, RADIUS).sum() == pytest.approx(2 * one)
    cov, surface = np.diag([0.25, 0.25, 0.25, 0.0, 0.0, 0.0]), 1.0
    twice = near(scene(slab(2.0), slab(2.0)), cov, surface=surface)
    rng = np.random.default_rng(8)
    shift, off = rng.normal(0.0, 0.5, 200_000), rng.normal(0.0, surface, (200_000, 2))
    truth = np.mean((shift[:, None] + off > 2.0 - RADIUS).any(axis=1))
    assert joint_touch_chance(twice, cov[None], RADIUS, surface_mm=surface)[0] == pytest.approx(truth, abs=0.02)


def test_no_error_touches_for_certain_or_never_and_an_estimated_size_more_often():
    nothing = np.zeros((6, 6))
    clear = near(scene(slab(3.0), ball(5.0, [0.0, 0.0, 80.0])), nothing)
    assert touch_chance(clear, RADIUS)[0, 0] == 0.0
    assert touch_chance(clear, 4.0)[0, 0] == 1.0
    assert np.isnan(touch_chance(clear, RADIUS)[0, 1])
    cov = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    found = near(scene(slab(4.0)), cov)
    assert touch_chance(found, RADIUS, 3)[0, 0] > 10 * touch_chance(found, RADIUS)[0, 0]


def test_both_engines_say_from_where_an_axis_is_nearest(rng):
    meshes = []
    for _ in range(4):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=rng.uniform(5, 30))
        mesh.vertices = mesh.vertices * rng.normal(1, 0.1, (len(mesh.vertices), 1)) + rng.uniform(-80, 80, 3)
        meshes += scene(mesh)
    outward = rng.normal(size=(200, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    fast, fcl = (kind(meshes) for kind in (FastEngine, FclEngine))
    axes = fast.measure(np.zeros(3), outward, LENGTH)
    normals = normals_of(fast.triangles, np.zeros(3), outward, axes)
    np.testing.assert_allclose(
        normals, normals_of(fcl.triangles, np.zeros(3), outward, fcl.measure(np.zeros(3), outward, LENGTH)), atol=1e-9
    )
    assert np.isnan(normals).any(axis=2).sum() == (axes.distance == 0).sum() > 0
    for column, mesh in enumerate(meshes):
        for row in np.flatnonzero(axes.distance[:, column] > 0)[::4]:
            point = outward[row] * axes.depth[row, column]
            away = point - trimesh.triangles.closest_point(mesh.vertices[mesh.faces], [point] * len(mesh.faces))
            away = away[np.linalg.norm(away, axis=1).argmin()]
            np.testing.assert_allclose(normals[row, column] * axes.distance[row, column], away, atol=1e-9)
    engine = FastEngine(scene(ball(10.0, [30.0, 0.0, 40.0]), slab(25.0)))
    outward = rng.normal(size=(60, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    axes, rows = engine.measure(np.zeros(3), outward, LENGTH), rng.permutation(60)[:17]
    every = normals_of(engine.triangles, np.zeros(3), outward, axes)
    np.testing.assert_array_equal(normals_of(engine.triangles, np.zeros(3), outward[rows], axes.at(rows)), every[rows])


@pytest.mark.parametrize("kind", [FastEngine, FclEngine])
def test_of_two_points_as_near_either_is_named(kind):
    """Midway between two faces of one structure the normal is that of one of them."""
    left, right = slab(2.0), slab(2.0)
    left.apply_transform(np.diag([-1.0, 1, 1, 1]))
    left.invert()
    engine = kind(scene(left + right))
    axes = engine.measure(np.zeros(3), UP[None], LENGTH)
    normal = normals_of(engine.triangles, np.zeros(3), UP[None], axes)[0, 0]
    assert axes.distance[0, 0] == pytest.approx(2.0)
    np.testing.assert_allclose(np.abs(normal), [1.0, 0.0, 0.0], atol=1e-12)
