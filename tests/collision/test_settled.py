"""What is settled without the reference, as FCL has it: a round body against triangles, and overlaps that are deep."""

from functools import cache

import fcl
import numpy as np
import trimesh
from kept_checkers import built

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.cache.array_cache import NO_CACHE
from puncture_twin.planning.collision.bodies import BODY_NAMES, surface, touch
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.kernels.hulls import deep
from puncture_twin.planning.collision.kernels.settled import CLEAR, OPEN, TOUCHES, TOUCHES_OUTSIDE, on_skin, settled_at
from puncture_twin.planning.collision.packed import packed_skin
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose

UR3 = ur_model("ur3")
TOOL = Tool(needle_length_mm=250.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
AWAY = np.array([0.4, -1.9, 1.6, -1.2, -1.5, 0.3])
"""Elbow up, needle down."""


def lumps(radii, middle, subdivisions):
    """A lumpy ball, mm."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    uneven = 1.0 + 0.15 * np.sin(9.0 * ball.vertices[:, :1]) * np.cos(7.0 * ball.vertices[:, 1:2])
    return TriangleMesh(ball.vertices * uneven * radii + middle, np.asarray(ball.faces))


def surfaces():
    """A patient of small triangles; a table that touches it, of triangles that are up to 4 m long."""
    skin = lumps([160.0, 260.0, 110.0], [380.0, 40.0, 60.0], 4)
    slab = trimesh.creation.box((500.0, 4000.0, 30.0)).subdivide_to_size(800.0)
    return skin, TriangleMesh(slab.vertices + [380.0, 0.0, 40.0], np.asarray(slab.faces))


@cache
def cell(kind):
    """Both, with a box, around a UR3."""
    skin, outside = surfaces()
    T = pose(np.eye(3), [150.0, 250.0, 420.0])
    return built(kind, UR3, TOOL, [Box("lamp", T, (120.0, 80.0, 60.0))], skin, outside=outside, padding_mm=5.0)


def test_a_round_body_is_settled_as_fcl_settles_it():
    """Needle and holder anywhere about the patient and, most, within 3 mm of touching: FCL agrees, little is left open.

    Each of the two surfaces is queried by itself: the skin's contact comes first.
    """
    fast, rng = cell(FastChecker), np.random.default_rng(3)
    assert fast._patient is not None and fast._patient.outside is not None
    skin, outside = surfaces()
    trees = [fcl.CollisionObject(surface(mesh)) for mesh in (skin, outside)]
    scene, room = fast._proofs.scene, fast._proofs._on_triangle
    bodies = {body.name: body for body in fast._bodies}
    rows = {"holder": None, "needle": None}
    for check, row in zip(fast._tested, scene.checks, strict=True):
        if check.contact.other == "patient" and check.contact.body in rows:
            rows[check.contact.body] = int(row[1])
    met = {CLEAR: 0, OPEN: 0, TOUCHES: 0, TOUCHES_OUTSIDE: 0}
    for trial in range(3000):
        name = ("holder", "needle")[trial % 2]
        body, hull = bodies[name], rows[name]
        assert hull is not None
        frames = np.tile(np.eye(4), (7, 1, 1))
        frames[body.frame] = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))
        mesh = outside if trial % 3 == 0 else skin
        at = mesh.vertices[rng.integers(len(mesh.vertices))]
        axis, end = frames[body.frame, :3, 2], (body.T_frame_body[:3, 3] @ [0.0, 0.0, 1.0])
        off = rng.choice([body.radius_mm, body.radius_mm + 6.0, 20.0])
        frames[body.frame, :3, 3] = at - axis * (end + off) + rng.normal(size=3) * rng.choice([0.3, 3.0, 40.0])
        body.full.surface.place(body.pose(frames))
        on_it, beside = (touch(tree, body.full.surface.made) for tree in trees)
        answer = on_skin(scene.skin, scene.hulls, hull, frames[body.frame], room)
        met[answer] += 1
        expected = TOUCHES if on_it else TOUCHES_OUTSIDE if beside else CLEAR
        assert answer in (OPEN, expected), trial
    assert min(met[CLEAR], met[TOUCHES], met[TOUCHES_OUTSIDE]) > 300 and met[OPEN] < 30, met


def test_a_sliver_is_where_its_corners_are_whatever_its_normal_is():
    """A needle across triangles whose corners are collinear but for rounding is never clear; a millimetre away it is.

    The normal of such a triangle is rounding: its plane may pass far from two of the corners.
    """
    fast, rng = cell(FastChecker), np.random.default_rng(7)
    body = next(body for body in fast._bodies if body.name == "needle")
    row = next(row for row, check in enumerate(fast._tested) if check.contact == ("needle", "patient"))
    for trial in range(400):
        a, b = rng.normal(size=(2, 3)) * 10.0 ** rng.uniform(0.0, 3.0)
        middle = a + rng.uniform(0.2, 0.8) * (b - a)
        sliver = TriangleMesh(np.stack([a, b, middle])[rng.permutation(3)], np.array([[0, 1, 2]], np.int32))
        scene = fast._proofs.scene._replace(skin=packed_skin(sliver, 1, NO_CACHE))
        edge = (b - a) / np.linalg.norm(b - a)
        axis = np.cross(edge, rng.normal(size=3))
        axis /= np.linalg.norm(axis)
        beside = np.cross(axis, edge)
        off = (1.0, body.full.hulls[0][:, 0].max() + 1.0)[trial % 2]
        T = pose(np.stack([edge, beside, axis], axis=1), a + rng.uniform(0.05, 0.95) * (b - a) + off * beside)
        frames = np.tile(np.eye(4), (7, 1, 1))
        frames[body.frame] = T @ np.linalg.inv(body.T_frame_body)
        answer = settled_at(scene, fast._proofs._work, fast._proofs._on_triangle, row, frames)
        assert (answer == CLEAR) == (trial % 2 == 1), trial


def test_contacts_are_those_of_fcl_with_a_table_beside_the_patient():
    """At each of many states the same contact, whichever of skin and table it is with; in a path the same first one."""
    slow, fast, rng = cell(CellChecker), cell(FastChecker), np.random.default_rng(5)
    spread = rng.choice([0.05, 0.2, 0.6], (3000, 1))
    states = AWAY + rng.normal(size=(3000, 6)) * spread
    expected = slow.contacts(states, needle_may_touch_patient=False)
    assert fast.contacts(states, needle_may_touch_patient=False) == expected
    others = [contact.other for contact in expected if contact is not None]
    assert min(others.count("patient"), others.count(OUTSIDE_BODY), others.count("base")) > 10
    ends = [q for q, contact in zip(states, expected, strict=True) if contact is None][:60]
    for start, end in zip(ends[:30], ends[30:], strict=True):
        path = start + np.linspace(0.0, 1.0, 30)[:, None] * (end - start)
        found = (kind.first_contact(path, needle_may_touch_patient=False) for kind in (slow, fast))
        assert next(found) == next(found)


def test_contacts_are_hardly_ever_left_to_fcl():
    """At states anywhere, of two bodies of the arm that are not proven clear: nearly all surely touch."""
    fast, rng = cell(FastChecker), np.random.default_rng(6)
    frames, nothing = link_poses(UR3, rng.uniform(-np.pi, np.pi, (2000, 6))), np.zeros(2000, np.int64)
    found = fast._proofs.first_not_clear(frames, nothing, np.ones((1, len(fast._tested)), np.bool_), nothing)
    between = fast._proofs.joint_spans[found.checks, 0] > 0
    assert (found.answers[between] == OPEN).mean() < 0.02 and between.sum() > 500


def test_holder_and_needle_that_are_known_to_be_clear_are_not_checked():
    """Against patient and boxes, that is; the other contacts are those of FCL, and without knowledge all are."""
    slow, fast, rng = cell(CellChecker), cell(FastChecker), np.random.default_rng(8)
    states = AWAY + rng.normal(size=(4000, 6)) * rng.choice([0.05, 0.2, 0.6], (4000, 1))
    expected = slow.contacts(states, needle_may_touch_patient=False)
    of_round = [contact is not None and contact.body in ("holder", "needle") for contact in expected]
    workcell = np.array(of_round) & np.array([c is not None and c.other not in BODY_NAMES for c in expected])
    assert workcell.sum() > 30
    assert fast.contacts(states, needle_may_touch_patient=False, round_clear=~workcell) == expected
    passed_over = fast.contacts(states, needle_may_touch_patient=False, round_clear=np.ones(4000, np.bool_))
    left = [contact for contact, gone in zip(passed_over, workcell, strict=True) if gone]
    assert all(c is None or c.body not in ("holder", "needle") or c.other in BODY_NAMES for c in left) and None in left


def test_an_arm_is_folded_where_fcl_finds_links_before_the_last_joint_in_contact():
    """Whatever q6 is, and whatever else touches: skin, box and table do not count, nor what is on the flange."""
    slow, fast, rng = cell(CellChecker), cell(FastChecker), np.random.default_rng(9)
    states = rng.uniform(-np.pi, np.pi, (600, 6))
    folded = slow.folded(states)
    assert 100 < folded.sum() < 500
    states[:, 5] = rng.uniform(-np.pi, np.pi, 600)
    np.testing.assert_array_equal(fast.folded(states), folded)
    contacts = slow.contacts(states, needle_may_touch_patient=False)
    assert all(contact is not None for contact, one in zip(contacts, folded, strict=True) if one)
    assert any(contact is not None for contact, one in zip(contacts, folded, strict=True) if not one)
    assert fast.folded(np.empty((0, 6))).shape == (0,)


def test_only_an_origin_well_within_a_tetrahedron_is_deep():
    """Not outside, not next to a face, not in a flat one, and not where a corner is missing."""
    corners = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    inside = 1.0 / np.sqrt(3.0)
    assert deep(corners, 1e-3) and deep(corners[[1, 0, 2, 3]].copy(), inside - 1e-6)
    assert not deep(corners, inside + 1e-6)
    assert not deep(corners + [2.0, 0.0, 0.0], 0.0)
    assert not deep(corners * [1.0, 1.0, 0.0], 0.0)
    lost = corners.copy()
    lost[3, 0] = np.nan
    assert not deep(lost, 0.0)
