"""The simulated workcell: arm with needle, patient at their true place, boxes; the world is the controller's base."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import fast_simplification
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies import PATIENT
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.world.arm import Arm, load_arm
from puncture_twin.twin.world.client import physics_client, pose_to_m, pybullet, to_m, write_obj


@dataclass(frozen=True)
class SimulatedWorkcell:
    """An open simulated workcell; other bodies by their ids."""

    client: int
    arm: Arm
    bodies: MappingProxyType[int, str]


@contextmanager
def open_workcell(
    model: UrModel, tool: Tool, skin: TriangleMesh, T_base_ct: Floats, boxes: Sequence[Box] = (), *, down_ct: Floats
) -> Iterator[SimulatedWorkcell]:
    """Build the workcell, yield it, and take it down.

    The needle's shaft passes the skin without resistance; its holder and the arm collide with it. The skin is in the CT
    frame, mm; T_base_ct (4, 4), mm: where the patient lies; ``down_ct`` (3,): unit vector of gravity.

    Raises:
        InputError: There is no body of that arm.
    """
    with physics_client(down=T_base_ct[:3, :3] @ down_ct) as client:
        arm = load_arm(client, model, tool)
        patient = load_surface(client, skin, T_base_ct)
        pybullet.setCollisionFilterPair(arm.body, patient, arm.links["needle"], -1, 0, physicsClientId=client)
        names = {patient: PATIENT}
        for box in boxes:
            names[load_box(client, np.asarray(box.size_mm), box.T_base_box)] = box.name
        yield SimulatedWorkcell(client, arm, MappingProxyType(names))


Rgba = tuple[float, float, float, float]
MAX_PHYSICS_FACES = 20_000
"""Surfaces with more triangles are thinned for physics and images; verdicts come from FCL on the full ones."""
SKIN_RGBA: Rgba = (0.93, 0.78, 0.68, 1.0)
BOX_RGBA: Rgba = (0.60, 0.63, 0.67, 1.0)
CONTACT_MARGIN_M = 0.0
"""Bullet grows concave shapes by this; contact shall begin at the surface itself."""
CONTACT_DAMPING_NS_M = 100.0
"""Damping of bodies that yield."""


def load_surface(client: int, mesh: TriangleMesh, T_world_mesh: Floats, max_faces: int = MAX_PHYSICS_FACES) -> int:
    """A surface that does not move: triangle by triangle, hollows included."""
    position, quaternion = pose_to_m(T_world_mesh)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "surface.obj"
        write_obj(thinned(mesh, max_faces), path)
        shape = {"shapeType": pybullet.GEOM_MESH, "fileName": str(path), "physicsClientId": client}
        collision = pybullet.createCollisionShape(**shape, flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH)
        visual = pybullet.createVisualShape(**shape, rgbaColor=SKIN_RGBA)
        body = pybullet.createMultiBody(0.0, collision, visual, position, quaternion, physicsClientId=client)
    pybullet.changeDynamics(body, -1, collisionMargin=CONTACT_MARGIN_M, physicsClientId=client)
    return int(body)


def load_box(client: int, size_mm: Floats, T_world_box: Floats) -> int:
    """A box that does not move; size (3,) along its axes, its pose at its centre. Returns the body id."""
    half = to_m(size_mm / 2).tolist()
    collision = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
    visual = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=half, rgbaColor=BOX_RGBA, physicsClientId=client)
    position, quaternion = pose_to_m(T_world_box)
    return int(pybullet.createMultiBody(0.0, collision, visual, position, quaternion, physicsClientId=client))


def load_ball(client: int, center_mm: Floats, radius_mm: float, rgba: Rgba) -> int:
    """A ball that is only seen; its centre (3,), world frame. Returns the body id."""
    shape = {"radius": float(to_m(radius_mm)), "rgbaColor": rgba}
    visual = pybullet.createVisualShape(pybullet.GEOM_SPHERE, **shape, physicsClientId=client)
    return int(pybullet.createMultiBody(0.0, -1, visual, to_m(center_mm).tolist(), physicsClientId=client))


def remove(client: int, body: int) -> None:
    """Take a body out of the world."""
    pybullet.removeBody(body, physicsClientId=client)


def soften(client: int, body: int, stiffness_n_m: float) -> None:
    """Let a fixed body yield in contact like a spring, N/m, lightly damped."""
    soft = {"contactStiffness": stiffness_n_m, "contactDamping": CONTACT_DAMPING_NS_M}
    pybullet.changeDynamics(body, -1, **soft, physicsClientId=client)


def thinned(mesh: TriangleMesh, max_faces: int = MAX_PHYSICS_FACES) -> TriangleMesh:
    """The mesh itself where it is small, else a decimated one of about ``max_faces`` triangles."""
    if len(mesh.faces) <= max_faces:
        return mesh
    writable = np.array(mesh.vertices), np.array(mesh.faces)
    return TriangleMesh(*fast_simplification.simplify(*writable, target_count=max_faces))


NEAR_M = 0.05
FAR_M = 10.0
LIGHT_UP = 1.5
"""The light is above the camera: its direction is the camera's plus this much of up."""


def pinhole_picture(
    client: int, size: tuple[int, int], K: NDArray[np.float64], T_camera_world: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """An image of the workcell by a calibrated camera, without its lens's distortion, (height, width, 3), RGB.

    For looking at, not for measuring: the renderer samples pixel corners and has no anti-aliasing. K (3, 3), px, has
    pixel centres at integers; T_camera_world (4, 4), mm: the camera's x right, y down, z forward.
    """
    width, height = size
    left, right = -(K[0, 2] + 0.5) / K[0, 0], (width - 0.5 - K[0, 2]) / K[0, 0]
    bottom, top = -(height - 0.5 - K[1, 2]) / K[1, 1], (K[1, 2] + 0.5) / K[1, 1]
    edges = [float(edge) * NEAR_M for edge in (left, right, bottom, top)]
    projection = pybullet.computeProjectionMatrix(*edges, NEAR_M, FAR_M)
    view = np.diag([1.0, -1.0, -1.0, 1.0]) @ T_camera_world
    view[:3, 3] = to_m(view[:3, 3])
    light = -T_camera_world[2, :3] + LIGHT_UP * -T_camera_world[1, :3]
    drawn = {"lightDirection": light.tolist(), "shadow": 1, "renderer": pybullet.ER_TINY_RENDERER}
    image = pybullet.getCameraImage(width, height, view.T.ravel().tolist(), projection, **drawn, physicsClientId=client)
    rgba = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)
    return np.ascontiguousarray(rgba[..., :3])
