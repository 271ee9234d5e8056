"""The fast checker: bounds that never exceed the distance, balls that enclose, and verdicts that are FCL's."""

import shutil
from functools import cache
from itertools import pairwise

import fcl
import numpy as np
import pytest
import scipy
import trimesh
from kept_checkers import built
from numba import typeof
from places import ROOT
from refusals import refused

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.collision.bodies import FINE_SIDES, arm_bodies, convex, prism, surface
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.kernels.hulls import TOUCHING, hull_gap
from puncture_twin.planning.collision.kernels.proofs import SKIN
from puncture_twin.planning.collision.kernels.surfaces import ROUGH, STACK, skin_gap, to_surface
from puncture_twin.planning.collision.packed import (
    TriangleTree,
    coarse_hull,
    finer_prism,
    halves,
    inscribed_prism,
    neighbours,
    sphere_tree,
)
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM, case_boxes, case_tool
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.triangle_distance import to_triangle
from puncture_twin.planning.reach.reach import assess_reach_all
from puncture_twin.planning.search.constraints import reach_request
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates

UR3 = ur_model("ur3")
TOOL = Tool(needle_length_mm=250.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
CLEAR = np.array([0.4, -1.9, 1.6, -1.2, -1.5, 0.3])
"""Elbow up, needle down."""


def points_within(corners, count, rng):
    """Random points of a convex hull, many of them on its edges and faces."""
    chosen = corners[rng.integers(len(corners), size=(count, 4))]
    weights = rng.dirichlet(np.full(4, 0.3), count)
    return np.einsum("ij,ijk->ik", weights, chosen)


@cache
def scene(kind, padding_mm=5.0):
    """A UR3 beside a lumpy patient on a table that is not square to the base, with a lamp above."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    lumps = 1.0 + 0.15 * np.sin(9.0 * ball.vertices[:, :1]) * np.cos(7.0 * ball.vertices[:, 1:2])
    patient = TriangleMesh(ball.vertices * lumps * [160.0, 260.0, 110.0] + [380.0, 40.0, 60.0], np.asarray(ball.faces))
    lean = trimesh.transformations.rotation_matrix(0.3, [0.2, 0.1, 1.0])[:3, :3]
    table = Box("table", pose(lean, [400.0, 30.0, -140.0]), (600.0, 900.0, 60.0))
    boxes = [table, Box("lamp", pose(np.eye(3), [150.0, 250.0, 420.0]), (120.0, 80.0, 60.0))]
    return built(kind, UR3, TOOL, boxes, patient, padding_mm=padding_mm)


@pytest.mark.parametrize(
    ("name", "padding"), [("ur3", 0.0), ("ur3", 5.0), ("ur5", 5.0), ("ur10", 5.0), ("ur3e", 5.0), ("ur10e", 0.0)]
)
def test_leaf_balls_cover_every_body(name, padding):
    """Every corner and many points inside every padded piece lie in a leaf's ball, and in the root's."""
    rng = np.random.default_rng(0)
    for body in arm_bodies(ur_model(name), TOOL, padding):
        tree = sphere_tree(body.full.hulls)
        for corners in body.full.hulls:
            points = np.concatenate([corners, points_within(corners, 150, rng)])
            distances = scipy.spatial.distance.cdist(points, tree.centres) - tree.radii
            assert distances[:, tree.leaves].min(axis=1).max() <= 0.0, body.name
            assert distances[:, 0].max() <= 0.0


@pytest.mark.parametrize(("radius_mm", "length_mm"), [(85.0, 300.0), (30.0, 400.0), (65.0, 305.0), (150.0, 151.0)])
def test_leaf_balls_cover_a_stout_cylinder(radius_mm, length_mm):
    """No point of its prism is left out beside a cut, however Qhull turns the prism's faces."""
    rng = np.random.default_rng(0)
    corners = prism(radius_mm, length_mm)
    tree = sphere_tree([corners])
    points = points_within(corners, 20000, rng)
    distances = scipy.spatial.distance.cdist(points, tree.centres[tree.leaves]) - tree.radii[tree.leaves]
    assert distances.min(axis=1).max() <= 0.0


@pytest.mark.parametrize("name", ["ur3", "ur10e"])
def test_a_cut_crosses_every_edge_of_a_piece(name):
    """Both parts hold all points where edges of the hull cross the plane between them."""
    for body in arm_bodies(ur_model(name), TOOL, 5.0):
        for corners in body.full.hulls:
            axis = int(np.ptp(corners, axis=0).argmax())
            cut = (corners[:, axis].min() + corners[:, axis].max()) / 2.0
            below = corners[:, axis] < cut
            faces = scipy.spatial.ConvexHull(corners).simplices
            edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
            a, b = corners[edges[below[edges[:, 0]] != below[edges[:, 1]]].T]
            crossings = a + ((cut - a[:, axis]) / (b[:, axis] - a[:, axis]))[:, None] * (b - a)
            for part in halves(corners):
                assert scipy.spatial.KDTree(part).query(crossings)[0].max() < 1e-9


def test_every_ball_encloses_the_balls_parts_below_it():
    """A parent may answer for its children: what of the body only its own leaves cover lies in its ball too."""
    rng = np.random.default_rng(1)
    body = arm_bodies(UR3, TOOL, 5.0)[2]
    tree = sphere_tree(body.full.hulls)
    points = np.concatenate([points_within(corners, 3000, rng) for corners in body.full.hulls])
    inside = np.linalg.norm(points[:, None] - tree.centres, axis=2) <= tree.radii
    below: dict[int, set[int]] = {}
    for node in reversed(range(len(tree.radii))):
        left, right = tree.children[node]
        below[node] = {node} if left < 0 else below[int(left)] | below[int(right)]
    for node, leaves in below.items():
        others = np.setdiff1d(tree.leaves, list(leaves))
        own = inside[:, list(leaves)].any(axis=1) & ~inside[:, others].any(axis=1)
        assert inside[own, node].all()


def test_prisms_enclose_the_cylinder_and_the_inner_one_lies_in_it():
    """In every direction they reach at least as far as the round body, the finer one hardly more; the inner less."""
    u = np.random.default_rng(2).normal(size=(2000, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    around, along = np.hypot(u[:, 0], u[:, 1]), np.abs(u[:, 2])
    cylinder, coarse = 15.0 * around + 40.0 * along, prism(15.0, 80.0)
    fine = finer_prism(coarse)
    reach = (fine @ u.T).max(axis=0)
    assert ((coarse @ u.T).max(axis=0) >= cylinder).all() and fine.shape == (2 * FINE_SIDES, 3)
    assert (reach >= cylinder).all() and (reach <= cylinder * 1.0006 + 1e-4).all()
    cylinder = 5.6 * around + 80.0 * along
    reach = (inscribed_prism(prism(5.6, 160.0) + 7.0) @ u.T).max(axis=0) - 7.0 * u.sum(axis=1)
    assert (reach <= cylinder).all() and (reach >= 0.985 * cylinder).all()


@pytest.mark.parametrize("name", ["ur3", "ur5", "ur3e", "ur5e", "ur10e"])
def test_no_corner_stands_out_of_the_coarse_hull_by_more_than_its_slack(name):
    """In every direction the hull reaches no farther than the coarse one and its slack."""
    u = np.random.default_rng(3).normal(size=(3000, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    for body in arm_bodies(ur_model(name), TOOL, 5.0):
        for corners in (*body.bare.hulls, *body.full.hulls):
            coarse, slack_mm = coarse_hull(corners)
            beyond = (corners @ u.T).max(axis=0) - (coarse @ u.T).max(axis=0)
            assert beyond.max() <= slack_mm + 1e-9
            assert len(coarse) <= 60 and slack_mm < 12.0


@pytest.mark.parametrize("subdivisions", [0, 1, 4])
def test_distance_to_a_surface_is_the_least_over_its_triangles(subdivisions):
    """Whatever the number of triangles; where nothing is nearer than a cutoff, that; any distance where near enough.

    A rough one is never farther above it than it says.
    """
    rng = np.random.default_rng(5)
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=80.0)
    mesh = TriangleMesh(
        np.asarray(ball.vertices) * [1.0, 2.0, 0.5], np.asarray(ball.faces)[: -1 if subdivisions else 1]
    )
    tree = TriangleTree.of(mesh)
    assert {tuple(t.ravel()) for t in mesh.triangles} == {tuple(t.ravel()) for t in tree.corners.reshape(-1, 3, 3)}
    stack = np.empty(STACK, np.int64)
    for point in rng.uniform(-250, 250, (60, 3)):
        least = np.sqrt(min(to_triangle(t, *point) for t in mesh.triangles))
        assert to_surface(tree.lows, tree.highs, tree.corners, *point, 1e6, stack, 0.0, 1.0) == least
        assert to_surface(tree.lows, tree.highs, tree.corners, *point, least / 2.0, stack, 0.0, 1.0) == pytest.approx(
            least / 2.0
        )
        rough = to_surface(tree.lows, tree.highs, tree.corners, *point, 1e6, stack, 0.0, ROUGH)
        assert ROUGH * rough <= least <= rough
        near = to_surface(tree.lows, tree.highs, tree.corners, *point, 1e6, stack, 2.0 * least, 1.0)
        assert least <= near <= 2.0 * least
        assert to_surface(tree.lows, tree.highs, tree.corners, *point, 1e6, stack, 0.9 * least, 1.0) == least


def hull_shapes(checker):
    """Of each packed hull what FCL takes it for, as a function of nothing else, and its middle."""
    hulls = checker._proofs.scene.hulls
    shapes, middles = [], []
    for row, (begin, end) in enumerate(pairwise(hulls.starts)):
        corners = hulls.corners[begin:end]
        middles.append(corners.mean(axis=0))
        if hulls.rounded[row]:
            size = hulls.inner[begin:end] - middles[-1]
            shapes.append(fcl.Cylinder(float(np.hypot(size[:, 0], size[:, 1]).max()), float(np.ptp(size[:, 2]))))
        else:
            hull = trimesh.convex.convex_hull(corners)
            shapes.append(convex(TriangleMesh(hull.vertices, hull.faces)))
    return shapes, middles


def test_bounds_on_the_distance_of_two_hulls_hold_it():
    """Against FCL: no gap exceeds the distance, what surely touches does, and hardly anything is left open.

    Boxes, links and the prisms about holder and needle; for these FCL is asked about the cylinders.
    """
    checker, rng = scene(FastChecker), np.random.default_rng(6)
    hulls, (shapes, middles) = checker._proofs.scene.hulls, hull_shapes(checker)
    S, free, touching, left_open = np.empty((4, 3)), 0, 0, 0
    for trial in range(3000):
        i, j = rng.integers(len(shapes), size=2)
        i = i if trial % 3 else int(rng.choice(np.flatnonzero(hulls.rounded)))
        T = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))
        T[:3, 3] = middles[i] - T[:3, :3] @ middles[j] + rng.normal(size=3) * 60.0
        placed = [
            T if not hulls.rounded[j] else T @ pose(np.eye(3), middles[j]),
            pose(np.eye(3), middles[i] * hulls.rounded[i]),
        ]
        a, b = (
            fcl.CollisionObject(shapes[row], fcl.Transform(at[:3, :3], at[:3, 3]))
            for row, at in ((i, placed[1]), (j, placed[0]))
        )
        touches = fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()) > 0
        apart = 0.0 if touches else fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult())
        for needed in (1e-3, 25.0):
            gap = hull_gap(hulls, i, j, T[:3].copy(), np.zeros(3), np.zeros(2, np.int64), needed, S)
            assert gap <= apart + 1e-4
            assert touches or gap != TOUCHING
            left_open += needed < 1.0 and abs(gap) <= needed
        free, touching = free + (not touches), touching + touches
    assert min(free, touching) > 500 and left_open < 30, (free, touching, left_open)


def test_a_hull_is_climbed_to_its_outermost_corner():
    """From any corner, by neighbours alone, in any direction; corners within the hull have no neighbours."""
    rng = np.random.default_rng(9)
    for body in arm_bodies(UR3, TOOL, 5.0):
        for corners in body.full.hulls:
            degrees, rows = neighbours(corners)
            assert degrees.sum() == len(rows) and degrees.min() >= 3
            around = np.split(rows, np.cumsum(degrees)[:-1])
            for u in rng.normal(size=(20, 3)):
                at, along = int(rng.integers(len(corners))), corners @ u
                while along[around[at]].max() > along[at]:
                    at = int(around[at][np.argmax(along[around[at]])])
                assert along[at] == pytest.approx(along.max(), abs=1e-9)
    inside = np.vstack([prism(10.0, 20.0), np.zeros(3)])
    assert neighbours(inside)[0][-1] == 0


@pytest.fixture(scope="module")
def states():
    """Four thousand: anywhere, and in small steps away from where the needle is about to go in."""
    rng = np.random.default_rng(7)
    anywhere = rng.uniform(-np.pi, np.pi, (2000, 6))
    near = CLEAR + rng.normal(size=(2000, 6)) * rng.choice([0.02, 0.2, 0.6], (2000, 1))
    return np.concatenate([anywhere, near])


def test_thousands_of_verdicts_are_those_of_fcl(states):
    """The same contact or none at every state, the needle being allowed in or not; no state is falsely free.

    What the bounds alone call free is free to FCL, and they settle nearly all of the free states.
    """
    slow, fast = scene(CellChecker), scene(FastChecker)
    free = proven = 0
    met = set()
    for i, q in enumerate(states):
        may = bool(i % 2)
        verdict = slow.contact(q, needle_may_touch_patient=may)
        assert fast.contact(q, needle_may_touch_patient=may) == verdict, i
        open_checks = fast.open_checks(q, needle_may_touch_patient=may)
        assert verdict is None or verdict in open_checks
        free += verdict is None
        proven += not open_checks
        met.add(verdict)
    assert 800 < free < 3200 and proven >= 0.9 * free
    others = {verdict.other for verdict in met if verdict}
    assert {"patient", "table", "lamp", "base", "upper_arm"} <= others


def test_along_a_path_the_first_contact_is_the_one_that_asking_every_state_finds(states):
    """The same index and bodies on straight joint paths, long and short, clear and not."""
    slow, fast = scene(CellChecker), scene(FastChecker)
    free = [q for q in states[::10] if slow.contact(q, needle_may_touch_patient=False) is None]
    met = clear = 0
    for k in range(100):
        path = free[k] + np.linspace(0.0, 0.1 + 0.009 * k, 40)[:, None] * (free[-1 - k] - free[k])
        expected = slow.first_contact(path, needle_may_touch_patient=bool(k % 2))
        assert fast.first_contact(path, needle_may_touch_patient=bool(k % 2)) == expected
        met += expected is not None and expected.at > 0
        clear += expected is None
    assert met >= 15 and clear >= 15, (met, clear)


@pytest.mark.parametrize("padding", [0.0, 5.0])
def test_whatever_touches_along_a_path_is_left_open(padding):
    """Not only the first: every state of a path with each check that FCL finds a contact by there, in order."""
    fast, rng, touching = scene(FastChecker, padding), np.random.default_rng(11), 0
    tested = np.ones(len(fast._tested), np.bool_)
    for _ in range(15):
        begin, end = CLEAR + rng.normal(size=(2, 6)) * 0.5
        motion = fast.motion(np.linspace(begin, end, 40))
        left = list(fast._proofs.unproven(motion, tested))
        assert left == sorted(set(left))
        found = [
            (row, at)
            for row, frames in enumerate(motion.frames)
            for at, check in enumerate(fast._tested)
            if check.contact_at(frames) is not None
        ]
        assert set(found) <= set(left)
        touching += len(found)
    assert touching > 150


def test_the_bound_on_the_distance_to_the_skin_is_below_it():
    """Whether the field of distances proves enough or the surface is asked: FCL measures no less; often much more."""
    fast, rng = scene(FastChecker), np.random.default_rng(12)
    assert fast._surface is not None
    skin = fcl.CollisionObject(surface(fast._surface))
    packed, stacks = fast._proofs.scene, (np.empty(STACK, np.int64), np.empty(STACK, np.int64))
    rows = {check.contact.body: row for check, row in zip(fast._tested, packed.checks, strict=True) if row[0] == SKIN}
    by_field = near = 0
    for body in fast._bodies[1:]:
        for _ in range(60):
            T = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))
            T[:3, 3] = [380.0, 40.0, 60.0] + rng.normal(size=3) * 250.0
            gap = skin_gap(packed.skin, packed.spheres, rows[body.name][2], T, 12.0, 200.0, 1e-3, *stacks)
            T_body, mm = T @ body.T_frame_body, np.inf
            for solid in body.full.solids:
                solid.place(fcl.Transform(T_body[:3, :3], T_body[:3, 3]))
                mm = min(mm, fcl.distance(skin, solid.made, fcl.DistanceRequest(), fcl.DistanceResult()))
            assert gap <= max(mm, 1e-3) + 1e-6
            by_field += 12.0 < gap < 0.9 * mm - 5.0
            near += 1e-3 < gap < 12.0
    assert by_field > 50 and near > 5


def test_the_proof_holds_for_the_whole_stretch_that_is_skipped():
    """A wrist that turns in place skips nothing it should not: tiny steps end at the state where FCL ends."""
    slow, fast = scene(CellChecker, 0.0), scene(FastChecker, 0.0)
    for joint in range(6):
        path = np.tile(CLEAR, (500, 1))
        path[:, joint] += np.linspace(0.0, 3.0, 500)
        expected = slow.first_contact(path, needle_may_touch_patient=False)
        assert fast.first_contact(path, needle_may_touch_patient=False) == expected


def test_an_empty_room_and_a_needle_that_may_go_in():
    """Without patient or boxes only the arm itself counts; distances are those of the plain checker."""
    assert FastChecker(UR3, TOOL).contact(CLEAR, needle_may_touch_patient=False) is None
    slow, fast = scene(CellChecker), scene(FastChecker)
    assert fast.distances(CLEAR) == slow.distances(CLEAR)
    with refused("not_finite"):
        fast.contact(np.full(6, np.nan), needle_may_touch_patient=False)
    with refused("not_finite"):
        fast.first_contact(np.full((3, 6), np.inf), needle_may_touch_patient=False)


@pytest.fixture(scope="module")
def abdomen(tmp_path_factory):
    """The embedded abdomen at 10 degrees."""
    here = tmp_path_factory.mktemp("abdomen") / "case"
    shutil.copytree(ROOT / "meshes" / "abdomen", here)
    case = here / "case.toml"
    case.write_text(case.read_text().replace("step_deg = 2.0", "step_deg = 10.0"))
    return prepare(case)


def test_reach_answers_over_the_abdomen_are_those_of_fcl(abdomen):
    """Organ-safe directions: the same verdict, reason, depth, contact, branch, roll and motion."""
    case, anatomy, reach = abdomen.case, abdomen.anatomy, abdomen.reach
    assert reach is not None
    found = organ_candidates(case, anatomy, abdomen.engine, case.directions())
    requests = [reach_request(case, found, int(row), reach.T_base_ct) for row in np.flatnonzero(found.safe)]
    room = (case_tool(case), case_boxes(case, reach.T_base_ct), anatomy.skin.mesh.transformed(reach.T_base_ct))
    slow, fast = (built(kind, UR3, *room, padding_mm=ARM_PADDING_MM) for kind in (CellChecker, FastChecker))
    reports: list[tuple[int, int]] = []
    answers = assess_reach_all(fast, requests, lambda done, total: reports.append((done, total)))
    assert reports[-1] == (len(requests), len(requests)) and len(requests) > 100
    for asked, answer in list(zip(requests, answers, strict=True))[::2]:  # FCL alone takes its time
        assert_same(answer, assess_reach_all(slow, [asked])[0])
    reasons = {answer.reason.value for answer in answers}
    assert {"", "unreachable", "arm_collision", "insertion_blocked"} <= reasons


def assert_same(a, b):
    """Equal in everything."""
    for name in ("reachable", "reason", "depth_mm", "detail", "contact", "branch", "margin"):
        assert getattr(a, name) == getattr(b, name), name
    assert np.array_equal(a.roll, b.roll, equal_nan=True)
    assert np.array_equal(a.insertion_q, b.insertion_q) and np.array_equal(a.insertion_depth_mm, b.insertion_depth_mm)


def test_frames_of_a_path_and_of_its_states_agree():
    """What is judged along a path is what is judged state by state: the same frames to the last bit."""
    path = np.random.default_rng(8).uniform(-np.pi, np.pi, (50, 6))
    assert np.array_equal(link_poses(UR3, path), np.stack([link_poses(UR3, q) for q in path]))


def segments(rng, count):
    """Straight joint segments of 0.5 rad, half of them near where the needle points at the patient."""
    found = []
    for n in range(count):
        start = rng.uniform(-np.pi, np.pi, 6) if n % 2 else CLEAR + rng.uniform(-0.4, 0.4, 6)
        step = rng.normal(size=6)
        found.append(np.stack([start, start + 0.5 * step / np.linalg.norm(step)]))
    return found


@pytest.mark.parametrize("padding", [0.0, 5.0])
def test_segments_have_the_verdict_of_many_states(padding):
    """A segment that is called free has no contact at states 0.5 mm apart, but for grazes; one that is not has one."""
    slow, fast = scene(CellChecker, padding), scene(FastChecker, padding)
    verdicts = []
    for ends in segments(np.random.default_rng(4), 60):
        states = ends[0] + np.linspace(0.0, 1.0, 1 + int(2.0 * slow.sweep_mm(ends).max()))[:, None] * (
            ends[1] - ends[0]
        )
        met = fast.first_contact(states, needle_may_touch_patient=False)
        contact = fast.segment_checker()(*ends)
        if (contact is None) != (
            met is None
        ):  # only where the deepest of it is within the 1 mm that a state answers for
            thinner = scene(FastChecker, padding - 1.5) if padding else None
            assert contact is None and thinner is not None
            assert thinner.first_contact(states, needle_may_touch_patient=False) is None
        if contact is not None:
            assert any(slow.contact(q, needle_may_touch_patient=False) for q in states)
        verdicts.append(contact is None)
    assert 10 < sum(verdicts) < 50


def test_a_segment_keeps_the_clearance_of_its_ends():
    """What passes keeps 20 mm beyond the padding wherever its ends do, or most of what the nearer end keeps.

    Some of the free segments here do not: they pass something nearer than that.
    """
    fast, padding, clear = scene(FastChecker), 5.0, 20.0
    free, keeps = fast.segment_checker(), fast.segment_checker(clear)

    def nearest(q):
        return min(pair.mm for pair in fast.distances(q)) - padding

    passed, refused = 0, 0
    for start, end in segments(np.random.default_rng(21), 60):
        ends = np.stack([start, start + 4.0 * (end - start)])
        if free(*ends) is not None:
            assert keeps(*ends) is not None
            continue
        least = min(nearest(q) for q in ends[0] + np.linspace(0.0, 1.0, 60)[:, None] * (ends[1] - ends[0]))
        wanted = min(clear, *(0.8 * nearest(q) for q in ends))
        if keeps(*ends) is None:
            passed += 1
            assert least >= 0.9 * wanted - 1.5  # a bound is loose by up to a tenth; a prism is fuller than its needle
        else:
            refused += 1
    assert passed > 4 and refused > 0


def test_what_a_judge_remembers_changes_no_verdict():
    """Free or not is the same for a fresh judge and for one that has seen other segments; so is it the other way round.

    What a judge calls a contact without asking FCL is one: some state of the segment has it.
    """
    fast, slow = scene(FastChecker), scene(CellChecker)
    asked = segments(np.random.default_rng(11), 150)
    seasoned = fast.segment_checker()
    fresh = [fast.segment_checker()(*ends) for ends in asked]
    assert [seasoned(*ends) is None for ends in asked] == [contact is None for contact in fresh]
    again = [seasoned(*ends) for ends in reversed(asked)][::-1]
    assert [contact is None for contact in again] == [contact is None for contact in fresh]
    assert any(a != b for a, b in zip(again, fresh, strict=True))  # it does remember
    for ends, contact in zip(asked, again, strict=True):
        if contact is not None:
            states = ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])
            names = [check for check in slow._checks if check.contact == contact]
            met = (check.contact_at(poses) is not None for poses in link_poses(UR3, states) for check in names)
            assert any(met)


def test_the_end_of_a_segment_is_checked_as_it_is():
    """A segment's verdict at its end is that of the state, whether it is reached from near or from far."""
    fast, rng, verdicts = scene(FastChecker), np.random.default_rng(8), []
    judge = fast.segment_checker()
    for start, end in segments(rng, 120):
        if fast.contact(end, needle_may_touch_patient=False) is not None:
            assert judge(start, end) is not None and judge(end + 1e-4 * (start - end), end) is not None
            verdicts.append(False)
        else:
            verdicts.append(True)
    assert any(verdicts) and not all(verdicts)


def test_segments_of_no_length_and_no_number():
    """A segment that does not move is its state; angles that are no numbers are refused; a long one is judged whole."""
    fast, slow = scene(FastChecker), scene(CellChecker)
    for q in (CLEAR, CLEAR + np.array([0.0, 1.2, 0.0, 0.0, 0.0, 0.0])):
        verdict = slow.contact(q, needle_may_touch_patient=False)
        assert (fast.segment_checker()(q, q) is None) == (verdict is None)
    for spoiled in (np.full(6, np.nan), CLEAR * np.inf):
        with refused("not_finite"):
            fast.segment_checker()(CLEAR, spoiled)
        with refused("not_finite"):
            fast.segment_checker()(spoiled, CLEAR)
    assert fast.segment_checker()(CLEAR, CLEAR + np.array([2.0 * np.pi, 0, 0, 0, 0, 0])) is not None


def test_pieces_that_are_never_asked_about_never_touch():
    """Proven two joints apart: FCL's distance is above 0 at every one of many pairs of angles; some are left to ask."""
    slow, fast = CellChecker(UR3, TOOL), FastChecker(UR3, TOOL)
    asked = {id(check.first) ^ id(check.second) for check in fast._tested}
    never = [check for check in fast._checks if id(check.first) ^ id(check.second) not in asked]
    assert 5 < len(never) < len(fast._checks) - 20
    q = np.random.default_rng(5).uniform(-np.pi, np.pi, (400, 6))
    for poses in link_poses(UR3, q):
        for check in never:
            assert check.first_body is not None
            assert check.second_body.frame - check.first_body.frame == 2
            for item, body in ((check.first, check.first_body), (check.second, check.second_body)):
                item.place(body.pose(poses))
            assert fcl.distance(check.first.made, check.second.made, fcl.DistanceRequest(), fcl.DistanceResult()) > 0.0
    assert len(slow._checks) == len(fast._checks)


def test_a_checker_from_the_cache_is_the_same(tmp_path):
    """Enclosures are kept by the hash of what they enclose; read back they prove the same; a spoiled file is remade."""
    q = np.random.default_rng(6).uniform(-np.pi, np.pi, (60, 6))
    found = []
    for turn in range(3):
        checker = FastChecker(UR3, TOOL, padding_mm=5.0, cache=Cache(tmp_path))
        files = sorted(tmp_path.iterdir())
        assert files
        found.append([checker.open_checks(row, needle_may_touch_patient=False) for row in q])
        if turn == 1:
            for file in files:
                file.write_bytes(file.read_bytes()[:-200])
    assert found[0] == found[1] == found[2]
    other = Tool(needle_length_mm=250.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=31.0)
    FastChecker(UR3, other, padding_mm=5.0, cache=Cache(tmp_path))
    assert len(sorted(tmp_path.iterdir())) > len(files)


def test_a_checker_from_the_cache_is_no_other_kind_to_its_kernels(tmp_path):
    """Numba compiles for read-only arrays once more: the second command of a new machine waited for that."""
    ball = trimesh.creation.icosphere(2, 100.0)
    patient = TriangleMesh(np.asarray(ball.vertices) + [600.0, 0.0, 0.0], np.asarray(ball.faces))
    kinds = [
        typeof(FastChecker(UR3, TOOL, [], patient, padding_mm=5.0, cache=kept)._proofs.scene)
        for kept in (NO_CACHE, Cache(tmp_path), Cache(tmp_path))
    ]
    assert kinds[0] == kinds[1] == kinds[2]


def test_next_nearer_never_passes_a_nearer_state():
    """Every state that is passed over keeps its distance by FCL, padded checker or bare."""
    for padding in (0.0, 5.0):
        fast = scene(FastChecker, padding)
        states = CLEAR + np.linspace(0.0, 0.5, 40)[:, None] * np.array([0.5, 0.3, -0.4, 0.2, 0.1, 0.7])
        motion = fast.motion(states)
        for pair, body in (("patient", "forearm"), ("needle", "needle"), ("boxes", "holder")):
            mm = [fast.nearest(q, pair, body).mm for q in states]
            for wanted in (min(mm) - 1.0, float(np.median(mm))):
                at = fast.next_nearer(motion, 0, pair, body, wanted)
                assert min(mm[: at if at >= 0 else None], default=np.inf) > wanted
