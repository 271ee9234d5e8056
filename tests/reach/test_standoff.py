"""Where the tip waits before the insertion: never nearer than the case says, and clear of the skin."""

from types import SimpleNamespace

import fcl
import numpy as np
import pytest
import trimesh

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM, case_tool
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.place.mounts import wanted_directions
from puncture_twin.planning.place.search import needle_can_start
from puncture_twin.planning.reach.standoff import (
    MAX_GAP_MM,
    UNEVEN_SKIN_MM,
    axis_lengths,
    farthest_flange,
    skin_gaps,
    standoffs,
    waiting_flange,
)
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates

DEG = np.pi / 180.0


def needle(diameter=1.2, gap=10.0, standoff=None):
    """A needle of 200 mm."""
    return Needle(200.0, 150.0, diameter, standoff, gap, 30.0)


def touches_flat_skin(diameter, gap_mm, angle):
    """FCL's word: the padded needle, its tip so far along it from the origin of a flat slab, its top outward."""
    length = 150.0 + 2.0 * ARM_PADDING_MM
    shaft = fcl.CollisionObject(fcl.Cylinder(diameter / 2.0 + ARM_PADDING_MM, length))
    middle = gap_mm - ARM_PADDING_MM + length / 2.0
    turn = trimesh.transformations.rotation_matrix(angle, [0, 1, 0])
    shaft.setTransform(fcl.Transform(turn[:3, :3], middle * turn[:3, 2]))
    slab = fcl.CollisionObject(fcl.Box(2000.0, 2000.0, 20.0), fcl.Transform(np.array([0.0, 0.0, -10.0])))
    return fcl.collide(shaft, slab, fcl.CollisionRequest(), fcl.CollisionResult()) > 0


@pytest.mark.parametrize("diameter", [0.5, 1.2, 8.0, 20.0])
@pytest.mark.parametrize("degrees", [0, 20, 41, 43, 55, 60, 75, 84])
def test_the_padded_needle_is_clear_of_flat_skin(degrees, diameter):
    """At every angle and thickness; and where the angle decides, not for being far off: a little nearer it touches."""
    gap = float(skin_gaps(needle(diameter, gap=6.0), degrees * DEG))
    assert not touches_flat_skin(diameter, gap, degrees * DEG)
    if gap > 6.0:
        assert touches_flat_skin(diameter, gap - UNEVEN_SKIN_MM - 0.01, degrees * DEG)


def test_steep_paths_keep_the_least_gap_and_oblique_ones_start_farther_out():
    """The least gap up to the angle at which it suffices, then ever more, up to a bound."""
    gaps = skin_gaps(needle(), np.array([0.0, 20.0, 35.0, 45.0, 60.0, 89.9, 90.0]) * DEG)
    np.testing.assert_array_equal(gaps[:3], 10.0)
    np.testing.assert_allclose(gaps[3:5], [11.6, 6.0 + 5.6 * np.sqrt(3.0)], atol=1e-12)
    np.testing.assert_array_equal(gaps[5:], MAX_GAP_MM)


def test_the_arms_checker_lets_an_oblique_needle_start():
    """55 degrees to a flat skin: FCL with the whole arm is content at the standoff, and not with the least gap."""
    tool, angle, path_mm = Tool(200.0, 150.0, 1.2, 30.0), 55.0 * DEG, 60.0
    skin = trimesh.creation.box([600.0, 600.0, 40.0])
    target, outward = np.array([500.0, 0.0, -60.0]), np.array([0.0, np.sin(angle), np.cos(angle)])
    entry = target + path_mm * outward
    skin.apply_translation([entry[0], entry[1], entry[2] - 20.0])
    model = ur_model("ur5")
    checker = CellChecker(model, tool, patient=TriangleMesh(skin.vertices, skin.faces), padding_mm=ARM_PADDING_MM)

    def met(standoff):
        solutions = inverse(model, flange_poses(target, outward, 200.0 + standoff))[0]
        contacts = [
            checker.contact(q, needle_may_touch_patient=False) for q in solutions[~np.isnan(solutions).any(axis=1)]
        ]
        assert contacts
        return {tuple(c) for c in contacts if c is not None and c.body == "needle"}

    assert met(path_mm + 10.0) == {("needle", "patient")}
    assert not met(float(standoffs(needle(), path_mm, angle)))


def test_no_direction_of_the_abdomen_is_lost_to_its_own_needle():
    """Every organ-safe direction can start, the most oblique ones too; with the least gap alone one in ten cannot."""
    context = prepare(folder() / "abdomen", arm=False)
    case = context.case
    found = organ_candidates(case, context.anatomy, context.engine, case.directions())
    wanted = wanted_directions(case, found)
    tool, skin = case_tool(case), context.anatomy.skin.mesh
    assert needle_can_start(tool, skin, case.target_ct, wanted).all()
    oblique = found.path.skin_angle[found.safe] > 43.0 * DEG
    assert oblique.sum() > 100 and (wanted.standoff_mm - found.path.length[found.safe])[oblique].min() > 10.0


def test_the_waiting_flange():
    """Needle, path and gap; the case's own standoff where it states one; nothing where there is no skin entry."""
    angles = np.array([0.0, 45.0, np.nan]) * DEG
    paths = np.array([20.0, 150.0, np.nan])
    np.testing.assert_allclose(waiting_flange(needle(), paths, angles), [230.0, 361.6, np.nan])
    np.testing.assert_array_equal(waiting_flange(needle(standoff=60.0), paths, angles), 260.0)
    assert waiting_flange(needle(), 150.0, 45.0 * DEG) == farthest_flange(needle(), 45.0 * DEG)


def test_axes_are_as_long_as_what_they_are_checked_against_demands():
    """Against the body up to an inserted needle's flange, against what is outside of it up to a waiting one's."""
    case = SimpleNamespace(needle=needle(), search=SimpleNamespace(max_skin_angle=45.0 * DEG))
    structures = [SimpleNamespace(outside=outside) for outside in (False, True, False)]
    path_length, skin_angle = np.array([20.0, 150.0, 170.0, np.nan]), np.radians([0, 45, 0, np.nan])
    found = axis_lengths(case, structures, path_length, skin_angle)
    np.testing.assert_allclose(found[:, [0, 2]], 200.0)
    np.testing.assert_allclose(found[:, 1], [230.0, 361.6, 361.6, 361.6])
