"""A surface in parts touches what the whole touches; what is never near is never built."""

from functools import partial

import fcl
import numpy as np
import pytest
import trimesh
from kept_checkers import built
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.collision.bodies import (
    PART_TRIANGLES,
    FclSkin,
    LooseParts,
    Solid,
    arm_bodies,
    surface,
    touch,
)
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.state_checker import BODY_NAMES
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose


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
    assert parts.sizes == pytest.approx(np.stack([np.ptp(m.vertices, axis=0) for m in (one, other)]))
    assert (np.abs(parts.corners - [[0.0, 0.0, 0.0], [400.0, 0.0, 0.0]]).max(axis=1) <= 100.0).all()
