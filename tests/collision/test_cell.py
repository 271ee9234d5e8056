"""What the arm may touch: scenes whose answer is known by geometry, and the links' own shipped meshes as oracle."""

from functools import partial
from itertools import combinations, pairwise

import fcl
import numpy as np
import pytest
import trimesh
from kept_checkers import built
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.arm.kinematics import flange_pose, link_poses
from puncture_twin.planning.arm.links import LINK_NAMES, collision_links, visual_links
from puncture_twin.planning.arm.tool import HOLDER_ROOT_MM, Box, Tool
from puncture_twin.planning.arm.ur import UR_MODELS, ur_model
from puncture_twin.planning.collision.bodies import (
    BODY_NAMES,
    NEVER_TESTED,
    PART_TRIANGLES,
    Contact,
    FclSkin,
    LooseParts,
    Solid,
    arm_bodies,
    convex,
    surface,
    touch,
)
from puncture_twin.planning.collision.checker import CellChecker, SweptBodies
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.containment import winding_number, winding_numbers
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose

UR3 = ur_model("ur3")
TOOL = Tool(needle_length_mm=250.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
WRIST_3_BEYOND_MM = 0.15
"""The shapes of the e-Series end a tenth of a millimetre beyond the flange, where the holder is bolted on."""

BENT = np.array([0.4, -1.9, 1.6, -1.2, -1.5, 0.3])
"""A clear pose: elbow up, needle down."""


def cuboid(low, high):
    """A closed box as a triangle mesh, mm."""
    box = trimesh.creation.box(extents=high - low)
    return TriangleMesh(np.asarray(box.vertices) + (low + high) / 2.0, np.asarray(box.faces))


def body_points(model, tool, q):
    """Every moving body's extreme points in the base frame, by kinematics alone, mm."""
    poses = link_poses(model, q)
    points = {
        link.name: link.mesh.vertices @ poses[link.frame][:3, :3].T + poses[link.frame][:3, 3]
        for link in collision_links(model)[1:]
    }
    turn = np.linspace(0.0, 2.0 * np.pi, 20_001)
    for name, radius, span in (
        ("holder", tool.holder_diameter_mm / 2.0, tool.holder_span_mm),
        ("needle", tool.needle_diameter_mm / 2.0, tool.needle_span_mm),
    ):
        ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        ends = np.concatenate([np.insert(ring, 2, z, axis=1) for z in span])
        points[name] = ends @ poses[6][:3, :3].T + poses[6][:3, 3]
    return points


def clear_poses(count, seed):
    """Random poses at which the arm does not touch itself."""
    rng, checker, found = np.random.default_rng(seed), CellChecker(UR3, TOOL), []
    while len(found) < count:
        q = rng.uniform(-np.pi, np.pi, 6)
        if checker.contact(q, needle_may_touch_patient=False) is None:
            found.append(q)
    return found


@pytest.mark.parametrize("kind", ["box", "patient"])
@pytest.mark.parametrize(("axis", "sign"), [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0)])
def test_a_wall_beyond_the_outermost_point_touches_from_there_on(kind, axis, sign):
    """A wall 0.01 mm beyond the arm's outermost point is free and measured so; 0.01 mm inside it touches that body."""
    tried = 0
    for q in clear_poses(8, seed=axis):
        points = body_points(UR3, TOOL, q)
        edges = {name: float((sign * cloud[:, axis]).max()) for name, cloud in points.items()}
        outermost = max(edges, key=lambda name: edges[name])
        edge = edges[outermost]
        if edge < 120.0:
            continue  # the wall would stand in the base
        tried += 1
        for gap in (0.01, -0.01):
            low, high = np.full(3, -1500.0), np.full(3, 1500.0)
            low[axis], high[axis] = sorted((sign * (edge + gap), sign * (edge + gap + 200.0)))
            if kind == "patient":
                checker = CellChecker(UR3, TOOL, patient=cuboid(low, high))
            else:
                checker = CellChecker(
                    UR3, TOOL, [Box("patient_wall", pose(np.eye(3), (low + high) / 2), tuple(high - low))]
                )
            contact = checker.contact(q, needle_may_touch_patient=False)
            if gap < 0.0:
                assert contact == Contact(outermost, "patient" if kind == "patient" else "patient_wall")
                continue
            assert contact is None
            distances = checker.distances(q)
            measured = min(distances.patient, distances.needle) if kind == "patient" else distances.boxes
            assert measured.mm == pytest.approx(gap, abs=1e-4) and measured.body == outermost
    assert tried >= 2


def test_padding_grows_the_arm_against_the_room_but_not_in_distances():
    """A wall between 4 mm and the padded 5 mm away touches the padded arm; both measure the true distance."""
    for q in clear_poses(6, seed=3):
        edge = max(float(cloud[:, 2].max()) for cloud in body_points(UR3, TOOL, q).values())
        roof = Box("roof", pose(np.eye(3), [0.0, 0.0, edge + 4.0 + 50.0]), (4000.0, 4000.0, 100.0))
        bare, full = (CellChecker(UR3, TOOL, [roof], padding_mm=padding) for padding in (0.0, 5.0))
        assert bare.contact(q, needle_may_touch_patient=False) is None
        assert full.contact(q, needle_may_touch_patient=False) is not None
        assert full.distances(q) == bare.distances(q)
        assert full.distances(q).boxes.mm == pytest.approx(4.0, abs=1e-4)


def test_a_box_inside_a_link_and_a_link_inside_a_box_both_touch():
    """Solids do not hide in one another, though none of their surfaces meet."""
    middle = link_poses(UR3, BENT)[3] @ np.array([106.0, 0.0, 20.0, 1.0])
    crumb = CellChecker(UR3, TOOL, [Box("crumb", pose(np.eye(3), middle[:3]), (1.0, 1.0, 1.0))])
    assert crumb.contact(BENT, needle_may_touch_patient=False) == Contact("forearm", "crumb")
    hall = CellChecker(UR3, TOOL, [Box("hall", pose(np.eye(3), [0.0, 0.0, 0.0]), (9000.0, 9000.0, 9000.0))])
    assert hall.contact(BENT, needle_may_touch_patient=False) == Contact("shoulder", "hall")
    assert hall.distances(BENT).boxes.mm == 0.0


def test_the_base_may_stand_on_its_table():
    """The base link overlaps what it is bolted to, and nothing is said."""
    table = Box("table", pose(np.eye(3), [0.0, 0.0, -40.0]), (1000.0, 1000.0, 100.0))
    assert CellChecker(UR3, TOOL, [table]).contact(BENT, needle_may_touch_patient=False) is None


def test_the_needle_may_go_in_and_the_holder_may_not():
    """With the skin across the needle the flag decides; with the skin across the holder it does not help."""
    T = flange_pose(UR3, BENT)
    for depth, names in ((200.0, {"needle"}), (60.0, {"holder"})):
        at = T[:3, 3] + depth * T[:3, 2]
        checker = CellChecker(UR3, TOOL, patient=cuboid(at - 15.0, at + 15.0))
        contact = checker.contact(BENT, needle_may_touch_patient=False)
        assert contact is not None and contact.other == "patient" and contact.body in names
        allowed = checker.contact(BENT, needle_may_touch_patient=True)
        assert (allowed is None) == (names == {"needle"})
        distances = checker.distances(BENT)
        assert (distances.needle.mm == 0.0) == (names == {"needle"})


@pytest.mark.parametrize("engine", [CellChecker, FastChecker])
def test_what_is_outside_of_the_body_is_named_so(engine):
    """A table, or the side of the image, was named "patient" in the arm's reasons: people looked at the skin."""
    T = flange_pose(UR3, BENT)
    at = T[:3, 3] + 60.0 * T[:3, 2]
    there, elsewhere = cuboid(at - 15.0, at + 15.0), cuboid(at - 15.0 + 3000.0, at + 15.0 + 3000.0)
    both = joined([there, elsewhere])
    for skin, outside, other in (
        (there, elsewhere, "patient"),
        (elsewhere, there, "outside_body"),
        (both, None, "patient"),
    ):
        checker = engine(UR3, TOOL, patient=skin, outside=outside)
        assert checker.contact(BENT, needle_may_touch_patient=True) == Contact("holder", other)


def test_an_arm_that_ends_inside_the_patient_is_found_at_its_surface():
    """Wrist, holder and needle wholly inside a closed skin: no surface of theirs meets it, the forearm's does."""
    inside = link_poses(UR3, BENT)[4][:3, 3]
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    poses = link_poses(UR3, BENT)
    reach = max(
        np.linalg.norm(points - inside, axis=1).max()
        for name, points in body_points(UR3, TOOL, BENT).items()
        if name in ("wrist_1", "wrist_2", "wrist_3", "holder", "needle")
    )
    radius = reach + 5.0
    base_gap = np.linalg.norm(poses[0][:3, 3] - inside) - radius
    assert base_gap > 0.0, "the scene must leave the base outside"
    skin = TriangleMesh(np.asarray(ball.vertices) * radius + inside, np.asarray(ball.faces))
    contact = CellChecker(UR3, TOOL, patient=skin).contact(BENT, needle_may_touch_patient=True)
    assert contact is not None and contact.other == "patient" and contact.body in ("shoulder", "upper_arm", "forearm")


@pytest.mark.parametrize("name", sorted(UR_MODELS))
def test_neighbouring_bodies_overlap_at_every_angle(name):
    """The chain has no gap in which a skin could pass between two bodies: what makes the surface test enough."""
    model = ur_model(name)
    links = collision_links(model)
    for joint in range(6):
        pieces = [[fcl.CollisionObject(convex(piece)) for piece in link.pieces] for link in links[joint : joint + 2]]
        for angle in np.linspace(-np.pi, np.pi, 25):
            q = np.zeros(6)
            q[joint] = angle
            T = np.linalg.inv(link_poses(model, q)[joint]) @ link_poses(model, q)[joint + 1]
            for piece in pieces[1]:
                piece.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
            assert any(touch(a, b) for a in pieces[0] for b in pieces[1]), (LINK_NAMES[joint], angle)
    wrist_3_end = links[6].mesh.bounds[1, 2]
    assert -HOLDER_ROOT_MM < wrist_3_end <= WRIST_3_BEYOND_MM
    assert TOOL.needle_span_mm[0] < TOOL.holder_span_mm[1]


@pytest.mark.parametrize("name", sorted(UR_MODELS))
def test_wrist_2_stays_behind_the_flange_plane(name):
    """Why the tool is never tested against wrist 2: seen from the flange it ends before the holder begins."""
    model = ur_model(name)
    wrist_2 = collision_links(model)[5]
    for q in np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 6)):
        poses = link_poses(model, q)
        T_flange_link = np.linalg.inv(poses[6]) @ poses[5]
        heights = (wrist_2.mesh.vertices @ T_flange_link[:3, :3].T + T_flange_link[:3, 3])[:, 2]
        assert heights.max() < -HOLDER_ROOT_MM


@pytest.mark.parametrize("name", ["ur3", "ur3e", "ur5e", "ur10e"])
def test_whatever_the_shipped_meshes_meet_is_a_contact(name):
    """Where two links' own meshes intersect the checker never says free, over random poses; nor is it much stricter.

    At most 3 % of the poses are a contact to it in which the open meshes do not meet (hulls are fuller).
    """
    model = ur_model(name)
    bare = CellChecker(model, Tool(2.0, 1.0, 0.1, 0.1))
    objects = [fcl.CollisionObject(surface(link.mesh)) for link in visual_links(model)]
    pairs = [p for p in combinations(range(7), 2) if (LINK_NAMES[p[0]], LINK_NAMES[p[1]]) not in NEVER_TESTED]
    poses = np.random.default_rng(4).uniform(-np.pi, np.pi, (600, 6))
    stricter = met = 0
    for q in poses:
        for item, T in zip(objects, link_poses(model, q), strict=True):
            item.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        meet = any(touch(objects[i], objects[j]) for i, j in pairs)
        contact = bare.contact(q, needle_may_touch_patient=False)
        assert not meet or contact is not None
        stricter += contact is not None and not meet
        met += meet
    assert 100 < met < 300
    assert stricter <= 0.03 * len(poses)


@pytest.mark.parametrize("name", sorted(UR_MODELS))
def test_every_mesh_vertex_lies_in_a_convex_piece(name):
    """The pieces contain the link: each shipped vertex is within 1e-6 mm of the inside of one of them."""
    for hull, detail in zip(collision_links(ur_model(name)), visual_links(ur_model(name)), strict=True):
        outside = np.full(len(detail.mesh.vertices), np.inf)
        for piece in hull.pieces:
            a, b, c = np.moveaxis(piece.triangles, 1, 0)
            normals = np.cross(b - a, c - a)
            sizes = np.linalg.norm(normals, axis=1)
            planes = normals[sizes > 1e-9] / sizes[sizes > 1e-9, None]
            heights = detail.mesh.vertices @ planes.T - np.einsum("ij,ij->i", planes, a[sizes > 1e-9])
            outside = np.minimum(outside, heights.max(axis=1))
        assert outside.max() < 1e-6, hull.name


def test_folded_arms_touch_themselves_and_name_the_links():
    """An elbow folded shut, and a needle turned back on the arm, are contacts; upright the arm is free."""
    checker = CellChecker(UR3, TOOL)
    upright = np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0])
    assert checker.contact(upright, needle_may_touch_patient=False) is None
    folded = upright + np.array([0.0, 0.0, 3.1, 0.0, 0.0, 0.0])
    contact = checker.contact(folded, needle_may_touch_patient=False)
    assert contact is not None and set(contact) <= {*LINK_NAMES, "holder", "needle"}
    long_needle = CellChecker(UR3, Tool(500.0, 490.0, 2.0, 30.0))
    met = set()
    for q4 in np.linspace(-np.pi, np.pi, 181):
        for q5 in (0.0, np.pi):
            met.add(
                long_needle.contact(np.array([0, -1.6, 0.8, q4, np.pi / 2 + q5, 0]), needle_may_touch_patient=False)
            )
    assert {"needle"} <= {contact.body for contact in met if contact}


def test_a_base_inside_or_through_the_patient_is_refused():
    """Wholly inside, and crossing its surface."""
    for half in (400.0, 40.0):
        low, high = np.full(3, -half), np.full(3, half)
        with refused("base_in_patient"):
            CellChecker(UR3, TOOL, patient=cuboid(low, high))


def test_winding_numbers_are_the_sums_of_solid_angles():
    """By numpy, of each point by itself: inside, outside and next to a face, of a closed and of an open surface."""
    box = cuboid(np.full(3, -50.0), np.full(3, 50.0))
    points = np.random.default_rng(5).uniform(-60.0, 70.0, (50, 3))
    for mesh in (box, TriangleMesh(box.vertices, box.faces[:-2])):
        by_numpy = [solid_angle(mesh, point) / (4 * np.pi) for point in points]
        assert winding_numbers(mesh, points) == pytest.approx(by_numpy, abs=1e-12)
        assert [winding_number(mesh, point) for point in points] == pytest.approx(by_numpy, abs=1e-12)


def solid_angle(mesh, point):
    """Signed, of all triangles as seen from a point."""
    corners = mesh.triangles - point
    a, b, c = np.moveaxis(corners / np.linalg.norm(corners, axis=2, keepdims=True), 1, 0)
    below = 1.0 + (a * b + b * c + c * a).sum(axis=1)
    return float(2 * np.arctan2(np.linalg.det(np.stack([a, b, c], axis=1)), below).sum())


@pytest.mark.parametrize("q", [np.full(6, np.nan), np.array([0, 0, np.inf, 0, 0, 0])])
def test_angles_that_are_not_finite_are_refused(q):
    """FCL would call them free."""
    checker = CellChecker(UR3, TOOL)
    with refused("not_finite"):
        checker.contact(q, needle_may_touch_patient=False)
    with refused("not_finite"):
        checker.distances(q)


@pytest.mark.parametrize(
    "mesh",
    [
        TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]]), np.array([[0, 1, 2]])),
        TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 7]])),
        TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, -1]])),
        TriangleMesh(np.array([[0, 0, 0.0]]), np.empty((0, 3))),
    ],
    ids=["nan vertex", "index too high", "index negative", "no faces"],
)
def test_a_skin_that_fcl_would_misjudge_is_refused(mesh):
    """Each of these makes FCL say free or kill the process."""
    with refused("bad_mesh"):
        CellChecker(UR3, TOOL, patient=mesh)


def test_boxes_of_one_name_and_unknown_distances_are_refused():
    """Contacts and distances are told by these names."""
    box = Box("table", pose(np.eye(3), [0, 0, -500]), (1.0, 1.0, 1.0))
    with refused("duplicate_name"):
        CellChecker(UR3, TOOL, [box, box])
    with refused("unknown_choice"):
        CellChecker(UR3, TOOL, [box]).nearest(BENT, "ceiling")


def test_no_body_point_leaves_the_sweep_bound():
    """Between two configurations every point of every link and of the tool stays within half the bound of an end."""
    swept = SweptBodies.of(UR3, TOOL)
    rng = np.random.default_rng(8)
    for size in (1e-3, 0.02, 0.3, 1.5):
        for _ in range(6):
            start = rng.uniform(-np.pi, np.pi, 6)
            end = start + size * rng.uniform(-1.0, 1.0, 6)
            bounds = swept.bounds_mm(np.stack([start, end]))[0]
            ends = [body_points(UR3, TOOL, q) for q in (start, end)]
            for share in np.linspace(0.0, 1.0, 9):
                here = body_points(UR3, TOOL, start + share * (end - start))
                for name, points in here.items():
                    off = np.minimum(*(np.linalg.norm(points - other[name], axis=1) for other in ends))
                    bound = bounds[LINK_NAMES.index(name) - 1] if name in LINK_NAMES else bounds[-1]
                    assert off.max() <= bound / 2.0 + 1e-9, name


def test_rows_of_a_path_within_a_distance(rng):
    """At the kept rows, every point of every body is within the distance of where it is at any state of the path."""
    swept = SweptBodies.of(UR3, TOOL)
    knots = rng.uniform(-1.0, 1.0, (4, 6))
    path = np.concatenate([np.linspace(a, b, 400, endpoint=False) for a, b in pairwise(knots)])
    rows = swept.rows_within(path, 30.0)
    assert (rows[0], rows[-1]) == (0, len(path) - 1) and 10 < len(rows) < 200
    corners = np.concatenate([swept.corners, np.ones((6, 8, 1))], axis=2)
    at = np.einsum("nlij,lcj->nlci", link_poses(UR3, path)[:, 1:], corners)[..., :3]
    far = np.linalg.norm(at[:, None] - at[rows][None], axis=-1).max(axis=(2, 3))
    assert far.min(axis=1).max() <= 30.0
    assert swept.rows_within(path[:1], 30.0).tolist() == [0]
    assert swept.rows_within(path[[0, 400, 800]], 1.0).tolist() == [0, 1, 2]  # farther steps than twice that


def ball(subdivisions):
    """A sphere: at six subdivisions 81,920 triangles, in sixteen parts."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=100.0)
    return TriangleMesh(np.asarray(sphere.vertices), np.asarray(sphere.faces))


def bodies():
    """A cylinder, a box and a surface, each with a box about it."""
    box = trimesh.creation.box((30.0, 20.0, 60.0))
    mesh = TriangleMesh(np.asarray(box.vertices), np.asarray(box.faces))
    about = np.array([[-15.0, -10.0, -30.0], [15.0, 10.0, 30.0]])
    return [
        (Solid(partial(fcl.Cylinder, 5.0, 80.0)), np.array([[-5.0, -5.0, -40.0], [5.0, 5.0, 40.0]])),
        (Solid(partial(fcl.Box, 30.0, 20.0, 60.0)), about),
        (Solid(partial(surface, mesh)), about),
    ]


def test_the_parts_touch_what_the_whole_touches(rng):
    """Nine hundred poses of three kinds of body, against one tree of the whole surface."""
    mesh = ball(6)
    parts, whole = FclSkin(mesh, "ball"), fcl.CollisionObject(surface(mesh))
    told = []
    for solid, box in bodies():
        for _ in range(300):
            at = rng.normal(size=3)
            turn, along = exp_rotation(rng.normal(size=3)), at / np.linalg.norm(at) * rng.uniform(50.0, 150.0)
            solid.place(fcl.Transform(turn, along))
            told.append((parts.touches(solid, box), touch(whole, solid.made)))
    mine, oracle = np.array(told).T
    assert (mine == oracle).all()
    assert 100 < oracle.sum() < 800


def test_a_body_just_at_the_edge_of_a_part_is_asked_about():
    """One flat face exactly on the surface: the box of the body and that of the part share a plane and no more."""
    wall = TriangleMesh(
        np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, 50.0, 0.0]]), np.array([[0, 1, 2]], np.int32)
    )
    solid, half = Solid(partial(fcl.Box, 10.0, 10.0, 10.0)), np.full(3, 5.0)
    for gap, expected in ((0.0, True), (-1e-9, True), (1e-3, False)):
        solid.place(fcl.Transform(np.eye(3), np.array([10.0, 10.0, 5.0 + gap])))
        assert FclSkin(wall, "wall").touches(solid, np.array([-half, half])) is expected


def test_only_parts_that_a_body_comes_near_are_built():
    """Far away none, nor the body; at the surface one or a few."""
    parts = FclSkin(ball(6), "ball")
    solid, box = bodies()[0]
    solid.place(fcl.Transform(np.eye(3), np.array([0.0, 0.0, 400.0])))
    assert not parts.touches(solid, box) and not parts._trees and "made" not in vars(solid)
    solid.place(fcl.Transform(np.eye(3), np.array([0.0, 0.0, 100.0])))
    assert parts.touches(solid, box) and 0 < len(parts._trees) < len(parts._parts)


def test_every_triangle_stands_in_one_part():
    """None is lost, none stands in two, none of the parts is too large."""
    mesh = ball(6)
    parts = FclSkin(mesh, "ball")._parts
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(len(mesh.faces)))
    assert max(map(len, parts)) <= PART_TRIANGLES and len(parts) == -(-len(mesh.faces) // PART_TRIANGLES)


@pytest.mark.parametrize("kind", [CellChecker, FastChecker])
def test_a_loose_part_within_a_link_is_a_contact(kind):
    """A block on no surface of the arm: within any link's piece it touches that body; where nothing is, nothing."""
    model, tool = ur_model("ur5"), Tool(250.0, 150.0, 1.2, 30.0)
    skin, q = ball(2).transformed(pose(np.eye(3), [900.0, 0.0, 0.0])), np.array([0.4, -1.9, 1.6, -1.2, -1.5, 0.3])
    frames, block = link_poses(model, q), trimesh.creation.box((6.0, 6.0, 6.0))
    met = set()
    for body in arm_bodies(model, tool, 5.0)[1:]:
        for corners in body.full.hulls:
            middle = apply(frames[body.frame] @ body.T_frame_body, corners.mean(axis=0))
            loose = TriangleMesh(np.asarray(block.vertices) + middle, np.asarray(block.faces))
            found = built(kind, model, tool, (), skin, outside=loose, padding_mm=5.0).contact(
                q, needle_may_touch_patient=False
            )
            assert found is not None and found.other == OUTSIDE_BODY
            met.add(found.body)
    assert met == set(BODY_NAMES[1:]) - {"tool"}
    beside = TriangleMesh(np.asarray(block.vertices) + [0.0, 900.0, 0.0], np.asarray(block.faces))
    checker = built(kind, model, tool, (), skin, outside=beside, padding_mm=5.0)
    assert checker.contact(q, needle_may_touch_patient=False) is None


def test_a_part_of_the_skin_within_the_base_is_refused():
    """It touches no surface of the base, and encloses none of it."""
    block = trimesh.creation.box((6.0, 6.0, 6.0))
    loose = TriangleMesh(np.asarray(block.vertices) + [20.0, 20.0, 9.0], np.asarray(block.faces))
    skin = joined([ball(2).transformed(pose(np.eye(3), [900.0, 0.0, 0.0])), loose])
    with refused("base_in_patient"):
        CellChecker(ur_model("ur5"), Tool(250.0, 150.0, 1.2, 30.0), (), skin)


def test_the_loose_parts_of_a_surface_are_those_that_share_corners():
    """Two balls of one mesh, and a corner that no face uses: two parts, each with the size of its ball."""
    one, other = ball(1), ball(2).transformed(pose(np.eye(3), [400.0, 0.0, 0.0]))
    both = joined(
        [one, TriangleMesh(np.concatenate([np.full((1, 3), 1e3), other.vertices]), other.faces + np.int32(1))]
    )
    parts = LooseParts.of(both)
    assert parts.lengths == pytest.approx([np.linalg.norm(np.ptp(m.vertices, axis=0)) for m in (one, other)])
    assert (np.abs(parts.corners - [[0.0, 0.0, 0.0], [400.0, 0.0, 0.0]]).max(axis=1) <= 100.0).all()
