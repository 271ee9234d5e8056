"""What every checker of the arm obeys, whatever is inside it: laws, each for every implementation."""

from itertools import pairwise

import numpy as np
import pytest

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import exp_rotation, inverse, pose

UR3 = ur_model("ur3")
TOOL = Tool(needle_length_mm=250.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
PADDING_MM = 5.0
CLEAR = np.array([0.4, -1.9, 1.6, -1.2, -1.5, 0.3])
"""Elbow up, needle down."""


def placed(t, axis=(0.0, 0.0, 1.0), angle=0.0):
    """A 4x4, mm and rad."""
    return pose(exp_rotation(angle * np.asarray(axis) / np.linalg.norm(axis)), t)


TABLE = Box("table", placed((400.0, 30.0, -140.0), (0.2, 0.1, 1.0), 0.3), (600.0, 900.0, 60.0))
LAMP = Box("lamp", placed((150.0, 250.0, 420.0)), (120.0, 80.0, 60.0))
POLE = Box("pole", placed((-250.0, 150.0, 300.0)), (60.0, 60.0, 700.0))


@pytest.fixture(scope="module", params=[CellChecker, FastChecker], ids=lambda kind: kind.__name__)
def build(request, tmp_path_factory):
    """A function: every implementation in turn, about a UR3 with its tool; the same room is built once."""
    kept = {"cache": Cache(tmp_path_factory.mktemp("cache"))} if request.param is FastChecker else {}
    made = {}

    def make(boxes=(), patient=None, padding_mm=PADDING_MM):
        key = (*map(id, boxes), id(patient), padding_mm)
        if key not in made:  # with what it was made of, so that an id stays its own
            checker = request.param(UR3, TOOL, boxes, patient, padding_mm=padding_mm, **kept)
            made[key] = checker, boxes, patient
        return made[key][0]

    return make


@pytest.fixture(scope="module")
def states():
    """Configurations anywhere, and near where the needle points at the patient."""
    rng = np.random.default_rng(20)
    return np.concatenate([rng.uniform(-np.pi, np.pi, (30, 6)), [CLEAR], CLEAR + rng.normal(0, 0.3, (30, 6))])


@pytest.fixture(scope="module")
def patient(ball):
    """A lumpy body in front of the arm, base frame."""
    mesh = ball(1.0, subdivisions=2)
    lumps = 1.0 + 0.15 * np.sin(9.0 * mesh.vertices[:, :1]) * np.cos(7.0 * mesh.vertices[:, 1:2])
    return TriangleMesh(mesh.vertices * lumps * [160.0, 260.0, 110.0] + [380.0, 40.0, 60.0], mesh.faces)


def contacts(checker, states, may=False):
    """What each state touches first, or None."""
    return [checker.contact(q, needle_may_touch_patient=may) for q in states]


def free(checker, states, may=False):
    return np.array([contact is None for contact in contacts(checker, states, may)])


def test_an_added_obstacle_never_frees(build, states, patient):
    """Obstacle by obstacle the free states only shrink, and each takes some."""
    rooms = [((), None), ((TABLE,), None), ((TABLE, LAMP, POLE), None), ((TABLE, LAMP, POLE), patient)]
    found = np.array([free(build(boxes, skin), states) for boxes, skin in rooms])
    assert (found[1:] <= found[:-1]).all()
    assert (np.diff(found.sum(axis=1)) < 0).all()
    assert found[-1].sum() > 5


def test_a_room_is_free_where_each_of_its_parts_is(build, states, patient):
    """Obstacles do not hide one another."""
    parts = [free(build([box]), states) for box in (TABLE, LAMP, POLE)] + [free(build(patient=patient), states)]
    np.testing.assert_array_equal(free(build([TABLE, LAMP, POLE], patient), states), np.all(parts, axis=0))


def test_a_larger_obstacle_or_a_wider_padding_never_frees(build, states, patient):
    """What contains the smaller one is met wherever that is."""
    sizes = [Box("lamp", LAMP.T_base_box, tuple(np.array(LAMP.size_mm) * factor)) for factor in (0.5, 1.0, 5.0)]
    grown = np.array([free(build([box]), states) for box in sizes])
    padded = np.array([free(build([LAMP], patient, padding), states) for padding in (0.0, PADDING_MM, 40.0)])
    for found in (grown, padded):
        assert (found[1:] <= found[:-1]).all()
        assert found[-1].sum() < found[0].sum()


def test_far_obstacles_are_irrelevant(build, states, patient):
    """Beyond the arm's reach nothing changes a word."""
    away = ball_at(patient, (9000.0, 0.0, 0.0))
    far = [Box(f"far {n}", placed(t), (500.0, 500.0, 500.0)) for n, t in enumerate(4000.0 * np.eye(3))]
    near = contacts(build([TABLE], patient), states)
    assert contacts(build([TABLE, *far], patient), states) == near
    assert contacts(build([TABLE], joined(patient, away)), states) == near
    assert contacts(build(far, away), states) == contacts(build(), states)


def ball_at(mesh, shift):
    return TriangleMesh(mesh.vertices + shift, mesh.faces)


def joined(one, other):
    return TriangleMesh(
        np.concatenate([one.vertices, other.vertices]), np.concatenate([one.faces, other.faces + len(one.vertices)])
    )


def test_orders_are_irrelevant(build, states, patient):
    """Of obstacles, of a skin's triangles, and of the questions: the same states are free."""
    boxes, rng = [TABLE, LAMP, POLE], np.random.default_rng(3)
    checker = build(boxes, patient)
    said = contacts(checker, states)
    shuffled = TriangleMesh(patient.vertices, np.roll(patient.faces[rng.permutation(len(patient.faces))], 1, axis=1))
    np.testing.assert_array_equal(free(build(boxes[::-1], shuffled), states), [contact is None for contact in said])
    assert contacts(checker, states[::-1])[::-1] == said  # nothing is left over from another question


def test_base_and_obstacles_moved_together_change_nothing(build, states, patient):
    """The room knows no place: seen from the base, wherever that stands, it is the same room."""
    said = contacts(build([TABLE, LAMP], patient), states)
    for T_world_base in (
        placed((800.0, -300.0, 900.0), (0, 0, 1), 2.0),
        placed((-5e3, 4e3, 30.0), (1.0, 2.0, -0.5), 2.9),
    ):
        T_base_world = inverse(T_world_base)
        boxes = [Box(b.name, T_base_world @ (T_world_base @ b.T_base_box), b.size_mm) for b in (TABLE, LAMP)]
        moved = patient.transformed(T_world_base).transformed(T_base_world)
        assert contacts(build(boxes, moved), states) == said


@pytest.mark.parametrize("angle", [0.3, -2.6])
def test_the_shoulder_and_the_room_turned_together_change_nothing(build, states, patient, angle):
    """About the base's axis: the first joint by an angle, and all that the arm may meet by the same.

    The base link stays, so states that touch it, by the arm's own shape, are left out.
    """
    T = placed((0.0, 0.0, 0.0), angle=angle)
    turned = states + np.array([angle, 0, 0, 0, 0, 0])
    alone = free(build(), states) & free(build(), turned)
    boxes = [Box(b.name, T @ b.T_base_box, b.size_mm) for b in (TABLE, LAMP)]
    still, moved = build([TABLE, LAMP], patient), build(boxes, patient.transformed(T))
    assert alone.sum() > 20
    assert contacts(moved, turned[alone]) == contacts(still, states[alone])


def test_a_box_looks_the_same_from_behind(build, states):
    """Half turns about its own axes, and sides that are exchanged, are no other box."""
    said = contacts(build([TABLE]), states)
    for axis in np.eye(3):
        T = TABLE.T_base_box @ placed((0.0, 0.0, 0.0), axis, np.pi)
        assert contacts(build([Box("table", T, TABLE.size_mm)]), states) == said
    x, y, z = TABLE.size_mm
    T = TABLE.T_base_box @ placed((0.0, 0.0, 0.0), (0, 0, 1), np.pi / 2)
    assert contacts(build([Box("table", T, (y, x, z))]), states) == said


def test_whole_turns_of_joints_change_nothing(build, states, patient):
    """The arm stands where it stood."""
    checker, rng = build([TABLE, LAMP], patient), np.random.default_rng(4)
    turns = 2.0 * np.pi * rng.integers(-1, 2, states.shape)
    assert contacts(checker, states + turns) == contacts(checker, states)


def test_a_needle_that_may_go_in_is_the_only_one_that_may(build, states, patient, ball):
    """Leave for the needle frees nothing but the needle in the patient; and it does free that."""
    tip = link_poses(UR3, CLEAR)[6] @ np.array([0.0, 0.0, TOOL.needle_span_mm[1], 1.0])
    freed = 0
    for checker in (build([TABLE, LAMP], patient), build([TABLE], ball(30.0, tip[:3], 1))):
        pairs = zip(contacts(checker, states), contacts(checker, states, may=True), strict=True)
        for before, after in pairs:
            if before is None or (before.body, before.other) != ("needle", "patient"):
                assert after == before
            else:
                freed += after is None
    assert freed > 0


def test_a_path_is_its_states(build, states, patient):
    """The first contact along it is that of the first state that has one; reversed it is as free."""
    checker = build([TABLE, LAMP], patient)
    clear = states[free(checker, states)]
    for k, (start, end) in enumerate(pairwise(clear)):
        path = start + np.linspace(0.0, 0.2 + 0.05 * k, 25)[:, None] * (end - start)
        said = contacts(checker, path)
        first = checker.first_contact(path, needle_may_touch_patient=False)
        expected = next((at for at, contact in enumerate(said) if contact), None)
        assert (first and (first.at, first.contact)) == (None if expected is None else (expected, said[expected]))
        back = checker.first_contact(path[::-1], needle_may_touch_patient=False)
        assert (back is None) == (first is None)


def test_distances_and_contacts_agree(build, states, patient):
    """Without padding: what is free has a distance from everything, and what touches an obstacle has none from it."""
    checker, alone = build([TABLE, LAMP], patient, 0.0), build()
    for q, contact in zip(states, contacts(checker, states), strict=True):
        if alone.contact(q, needle_may_touch_patient=False) is None:
            found = checker.distances(q)
            least = min(found.patient.mm, found.needle.mm, found.boxes.mm)
            assert (least <= 0.0) == (contact is not None), (q, contact, least)


def test_a_distance_changes_by_no_more_than_the_arm_moves(build, states, patient):
    """Between two states no body comes nearer by more than the sweep that is claimed for them."""
    checker, rng = build([TABLE, LAMP], patient), np.random.default_rng(5)
    for q in states[::6]:
        path = np.stack([q, q + rng.normal(0, 0.02, 6)])
        sweep = float(checker.sweep_mm(path).max())
        one, other = (checker.distances(state).boxes.mm for state in path)
        moved = np.linalg.norm(link_poses(UR3, path[1])[6][:3, 3] - link_poses(UR3, path[0])[6][:3, 3])
        assert abs(one - other) <= sweep + 1e-6
        assert moved <= sweep + 1e-6
