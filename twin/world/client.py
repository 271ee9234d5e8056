"""The PyBullet client, headless and repeatable; and the one place where millimetres become PyBullet's metres."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose

TIME_STEP_S = 1.0 / 240.0
"""Bullet's own default; its contact and motor parameters are tuned for it."""
SOLVER_ITERATIONS = 200
"""Four times Bullet's default: a chain of six motors under gravity converges to below a micrometre at the tip."""
STANDARD_GRAVITY_MM_S2 = 9806.65


@contextmanager
def physics_client(down: NDArray[np.float64] | None = None) -> Iterator[int]:
    """Open a DIRECT client (no window), yield its id, and disconnect it whatever happens.

    Bodies, contacts and solver run in a fixed order, so the same calls give the same numbers. ``down`` (3,) is the unit
    vector of gravity in the world frame; None for -z.

    Raises:
        ConnectionError: PyBullet has no client left.
    """
    client = pybullet.connect(pybullet.DIRECT)
    if client < 0:
        raise ConnectionError("PyBullet gave no client: all of its connections are in use")
    try:
        fixed = {"numSolverIterations": SOLVER_ITERATIONS, "deterministicOverlappingPairs": 1, "enableFileCaching": 0}
        pybullet.setPhysicsEngineParameter(fixedTimeStep=TIME_STEP_S, **fixed, physicsClientId=client)
        direction = np.array([0.0, 0.0, -1.0]) if down is None else down / np.linalg.norm(down)
        gravity = to_m(STANDARD_GRAVITY_MM_S2) * direction
        pybullet.setGravity(*gravity.tolist(), physicsClientId=client)
        yield client
    finally:
        pybullet.disconnect(physicsClientId=client)


def step(client: int) -> None:
    """Advance the physics by one time step."""
    pybullet.stepSimulation(physicsClientId=client)


def _imported() -> Any:
    """Import PyBullet while file descriptor 2 leads nowhere: the line comes from C, past Python's `sys.stderr`."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        import pybullet  # here, while it cannot be heard
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    return pybullet


pybullet: Any = _imported()
"""The module; whoever needs it takes it from here."""
MM_PER_M = 1000.0


def to_m(length_mm: ArrayLike) -> Floats:
    """Lengths or points, any shape, mm to m.

    >>> to_m([1500.0, -2.0]).tolist()
    [1.5, -0.002]
    """
    return np.asarray(length_mm, dtype=np.float64) / MM_PER_M


def to_mm(length_m: ArrayLike) -> Floats:
    """Lengths or points, any shape, m to mm."""
    return np.asarray(length_m, dtype=np.float64) * MM_PER_M


def pose_to_m(T_a_b: Floats) -> tuple[list[float], list[float]]:
    """A rigid pose, shape (4, 4), mm, as PyBullet takes it: x, y, z in m, and a quaternion x, y, z, w."""
    quaternion = Rotation.from_matrix(T_a_b[:3, :3]).as_quat()
    return to_m(T_a_b[:3, 3]).tolist(), quaternion.tolist()


def pose_to_mm(position_m: Sequence[float], quaternion: Sequence[float]) -> Floats:
    """T_a_b, shape (4, 4), mm, of a position in m and a quaternion x, y, z, w."""
    return pose(Rotation.from_quat(quaternion).as_matrix(), to_mm(position_m))


def write_obj(mesh: TriangleMesh, path: Path) -> None:
    """Write a surface, mm, as OBJ in metres, to a tenth of a micrometre."""
    corners = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in to_m(mesh.vertices).tolist()]
    faces = [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(corners + faces) + "\n")
