"""The simulated room: units, kinematics against the closed form, gravity, contacts, pictures."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from places import ROOT
from refusals import refused

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.collision.bodies import BODY_NAMES
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.world.arm import load_arm
from puncture_twin.twin.world.client import (
    STANDARD_GRAVITY_MM_S2,
    physics_client,
    pose_to_m,
    pose_to_mm,
    pybullet,
    step,
    to_m,
    to_mm,
)
from puncture_twin.twin.world.execution import execute, touches
from puncture_twin.twin.world.workcell import load_box, load_surface, open_workcell, pinhole_picture, thinned

TOOL = Tool(210.0, 150.0, 1.2, 30.0)
HOME = np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])
DOWN = np.array([0.0, 0.0, -1.0])
FK_TOLERANCE_MM = 1e-3
"""The URDF rounds pi to 12 digits, Bullet adds its own: 5e-5 mm at the reach of a UR10."""


def sphere(radius: float, subdivisions: int = 3) -> TriangleMesh:
    ball = trimesh.creation.icosphere(subdivisions, radius)
    return TriangleMesh(ball.vertices, ball.faces)


def at(x: float, y: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def test_units_convert_and_come_back():
    """A millimetre is a thousandth of a metre, and a pose survives the trip."""
    assert to_m(1234.0) == 1.234
    rng = np.random.default_rng(1)
    points = rng.normal(size=(5, 3)) * 500
    np.testing.assert_allclose(to_mm(to_m(points)), points, rtol=1e-15)
    T = flange_pose(ur_model("ur3"), rng.uniform(-3, 3, 6))
    np.testing.assert_allclose(pose_to_mm(*pose_to_m(T)), T, atol=1e-9)


def test_clients_are_worlds_of_their_own_and_closed_even_after_an_exception():
    """A body of one does not exist in the other; leaving the block disconnects, also when something failed inside."""
    with pytest.raises(RuntimeError, match="inside"), physics_client() as first, physics_client() as second:
        load_box(first, np.array([10.0, 10.0, 10.0]), np.eye(4))
        assert [pybullet.getNumBodies(physicsClientId=client) for client in (first, second)] == [1, 0]
        raise RuntimeError("inside")
    assert not pybullet.isConnected(first) and not pybullet.isConnected(second)


def test_gravity_points_where_it_is_told_and_is_earths():
    """A loose ball gains g times t along the given direction."""
    with physics_client(down=np.array([0.0, 2.0, 0.0])) as client:
        shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.01, physicsClientId=client)
        ball = pybullet.createMultiBody(1.0, shape, physicsClientId=client)
        pybullet.changeDynamics(ball, -1, linearDamping=0.0, physicsClientId=client)
        for _ in range(24):
            step(client)
        velocity, _ = pybullet.getBaseVelocity(ball, physicsClientId=client)
    np.testing.assert_allclose(to_mm(velocity), [0.0, STANDARD_GRAVITY_MM_S2 * 0.1, 0.0], atol=1e-6)


@pytest.mark.parametrize("name", ["ur3", "ur3e", "ur5", "ur5e", "ur10", "ur10e"])
def test_arm_stands_where_the_closed_form_says(name):
    """Bullet's chain of URDF joints and the DH table give the same flange, base turned by half a turn and all.

    The flange is a frame: PyBullet gives a link without inertia 1 kg and 1 kg m^2, which no arm carries there. Contacts
    of physics and of FCL speak of the same bodies.
    """
    model, rng = ur_model(name), np.random.default_rng(2)
    with physics_client() as client:
        arm = load_arm(client, model, TOOL)
        for q in rng.uniform(-np.pi, np.pi, (40, 6)):
            arm.place(q)
            np.testing.assert_allclose(arm.flange_pose(), flange_pose(model, q), atol=FK_TOLERANCE_MM)
        mass, _, inertia = pybullet.getDynamicsInfo(arm.body, arm.links["tool0"], physicsClientId=client)[:3]
    assert mass == 0.0 and inertia == (0.0, 0.0, 0.0)
    assert all(arm.link_name(arm.links[name]) == name for name in set(BODY_NAMES) - {"tool"})  # carried by none


def test_arm_on_a_turned_base_carries_the_whole_chain():
    """T_world_flange = T_world_base T_base_flange."""
    model, q = ur_model("ur3"), np.array([0.3, -1.0, 0.9, -0.4, 1.2, 2.0])
    T_world_base = flange_pose(model, np.array([1.0, -0.5, 0.4, 0.2, -0.3, 0.7]))
    with physics_client() as client:
        arm = load_arm(client, model, TOOL, T_world_base)
        arm.place(q)
        np.testing.assert_allclose(arm.flange_pose(), T_world_base @ flange_pose(model, q), atol=FK_TOLERANCE_MM)


def test_needle_ends_where_the_tool_says():
    """Holder and needle lie on the flange's z axis, one after the other, and the needle's body ends at the tip."""
    with physics_client() as client:
        arm = load_arm(client, ur_model("ur3"), TOOL)
        arm.place(HOME)
        T_base_flange = arm.flange_pose()
        np.testing.assert_allclose(arm.link_pose("holder"), T_base_flange, atol=FK_TOLERANCE_MM)
        base_of_needle = T_base_flange[:3, 3] + 60.0 * T_base_flange[:3, 2]
        np.testing.assert_allclose(arm.link_pose("needle")[:3, 3], base_of_needle, atol=FK_TOLERANCE_MM)
        low, high = pybullet.getAABB(arm.body, arm.links["needle"], physicsClientId=client)
    tip = T_base_flange[:3, 3] + 210.0 * T_base_flange[:3, 2]
    along = int(np.argmax(np.abs(T_base_flange[:3, 2])))
    nearest = min(to_mm([low[along], high[along]]), key=lambda edge: abs(edge - tip[along]))
    assert abs(nearest - tip[along]) < 5.0  # Bullet's boxes are a few mm larger than the body


def test_arm_without_a_body_is_refused():
    """A model that nobody has shapes of; the error lists what there is."""
    nobody = replace(ur_model("ur3e"), name="ur16e")
    with physics_client() as client, refused("no_link_meshes", "ur3", "ur3e", "ur5"):
        load_arm(client, nobody, TOOL)


def test_arm_sinks_without_motors_and_stays_with_them():
    """Gravity acts on the arm, and the motors hold it within their torque."""
    with physics_client() as client:
        arm = load_arm(client, ur_model("ur3"), TOOL)
        arm.place(HOME)
        start = arm.flange_pose()[:3, 3]
        for _ in range(120):
            arm.command(HOME, np.zeros(6))
            step(client)
        held = np.linalg.norm(arm.flange_pose()[:3, 3] - start)
        arm.release()
        for _ in range(120):
            step(client)
        fallen = start[2] - arm.flange_pose()[2, 3]
    assert held < 0.02 and fallen > 50.0


def test_table_in_the_way_is_felt_and_named():
    """Driving the holder down into a box stops the arm there and reports the box and the link."""
    model = ur_model("ur3")
    down = HOME + np.array([0.0, -0.4, 0.0, 0.4, 0.0, 0.0]) * np.linspace(0, 1, 480)[:, None]
    lowest = flange_pose(model, down[-1])[2, 3]
    box = Box("table", at(400, 0, lowest - 20.0), (600.0, 600.0, 40.0))
    with open_workcell(model, Tool(60.0, 20.0, 1.2, 30.0), sphere(20.0), at(-400, 0, 0), [box], down_ct=DOWN) as room:
        done = execute(room, down, np.zeros(6))
    assert {(t.link, t.body) for t in done.touches} & {("needle", "table"), ("holder", "table")}
    assert done.T_base_flange[-1, 2, 3] > lowest + 10.0


def test_needle_goes_through_the_skin_but_the_holder_does_not():
    """The shaft in the body makes no contact; the holder on the skin does, as patient."""
    model = ur_model("ur3")
    T = flange_pose(model, HOME)
    tip = T[:3, 3] + 210.0 * T[:3, 2]
    shaft_only, too_deep = (T[:3, 3] + (60.0 + gap + 100.0) * T[:3, 2] for gap in (10.0, -5.0))
    for centre, expected in ((shaft_only, set()), (too_deep, {("holder", "patient")})):
        assert np.linalg.norm(tip - centre) < 90.0  # the tip is well inside the ball
        with open_workcell(model, TOOL, sphere(100.0), at(*centre), down_ct=DOWN) as room:
            room.arm.place(HOME)
            pybullet.performCollisionDetection(physicsClientId=room.client)
            assert {(t.link, t.body) for t in touches(room)} == expected


def test_concave_skin_is_hollow_where_it_is_hollow():
    """A holder inside a U-shaped surface touches nothing; the convex hull of that surface would be in the way."""
    model, walls = ur_model("ur3"), [trimesh.creation.box((20, 200, 200), at(x, 0, 0)) for x in (-100, 100)]
    mesh, T = trimesh.util.concatenate(walls), flange_pose(model, HOME)
    skin, place = TriangleMesh(mesh.vertices, mesh.faces), at(*(T[:3, 3] + 90 * T[:3, 2]))
    with open_workcell(model, TOOL, skin, place, down_ct=DOWN) as room:
        room.arm.place(HOME)
        pybullet.performCollisionDetection(physicsClientId=room.client)
        assert touches(room) == ()


def test_large_surfaces_are_thinned_and_stay_in_place():
    """Thinning keeps small meshes as they are and large ones within half a millimetre here."""
    small, large = sphere(100.0, 3), sphere(100.0, 6)
    assert thinned(small) is small
    thin = thinned(large, 20_000)
    assert 15_000 < len(thin.faces) <= 20_000
    np.testing.assert_allclose(np.linalg.norm(thin.vertices, axis=1), 100.0, atol=0.5)


def test_picture_shows_what_stands_there():
    """A ball of the skin's colour in the middle makes the middle reddish; the array is rows, columns, RGB."""
    K, T = np.array([[97.0, 0, 59.5], [0, 97.0, 39.5], [0, 0, 1]]), np.eye(4)
    T[:3] = [[0.0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 500.0]]  # from x = 500 mm toward the origin
    with physics_client() as client:
        empty = pinhole_picture(client, (120, 80), K, T)
        load_surface(client, sphere(60.0), np.eye(4))
        seen = pinhole_picture(client, (120, 80), K, T)
    assert seen.shape == (80, 120, 3) and seen.dtype == np.uint8
    red, green, blue = seen[40, 60].astype(int)
    assert red > green > blue and (seen[40, 60] != empty[40, 60]).any()
    np.testing.assert_array_equal(seen[0, 0], empty[0, 0])


@pytest.mark.parametrize("name", ["ur3", "ur3e"])
def test_loading_prints_nothing_on_stdout(capfd, name):
    """Standard output belongs to the caller: a table or a JSON object may be on its way there."""
    with open_workcell(ur_model(name), TOOL, sphere(50.0), at(400, 0, 0), down_ct=DOWN) as room:
        execute(room, HOME[None].repeat(10, axis=0), np.zeros(6))
    assert capfd.readouterr().out == ""


def test_importing_the_twin_writes_nothing_anywhere():
    """PyBullet's greeting is not heard: an error of ours stays the one line on standard error."""
    command = [sys.executable, "-c", "import puncture_twin.twin.world.client"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
