"""The refined chance to touch: closed forms where the shape has one, draws of displaced needles where it has not."""

import numpy as np
import pytest
import trimesh
from oracles import measure_displaced
from scipy.special import ndtr, stdtr

from puncture_twin.planning.clearance.engine import normals_of
from puncture_twin.planning.clearance.fast_engine import FastEngine, near_faces
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.planning.uncertainty import lines as module
from puncture_twin.planning.uncertainty.hit import proximity, touch_chance
from puncture_twin.planning.uncertainty.lines import Needles, refined

LENGTH, RADIUS = 150.0, 0.6
UP = np.array([0.0, 0.0, 1.0])
SHIFT = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
LEAN = np.diag([0.5, 0.8, 1.2, 0.006**2, 0.009**2, 0.01**2])


def moved(mesh, *at):
    mesh.apply_translation(at or (0, 0, 0))
    return TriangleMesh(mesh.vertices, mesh.faces)


def box(*sizes):
    return trimesh.creation.box(extents=sizes)


def chances(mesh, cov, surface=0.0, freedom=None):
    engine = FastEngine([mesh])
    axes = engine.measure(np.zeros(3), UP[None], LENGTH)
    normal = normals_of(engine.triangles, np.zeros(3), UP[None], axes)
    near = proximity(axes.distance, axes.depth, normal, UP[None], cov[None], surface)
    first = touch_chance(near, RADIUS, freedom)
    around = engine.blocks, np.full((1, 1), LENGTH), np.zeros(3)
    needles = Needles(UP[None], cov[None], near, np.full((1, 1), surface), freedom)
    found = refined(*around, needles, np.array([RADIUS]), first, np.ones((1, 1), bool))
    return first[0, 0], found[0, 0]


def displaced(cov, count):
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(6), cov, count, method="eigh")
    return errors[:, :3], exp_rotation(errors[:, 3:]) @ UP


@pytest.mark.parametrize(("surface", "freedom"), [(0.0, None), (0.7, None), (0.0, 3), (0.7, 6)])
def test_first_order_stays_where_it_is_exact(surface, freedom):
    for distance in (1.5, 3.0, 4.5):
        first, found = chances(moved(box(40.0, 4000.0, 4000.0), distance + 20.0, 0, 0), SHIFT, surface, freedom)
        t = -(distance - RADIUS) / np.hypot(1.0, surface)
        assert first == pytest.approx(ndtr(t) if freedom is None else stdtr(freedom, t), rel=1e-6)
        assert first - 0.0015 < found < first + (0.0015 if surface == 0.0 else 0.03)


@pytest.mark.parametrize("distance", [1.5, 3.5])
def test_both_sides_of_a_gap_count(distance):
    plates = trimesh.util.concatenate(
        [box(1.0, 4000.0, 4000.0).apply_translation([side * (distance + 0.5), 0, 0]) for side in (1, -1)]
    )
    first, found = chances(moved(plates), SHIFT)
    one = ndtr(-(distance - RADIUS))
    assert first == pytest.approx(one, rel=1e-6)
    assert found == pytest.approx(2 * one, abs=0.003)


def tube_of(inner, thick=5.0):
    """A tube around the needle; of 128 sides: its flats are nearer by .001 mm at most, its chance by .0003 of .01."""
    return moved(trimesh.creation.annulus(r_min=inner, r_max=inner + thick, height=4000.0, sections=128))


@pytest.mark.parametrize("inner", [1.6, 4.6])
def test_a_tube_around_the_needle_has_a_closed_form(inner):
    """P of a two-dimensional normal to leave a circle, exp(-d^2 / 2): the worst case of first order."""
    first, found = chances(tube_of(inner), SHIFT)
    exact = np.exp(-((inner - RADIUS) ** 2) / 2)
    assert first < exact < 13 * first
    assert found == pytest.approx(exact, abs=0.01)


def test_a_thin_wire_is_left_again():
    wire = moved(trimesh.creation.cylinder(radius=0.2, height=4000.0, sections=24), 0, 0, 0)
    wire = moved(trimesh.Trimesh(wire.vertices[:, [0, 2, 1]], wire.faces), 2.5, 0, 60.0)
    wide = np.diag([4.0, 1.0, 1.0, 0, 0, 0])
    first, found = chances(wire, wide)
    exact = ndtr((2.5 + 0.8) / 2) - ndtr((2.5 - 0.8) / 2)
    assert first > 1.3 * exact
    assert found == pytest.approx(exact, abs=0.003)


SHAPES = {
    "ball": lambda: moved(trimesh.creation.icosphere(4, 12.0), 14.0, 0, 60),
    "tip alone": lambda: moved(trimesh.creation.icosphere(3, 3.0), 1.0, 0.5, -4.5),
    "behind": lambda: moved(box(20.0, 20.0, 5.0), 0, 0, -4.5),
    "convex top beside the tip": lambda: moved(trimesh.creation.cylinder(radius=3.0, height=20.0), 4.5, 1.0, -9.0),
    "far along the shaft": lambda: moved(trimesh.creation.icosphere(3, 6.0), 8.5, 0, 140),
    "beyond the end": lambda: moved(trimesh.creation.icosphere(3, 6.0), 2.0, 0, 157),
}


@pytest.mark.parametrize(("shape", "size"), list(zip(SHAPES, (1, 2, 2, 1, 2, 1), strict=True)))
def test_draws_agree(shape, size):
    mesh, cov = SHAPES[shape](), size**2 * LEAN
    origins, outward = displaced(cov, 50_000)  # the draws' own deviation: .0022 at most
    faces = near_faces(FastEngine([mesh]).blocks[0], np.zeros(3), UP, LENGTH, (15.0, 30.0))
    realised = np.mean(faces.distance(origins, outward, LENGTH) < RADIUS)
    assert chances(mesh, cov)[1] == pytest.approx(realised, abs=0.006)


def test_the_nearest_face_is_not_always_the_likeliest():
    near, far = box(40.0, 4000.0, 4000.0), box(4000.0, 40.0, 4000.0)
    near.apply_translation([22.0, 0, 0])
    far.apply_translation([0, 23.0, 0])
    plates = moved(trimesh.util.concatenate([near, far]))
    cov = np.diag([0.01, 4.0, 0.01, 0, 0, 0])
    first, found = chances(plates, cov)
    exact = ndtr(-(3.0 - RADIUS) / 2.0)
    assert first < 1e-9 < 0.1 < exact
    assert found == pytest.approx(exact, abs=0.003)


@pytest.mark.parametrize("half", [0.4, 1.0, 1.65])
def test_the_narrow_side_of_a_wall_is_as_wide_as_it_is(half):
    """By quadrature: few lines, all sqrt(3) deviations out, took a side of 1.65 for one of two thirds of its chance."""
    y = np.linspace(-half - RADIUS, half + RADIUS, 20_001)
    short = np.sqrt(np.maximum(RADIUS**2 - np.maximum(np.abs(y) - half, 0.0) ** 2, 0.0))
    for distance in (1.0, 2.0, 3.0):
        exact = np.trapezoid(np.exp(-(y**2) / 2) / np.sqrt(2 * np.pi) * ndtr(short - RADIUS - distance), y)
        wall = moved(box(40.0, 2 * half, 4000.0), distance + RADIUS + 20.0, 0, 0)
        assert chances(wall, SHIFT)[1] == pytest.approx(exact, rel=0.05, abs=2e-4)


@pytest.mark.parametrize("freedom", [3, 5, 9, 30])
def test_an_unknown_size_is_integrated_out_in_body_and_tail(freedom):
    """P of Student's t in two dimensions to leave a circle, (1 + d^2 / nu)^(-nu / 2), in a tube that nothing leaves."""
    for distance in (2.0, 4.0, 6.0, 8.0):
        found = chances(tube_of(distance + RADIUS, thick=1000.0), SHIFT, freedom=freedom)[1]
        exact = (1 + distance**2 / freedom) ** (-freedom / 2)
        assert found == pytest.approx(exact, abs=max(0.08 * exact, 3e-4))


@pytest.mark.parametrize("surface", [False, True])
@pytest.mark.parametrize("freedom", [3, 5, 9, 30])
def test_the_lines_of_an_unknown_size_have_students_t_together(surface, freedom):
    """The law of the scale along a line: averaged over the lines a plane is passed as often as Student's t says."""
    for count in module.MANY_LINES:
        lines = module.many_lines(surface, count, freedom)
        for distance in (0.5, 1.0, 2.0, 4.0, 8.0):
            passed = lines.weights @ stdtr(lines.degrees, -distance / lines.scales)
            assert passed == pytest.approx(stdtr(freedom, -distance), rel=0.01, abs=2e-4)
        assert lines.weights.sum() == pytest.approx(1.0)


def test_more_lines_continue_the_fewer():
    for freedom in (None, 3):
        fewer, *more = (module.many_lines(True, count, freedom) for count in module.MANY_LINES)
        for lines in more:
            np.testing.assert_array_equal(lines.offsets[: len(fewer.offsets)], fewer.offsets)
            np.testing.assert_array_equal(lines.farthest[: len(fewer.offsets)], fewer.farthest)


@pytest.mark.parametrize("kind", [FastEngine, FclEngine])
def test_near_faces_answer_as_the_engine_does(rng, kind):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=25.0)
    mesh.vertices = mesh.vertices * rng.normal(1, 0.05, (len(mesh.vertices), 1))
    surface = moved(mesh, 30.0, 5.0, 70.0)
    origins, outward = displaced(4 * LEAN, 300)
    reach = (5.0, 12.0)
    quick = near_faces(kind([surface]).blocks[0], np.zeros(3), UP, LENGTH, reach).distance(origins, outward, LENGTH)
    whole = measure_displaced(FastEngine([surface]), origins, outward, LENGTH)[:, 0]
    shift = np.linalg.norm(origins, axis=1) + LENGTH * np.linalg.norm(outward - UP, axis=1)
    sure = whole + shift < min(reach)
    assert sure.any() or (whole < 3).any()
    np.testing.assert_allclose(quick[sure], whole[sure], atol=1e-9)
    assert (quick >= whole - 1e-9).all()


def test_threads_change_no_bit(monkeypatch):
    rng, count = np.random.default_rng(1), 24
    outward = UP + rng.normal(scale=0.1, size=(count, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    engine = FastEngine([moved(box(40.0, 30.0, 50.0), 23.0, 0, 60.0), tube_of(4.0)])
    axes = engine.measure(np.zeros(3), outward, LENGTH)
    normal = normals_of(engine.triangles, np.zeros(3), outward, axes)
    near = proximity(axes.distance, axes.depth, normal, outward, np.tile(LEAN, (count, 1, 1)), 0.0)
    shape = axes.distance.shape
    answers = []
    for threads in (1, 8):
        monkeypatch.setattr(module, "MOST_THREADS", threads)
        monkeypatch.setattr("puncture_twin.planning.base.processes.worker_count", lambda wanted, _: wanted)
        for draws in (module.many_lines, module.few_lines):
            draws.cache_clear()  # so that threads make them side by side
        needles = Needles(outward, np.tile(LEAN, (count, 1, 1)), near, np.zeros(shape), 6)
        first, around = touch_chance(near, RADIUS, 6), (engine.blocks, np.full(shape, LENGTH), np.zeros(3))
        answers.append(refined(*around, needles, np.full(shape[1], RADIUS), first, np.ones(shape, bool)))
    assert (np.isfinite(answers[0]) & (answers[0] != first)).any(axis=1).sum() > count / 2
    assert answers[0].tobytes() == answers[1].tobytes()
