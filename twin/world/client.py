"""A headless physics client: opened, set up to repeat itself exactly, and closed again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from puncture_twin.twin.world.engine import pybullet
from puncture_twin.twin.world.units import to_m

TIME_STEP_S = 1.0 / 240.0
"""Bullet's own default; its contact and motor parameters are tuned for it."""

SOLVER_ITERATIONS = 200
"""Four times Bullet's default: a chain of six motors under gravity converges to below a micrometre at the tip."""

STANDARD_GRAVITY_MM_S2 = 9806.65


@contextmanager
def physics_client(down: NDArray[np.float64] | None = None) -> Iterator[int]:
    """Open a DIRECT client (no window), yield its id, and disconnect it whatever happens.

    Bodies, contacts and solver run in a fixed order, so the same calls give the same numbers.

    Args:
        down: Shape (3,), unit vector of gravity in the world frame; None for -z.

    Raises:
        ConnectionError: PyBullet has no client left.
    """
    client = pybullet.connect(pybullet.DIRECT)
    if client < 0:
        raise ConnectionError("PyBullet gave no client: all of its connections are in use")
    try:
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP_S,
            numSolverIterations=SOLVER_ITERATIONS,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            physicsClientId=client,
        )
        direction = np.array([0.0, 0.0, -1.0]) if down is None else down / np.linalg.norm(down)
        gravity = to_m(STANDARD_GRAVITY_MM_S2) * direction
        pybullet.setGravity(*gravity.tolist(), physicsClientId=client)
        yield client
    finally:
        pybullet.disconnect(physicsClientId=client)


def set_time_step(client: int, seconds: float) -> None:
    """Change how long a step is: motors are tuned for `TIME_STEP_S`, torques need shorter ones."""
    pybullet.setPhysicsEngineParameter(fixedTimeStep=seconds, physicsClientId=client)


def step(client: int) -> None:
    """Advance the physics by one time step."""
    pybullet.stepSimulation(physicsClientId=client)
