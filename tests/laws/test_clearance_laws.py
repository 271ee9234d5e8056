"""What every clearance engine obeys, whatever is inside it: laws, each for every engine and every kind of scene."""

import numpy as np
import pytest
from oracles import PlainEngine, ray_crossings, segment_mesh_distance, units
from scipy.spatial.transform import Rotation

from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.clearance.engine import measure_clearances
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh

LENGTH = 150.0
TIGHT_MM = 1e-9
"""Far above rounding of float64 at a metre, far below any length that matters."""

ENGINES = [FastEngine, FclEngine, PlainEngine]


@pytest.fixture(params=ENGINES, ids=lambda kind: kind.__name__)
def engine(request):
    return request.param


@pytest.fixture
def judged(engine):
    """An engine that also says where along the axis; the plain one does not."""
    if engine is PlainEngine:
        pytest.skip("measures distances alone")
    return engine


def soup(rng, count, spread=50.0, size=15.0):
    """Triangles strewn about, no two joined."""
    corners = rng.normal(0, spread, (count, 1, 3)) + rng.normal(0, size, (count, 3, 3))
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def strips(rng, count):
    """Long thin triangles, as decimated surfaces have."""
    a, along = rng.normal(0, 40, (count, 3)), rng.normal(0, 40, (count, 3))
    corners = np.stack([a, a + along, a + along / 2 + rng.normal(0, 0.05, (count, 3))], axis=1)
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


@pytest.fixture(params=["ball", "box", "soup", "strips"])
def mesh(request, engine, rng, ball, box):
    """Round, flat and square, strewn, thin; of few triangles where each is visited."""
    plain = engine is PlainEngine
    count = 10 if plain else 80
    return {
        "ball": lambda: ball(20, (60, 10, 5), 0 if plain else 2),
        "box": lambda: box([30, 20, 10], (10, 50, 20)),
        "soup": lambda: soup(rng, count),
        "strips": lambda: strips(rng, count),
    }[request.param]()


def distances(engine, meshes, target, directions, length=LENGTH):
    """Shape (n, k)."""
    return engine(meshes).measure(np.asarray(target, float), directions, length).distance


def motions(rng):
    """Rotations and translations: none, hardly any, half turns, quarter turns, any."""
    angles = (0.0, 1e-9, 1e-3, np.pi / 2, np.pi, 2.7)
    axes = [*np.eye(3), *units(rng, 3)]
    for angle, axis in zip(angles, axes, strict=True):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        T[:3, 3] = rng.uniform(-300, 300, 3) * (angle > 0)
        yield T


def test_it_is_the_least_over_all_triangles(engine, mesh, rng):
    """The definition: what comes out triangle by triangle, from the textbook's cases."""
    target, directions = np.array([1.0, 2.0, 3.0]), units(rng, 6 if engine is PlainEngine else 60)
    expected = [segment_mesh_distance(target, target + LENGTH * u, mesh) for u in directions]
    np.testing.assert_allclose(distances(engine, [mesh], target, directions)[:, 0], expected, atol=TIGHT_MM, rtol=0)


def test_a_rigid_motion_changes_nothing(engine, mesh, rng):
    """Body, target and needle moved together."""
    target, directions = rng.normal(0, 10, 3), units(rng, 8)
    still = distances(engine, [mesh], target, directions)
    for T in motions(rng):
        moved = distances(engine, [mesh.transformed(T)], T[:3, :3] @ target + T[:3, 3], directions @ T[:3, :3].T)
        np.testing.assert_allclose(moved, still, atol=TIGHT_MM)


def test_a_mirror_changes_nothing(engine, mesh, rng):
    """Distances know neither left nor right, though triangles are wound the other way then."""
    target, directions, mirror = rng.normal(0, 10, 3), units(rng, 8), np.array([-1.0, 1.0, 1.0])
    mirrored = TriangleMesh(mesh.vertices * mirror, mesh.faces)
    np.testing.assert_allclose(
        distances(engine, [mirrored], target * mirror, directions * mirror),
        distances(engine, [mesh], target, directions),
        atol=TIGHT_MM,
    )


@pytest.mark.parametrize("factor", [0.01, 0.5, 2.0, 20.0])
def test_another_unit_changes_the_unit_alone(engine, mesh, rng, factor):
    """Everything longer by a factor: distances too."""
    target, directions = rng.normal(0, 10, 3), units(rng, 8)
    scaled = TriangleMesh(mesh.vertices * factor, mesh.faces)
    found = distances(engine, [scaled], target * factor, directions, LENGTH * factor) / factor
    tight = TIGHT_MM * max(1.0, 1.0 / factor)  # what is absolute in an engine counts for more in a small scene
    np.testing.assert_allclose(found, distances(engine, [mesh], target, directions), atol=tight)


def test_orders_are_irrelevant(engine, mesh, ball, rng):
    """Of structures, triangles, their corners, and directions: each answer stays with its own."""
    target, directions = rng.normal(0, 10, 3), units(rng, 4 if engine is PlainEngine else 450)
    meshes = [mesh, ball(10, (0, 40, 0), 0), soup(rng, 6)]
    plain = distances(engine, meshes, target, directions)
    np.testing.assert_array_equal(distances(engine, meshes[::-1], target, directions), plain[:, ::-1])
    shuffle, faces = rng.permutation(len(directions)), rng.permutation(len(mesh.faces))
    np.testing.assert_allclose(distances(engine, meshes, target, directions[shuffle]), plain[shuffle], atol=1e-12)
    rolled = TriangleMesh(mesh.vertices, np.roll(mesh.faces[faces], 1, axis=1)[:, ::-1])
    np.testing.assert_allclose(distances(engine, [rolled], target, directions), plain[:, :1], atol=TIGHT_MM)


def test_other_structures_have_no_say(engine, mesh, ball, rng):
    """What is measured alone is measured among many, near or far."""
    target, directions = rng.normal(0, 10, 3), units(rng, 10)
    among = distances(engine, [ball(5, (3, 0, 0), 0), mesh, ball(5, (9000, 0, 0), 0)], target, directions)
    np.testing.assert_array_equal(among[:, 1], distances(engine, [mesh], target, directions)[:, 0])


def test_added_triangles_only_bring_it_nearer(engine, mesh, rng):
    """A union is as near as the nearer part; the same triangles again, or cut in two, change nothing."""
    target, directions = rng.normal(0, 10, 3), units(rng, 15 if engine is PlainEngine else 200)
    more = soup(rng, 5)
    parts = distances(engine, [mesh, more], target, directions).min(axis=1)
    both = united(mesh, more)
    np.testing.assert_allclose(distances(engine, [both], target, directions)[:, 0], parts, atol=TIGHT_MM)
    one = distances(engine, [mesh], target, directions)
    for same in (united(mesh, mesh), halved(mesh)):
        np.testing.assert_allclose(distances(engine, [same], target, directions), one, atol=TIGHT_MM)


def united(one, other):
    """Two surfaces as one, unwelded."""
    corners = np.concatenate([one.triangles, other.triangles]).reshape(-1, 3)
    return TriangleMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def halved(mesh):
    """Each triangle cut in two at the middle of an edge."""
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    middle = (a + b) / 2
    corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)]).reshape(-1, 3)
    return TriangleMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def test_a_longer_needle_is_no_farther(engine, mesh, rng):
    """Its axis contains the shorter one's; and it comes nearer by no more than it is longer."""
    target, directions = rng.normal(0, 10, 3), units(rng, 10)
    lengths = (0.0, 1.0, 30.0, 90.0, 150.0, 400.0)
    found = np.hstack([distances(engine, [mesh], target, directions, length) for length in lengths])
    shorter = -np.diff(found, axis=1)
    assert (shorter >= -TIGHT_MM).all()
    assert (shorter <= np.diff(lengths) + TIGHT_MM).all()


def test_it_changes_by_no_more_than_the_needle_moves(engine, mesh, rng):
    """A shift by s changes no distance by more than s; a rotation by no more than its top moves."""
    target, directions = rng.normal(0, 10, 3), units(rng, 10)
    before = distances(engine, [mesh], target, directions)
    for step in (1e-6, 0.1, 5.0, 40.0):
        shifted = distances(engine, [mesh], target + step * units(rng, 1)[0], directions)
        assert (np.abs(shifted - before) <= step + TIGHT_MM).all()
        turned = directions + step / LENGTH * units(rng, 10)
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        moved = LENGTH * np.linalg.norm(turned - directions, axis=1)[:, None]
        assert (np.abs(distances(engine, [mesh], target, turned) - before) <= moved + TIGHT_MM).all()


def test_beside_a_wall_and_a_point_it_is_known(engine, rng):
    """A plane at x = 40: the nearer end's distance, none where the axis passes it; a triangle shrunk to one point."""
    wall = TriangleMesh([[40.0, -9e3, -9e3], [40, 9e3, -9e3], [40, 0, 2e4]], [[0, 1, 2]])
    point, directions = np.array([50.0, 20.0, -10.0]), units(rng, 60)
    along = np.clip(directions @ point, 0.0, LENGTH)
    expected = np.maximum(0.0, 40.0 - LENGTH * np.maximum(0.0, directions[:, 0]))
    expected = np.stack([expected, np.linalg.norm(point - along[:, None] * directions, axis=1)], axis=1)
    found = distances(engine, [wall, TriangleMesh(np.tile(point, (3, 1)), [[0, 1, 2]])], np.zeros(3), directions)
    np.testing.assert_allclose(found, expected, atol=TIGHT_MM)


def test_beside_a_sphere_it_is_known(engine, ball, rng):
    """The centre's distance less the radius, between that of the sphere about the triangles and the one within them."""
    centre, mesh = np.array([50.0, 30.0, 0.0]), ball(10.0, (50.0, 30.0, 0.0), 2)
    normals = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inner = np.abs(np.einsum("ij,ij->i", normals, mesh.triangles[:, 0] - centre)).min()
    directions = np.concatenate([units(rng, 4), np.eye(3)])
    along = np.clip(directions @ centre, 0.0, LENGTH)
    away = np.linalg.norm(centre - along[:, None] * directions, axis=1)
    found = distances(engine, [mesh], np.zeros(3), directions)[:, 0]
    assert (found >= np.maximum(0.0, away - 10.0) - TIGHT_MM).all()
    assert (found <= np.maximum(0.0, away - inner) + TIGHT_MM).all()
    assert inner > 9.7


def test_symmetric_scenes_have_symmetric_answers(engine, box):
    """A cube about the target's line: all directions that its symmetries exchange are as far."""
    cube, target = box([20.0, 20.0, 20.0], (0, 0, 0)), np.array([0.0, 0.0, 70.0])
    angle = np.radians([12.0, 78.0, 102.0, 168.0, 192.0, 258.0, 282.0, 348.0])
    for tilt in np.radians([20.0, 100.0, 160.0, 175.0]):
        directions = np.stack(
            [np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.full(8, np.cos(tilt))], axis=1
        )
        found = distances(engine, [cube], target, directions)
        np.testing.assert_allclose(found, found[0, 0], atol=TIGHT_MM)


def test_it_says_where(judged, mesh, rng):
    """The axis point at the depth is as far from the surface as the axis; on a hit it is the first crossing."""
    target, directions = np.array([1.0, 2.0, 3.0]), np.concatenate([units(rng, 10), aimed(rng, mesh, 50)])
    found = judged([mesh]).measure(target, directions, LENGTH)
    assert ((found.depth >= 0) & (found.depth <= LENGTH + TIGHT_MM)).all()
    for u, distance, depth in zip(directions, found.distance[:, 0], found.depth[:, 0], strict=True):
        point = target + depth * u
        assert segment_mesh_distance(point, point, mesh) == pytest.approx(distance, abs=1e-6)
        if distance == 0:
            assert depth == pytest.approx(ray_crossings(target, u, mesh)[0], abs=TIGHT_MM)


def aimed(rng, mesh, count):
    """Directions from (1, 2, 3) toward the surface."""
    toward = mesh.triangles[rng.integers(len(mesh.faces), size=count)].mean(axis=1) - np.array([1.0, 2.0, 3.0])
    return toward / np.linalg.norm(toward, axis=1, keepdims=True)


def verdicts(engine, mesh, target, directions, *, radius=0.6, margin=0.0):
    """Clearance and violation, structure by structure, as the search has them."""
    structures = (Structure("organ", Role.AVOID, margin, mesh, "test"),)
    return measure_clearances(
        engine([mesh]), structures, np.asarray(target, float), directions, length=LENGTH, radius=radius
    )


def test_thicker_needles_and_wider_margins_never_free(judged, mesh, rng):
    """The clearance falls by the radius, and what is violated stays so."""
    directions, before = units(rng, 40), np.zeros((40, 1), bool)
    thin = verdicts(judged, mesh, np.zeros(3), directions, radius=0.0).clearance
    for radius, margin in ((0.3, 0.0), (0.6, 0.0), (0.6, 4.0), (3.0, 4.0), (3.0, 20.0)):
        found = verdicts(judged, mesh, np.zeros(3), directions, radius=radius, margin=margin)
        np.testing.assert_allclose(found.clearance, thin - radius, atol=TIGHT_MM)
        assert (found.violated >= before).all()
        before = found.violated
    assert before.any()


@pytest.mark.parametrize("wound", ["outward", "inward", "at random"])
def test_inside_a_closed_surface_there_is_no_clearance(judged, ball, rng, wound):
    """Surfaces are far away, and the needle is in the organ all the same, however its triangles are wound."""
    mesh = ball(400, subdivisions=2)
    flip = {"outward": 0.0, "inward": 1.0, "at random": 0.33}[wound] > rng.random((len(mesh.faces), 1))
    wound_so = TriangleMesh(mesh.vertices, np.where(flip, mesh.faces[:, ::-1], mesh.faces))
    found = verdicts(judged, wound_so, [3.0, 5.0, 7.0], units(rng, 20))
    np.testing.assert_array_equal(found.clearance, -0.6)
    assert found.violated.all()


def test_far_from_a_tie_the_capsule_has_the_same_verdict(judged, mesh, rng):
    """FCL's capsule collides where the distance falls short of its radius, over every direction and radius."""
    directions, checker = units(rng, 150), judged([mesh])
    found = checker.measure(np.zeros(3), directions, LENGTH).distance[:, 0]
    for radius in (0.5, 3.0, 12.0):
        clear = np.abs(found - radius) > 1e-4
        said = np.array([checker.collides(0, np.zeros(3), u, LENGTH, radius) for u in directions])
        np.testing.assert_array_equal(said[clear], (found < radius)[clear])
