"""Joint torques of an arm in motion: PyBullet's inverse dynamics, with friction and noise that nobody is told."""

import numpy as np

from puncture_twin.planning.arm.dynamics import JointMotion
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.csv_table import table_text
from puncture_twin.planning.formats.points import JOINTS_DEG, TORQUES
from puncture_twin.twin.world.control import rigid_model

FRICTION, NOISE = 0.05, 0.002
"""Of the torque that a joint's motor can give: Coulomb friction, and viscous friction at 1 rad/s; a torque's noise.
Assumed: no UR's data sheet states either."""


def recorded_torques(
    model: UrModel, tool: Tool, down_base: Floats, motion: JointMotion, rng: np.random.Generator
) -> Floats:
    """Torques of a motion, shape (n, 6), N m."""
    with rigid_model(model, tool, down_base) as rigid:
        moved = np.array([rigid.inverse_dynamics(*row) for row in zip(*motion, strict=True)])
    rubbed = FRICTION * model.max_torques * (np.sign(motion.speed) + motion.speed)
    return np.asarray(moved + rubbed + NOISE * model.max_torques * rng.normal(size=moved.shape))


def recording_text(times_s: Floats, motion: JointMotion, torque_nm: Floats) -> str:
    """The recording as a CSV."""
    rows = np.column_stack([times_s, np.degrees(motion.q), torque_nm])
    return table_text(("time_s", *JOINTS_DEG, *TORQUES[0]), [[f"{one:.9g}" for one in row] for row in rows.tolist()])
