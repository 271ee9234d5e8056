"""The fast engine judged by FCL: verdicts of capsules, on anatomy, anywhere, and within a hair of the threshold."""

import fcl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st
from oracles import segment_mesh_distance, units
from places import DATA

from puncture_twin import meshes
from puncture_twin.planning.clearance.engine import NEAR_THRESHOLD_MM, ROUNDING_MM, AxisDistances, too_near
from puncture_twin.planning.clearance.fast_engine import PIECE_TRIANGLES, WORTH_THREADS, FastEngine, bundle
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh

LENGTH = 210.0
RADII_MM = (0.5, 3.0, 5.5)
HUBMAP = DATA / "hubmap_vh_male"


@pytest.fixture(scope="module")
def abdomen():
    """Surfaces of the embedded phantom, in the vicinity of the lesion."""
    names = ("liver", "ribs_right", "portal_vein", "hepatic_veins", "colon", "vena_cava_inferior", "lung_right", "skin")
    loaded = [trimesh.load(meshes.folder() / f"abdomen/{name}.ply", process=False) for name in names]
    return [TriangleMesh(mesh.vertices, mesh.faces) for mesh in loaded]


class CountingJudge(FastEngine):
    """A fast engine that counts how often it asks FCL."""

    asked = 0

    def collides(self, structure, target_ct, outward_ct, length, radius):
        """FCL's word, counted."""
        self.asked += 1
        return super().collides(structure, target_ct, outward_ct, length, radius)


def verdicts_of(engine, target, directions, distance, radius):
    """The planner's verdicts at one radius for every structure, shape (n, k)."""
    columns = enumerate(distance.T)
    return np.stack(
        [too_near(engine, column, target, directions, LENGTH, axes, radius) for column, axes in columns], axis=1
    )


def equal_fcl(surfaces, target, directions, radii=RADII_MM):
    """Verdicts and distances against FCL for every direction, structure and radius; the distances."""
    engine, judge = FastEngine(surfaces), FclEngine(surfaces)
    found: AxisDistances = engine.measure(target, directions, LENGTH)
    for radius in radii:
        verdicts = verdicts_of(engine, target, directions, found.distance, radius)
        for column in range(len(surfaces)):
            rated = [judge.collides(column, target, u, LENGTH, radius) for u in directions]
            np.testing.assert_array_equal(verdicts[:, column], rated)
    expected = judge.measure(target, directions, LENGTH)
    np.testing.assert_allclose(found.distance, expected.distance, atol=1e-6)
    return found


@pytest.mark.parametrize("place", ["lesion", "inside", "vertex", "outside"])
def test_verdicts_on_the_abdomen_are_fcls(rng, abdomen, place):
    """In the lesion, inside another organ, on a vertex and outside the body: no verdict differs."""
    detections = {"lesion": np.array([-90.0, -10, 60]), "inside": abdomen[4].bounds.mean(axis=0)}
    detections |= {"vertex": abdomen[0].vertices[1234], "outside": np.array([-230.0, -150, 80])}
    found = equal_fcl(abdomen, detections[place], units(rng, 40))
    if place == "vertex":
        np.testing.assert_array_equal(found.distance[:, 0], 0)


@pytest.mark.skipif(not HUBMAP.is_dir(), reason="the Visible Human organs (hubmap_vh_male) are not on this machine")
def test_verdicts_on_open_many_part_organs_are_fcls(rng):
    """Organs of the Visible Human, the heart's zero-area triangles among them: no verdict differs."""
    surfaces = []
    for name in ("VH_M_Heart", "VH_M_Liver", "VH_M_Pancreas"):
        loaded = trimesh.load(HUBMAP / f"{name}.glb", force="mesh", process=False)
        surfaces.append(TriangleMesh(np.asarray(loaded.vertices) * 1000.0, np.asarray(loaded.faces)))
    a, b, c = np.moveaxis(surfaces[0].triangles, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert (areas < 1e-9).any()
    for target in (surfaces[0].bounds.mean(axis=0), surfaces[1].bounds.mean(axis=0)):
        equal_fcl(surfaces, target, units(rng, 20), radii=(3.0,))


def test_within_a_hair_of_the_threshold_fcl_decides(rng, abdomen):
    """With the radius at the exact distance ± 1e-3 ... 1e-7 mm FCL is asked where the distance does not decide.

    What is nearer than the radius is too near whatever FCL says, which does not see an overlap below 1e-6 mm.
    """
    surfaces, target = abdomen[1:4], np.array([-90.0, -10, 60])
    engine, judge, directions = CountingJudge(surfaces), FclEngine(surfaces), units(rng, 12)
    exact = engine.measure(target, directions, LENGTH).distance
    cases = 0
    for row, column in np.argwhere(exact > 0.1):
        for offset in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 0.0):
            for sign in (-1, 1):
                radius, before = exact[row, column] + sign * offset, engine.asked
                axis, nearer = directions[row : row + 1], exact[row, column] < radius - ROUNDING_MM
                verdict = too_near(engine, column, target, axis, LENGTH, exact[row : row + 1, column], radius)[0]
                assert verdict == (nearer or judge.collides(column, target, directions[row], LENGTH, radius))
                if offset != 1e-4:  # there, rounding says on which side of the limit it lies
                    assert engine.asked - before == (offset < 1e-4 and not nearer)
                cases += 1
    assert cases > 200


def test_an_engine_in_which_everything_is_a_tie_asks_fcl_every_time(ball):
    """Behind the target all axes are equally far: with that distance as threshold each verdict is FCL's own."""
    mesh, directions = ball(10, (-50, 0, 0), 2), np.array([[1.0, 0, 0], [0.8, 0.6, 0], [0.8, -0.6, 0], [0.8, 0, 0.6]])
    engine = CountingJudge([mesh])
    distances = engine.measure(np.zeros(3), directions, LENGTH).distance
    distance = float(distances[0, 0])
    verdicts = verdicts_of(engine, np.zeros(3), directions, distances, distance)
    judge = FclEngine([mesh])
    assert engine.asked == len(directions)
    assert verdicts[:, 0].tolist() == [judge.collides(0, np.zeros(3), u, LENGTH, distance) for u in directions]


def test_fcl_says_of_the_near_triangles_what_it_says_of_the_whole_surface(abdomen):
    """At and about every axis' distance, where FCL alone decides: the whole tree's word, of a few triangles."""
    rng = np.random.default_rng(11)
    target, directions = np.array([-85.0, -15.0, 30.0]), units(rng, 16)
    engine, whole = FastEngine(abdomen), FclEngine(abdomen)
    found = engine.measure(target, directions, LENGTH).distance
    off = (-NEAR_THRESHOLD_MM, -2e-6, -1e-6, -1e-9, 0.0, 1e-9, 1e-6, 2e-6, NEAR_THRESHOLD_MM)
    said = []
    for row, column in np.argwhere((found > 0) & (found < 60)):
        for radius in found[row, column] + np.array(off):
            asked = (int(column), target, directions[row], LENGTH, float(radius))
            said.append(engine.collides(*asked))
            assert said[-1] == whole.collides(*asked)
    assert 0.3 < np.mean(said) < 0.7
    assert len(said) > 500


@pytest.mark.parametrize("threads", [2, 5])
def test_any_number_of_threads_gives_the_same_bytes(abdomen, threads):
    """Distances, depths, nearest triangles and counts; every structure is searched by itself."""
    target, directions = np.array([-85.0, -15.0, 30.0]), units(np.random.default_rng(3), 5000)
    one, many = FastEngine(abdomen, threads=1), FastEngine(abdomen, threads=threads)
    first, second = one.measure(target, directions, LENGTH), many.measure(target, directions, LENGTH)
    for name in ("distance", "depth", "nearest"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    assert one.counts.tolist() == many.counts.tolist()
    assert len(abdomen) * len(directions) >= WORTH_THREADS


def test_fcl_trees_are_built_when_first_asked(ball, monkeypatch):
    """Preparing and measuring build no FCL tree; a verdict's tie does."""
    built = []
    monkeypatch.setattr(fcl, "BVHModel", lambda: built.append(1) or (_ for _ in ()).throw(RuntimeError("a tree")))
    engine = FastEngine([ball(10, (50, 0, 0), 1)])
    engine.measure(np.zeros(3), np.eye(3), LENGTH)
    assert not built
    with pytest.raises(RuntimeError, match="a tree"):
        engine.collides(0, np.zeros(3), np.eye(3)[0], LENGTH, 1.0)


def small_surface(rng, closed):
    """A dented ball of 80 triangles, or 20 triangles strewn about."""
    if closed:
        ball = trimesh.creation.icosphere(subdivisions=0, radius=1.0).subdivide()
        dents = rng.uniform(0.7, 1.3, (len(ball.vertices), 1))
        return TriangleMesh(rng.normal(0, 30, 3) + 25 * dents * ball.vertices, ball.faces)
    corners = rng.normal(0, 40, (20, 1, 3)) + rng.normal(0, 8, (20, 3, 3))
    return TriangleMesh(corners.reshape(-1, 3), np.arange(60).reshape(-1, 3))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    closed=st.booleans(),
    place=st.sampled_from(["vertex", "edge", "face", "plane", "amid", "outside", "far"]),
    length=st.sampled_from([1.0, 40.0, LENGTH]),
    radius=st.sampled_from(RADII_MM),
)
def test_verdicts_and_distances_hold_for_any_small_surface_and_target(seed, closed, place, length, radius):
    """Whatever the surface, the target and the needle: FCL's verdict and brute force's distance."""
    rng = np.random.default_rng(seed)
    mesh = small_surface(rng, closed)
    a, b, c = mesh.triangles[rng.integers(len(mesh.faces))]
    share, middle = rng.uniform(0, 1), mesh.vertices.mean(axis=0)
    detections = {"vertex": a, "edge": share * a + (1 - share) * b, "face": (a + b + c) / 3, "plane": 4 * a - 2 * b - c}
    detections |= {"amid": middle, "outside": middle + [90.0, 20, 0], "far": middle - [0, 700.0, 300]}
    target, directions = np.array(detections[place]), units(rng, 16)
    toward = middle - target + rng.normal(0, 20, (8, 3))
    directions[:8] = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    engine, judge = FastEngine([mesh]), FclEngine([mesh])
    exact = engine.measure(target, directions, length).distance[:, 0]
    expected = [segment_mesh_distance(target, target + length * u, mesh) for u in directions]
    np.testing.assert_allclose(exact, expected, atol=1e-9, rtol=0)
    rated = [judge.collides(0, target, u, length, radius) for u in directions]
    assert too_near(engine, 0, target, directions, length, exact, radius).tolist() == rated


def test_a_large_structure_is_searched_in_pieces_with_the_same_distances(ball):
    """Each direction belongs to one piece, and is answered as that piece's directions alone are."""
    target, directions = np.array([3.0, -2.0, 70.0]), units(np.random.default_rng(4), 12_000)
    surface = ball(30, (0, 0, 0), 6)
    assert len(surface.faces) >= 4 * PIECE_TRIANGLES
    engine = FastEngine([surface])
    whole = engine.measure(target, directions, LENGTH)
    pieces = bundle(directions).parts(1 + len(surface.faces) // PIECE_TRIANGLES)
    assert len(pieces) > 2
    assert sorted(np.concatenate([piece.order for piece in pieces])) == list(range(len(directions)))
    for piece in pieces:
        alone = engine.measure(target, directions[piece.order], LENGTH)
        np.testing.assert_array_equal(piece.outward, directions[piece.order])
        assert whole.distance[piece.order].tobytes() == alone.distance.tobytes()
        assert whole.depth[piece.order].tobytes() == alone.depth.tobytes()
