"""Identified dynamics: how often the 95 % region and the intervals hold the truth, and the tip's path by them.

    python -m benchmarks.dynamics [--draws 2000] [--seed 1]

Each draw is one recording of a UR3's exciting motion at the carton (20 s at 20 Hz), its torques those of PyBullet's
masses, with friction and noise as ``calibrate dynamics --record`` has them.
"""

import numpy as np

from benchmarks.shared import options, versions
from puncture_twin.meshes import folder
from puncture_twin.planning.arm.dynamics import TorqueRecording, identify
from puncture_twin.planning.arm.kinematics import slowed
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.collision.workcell import case_tool, home_configuration
from puncture_twin.planning.motion.exciting import PERIOD_S, exciting_motion
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.twin.jobs.experiment.dynamics_job import gravity
from puncture_twin.twin.plant.torque_recording import NOISE, recorded_torques

STEP_S = 0.05


class Silent:
    """A generator without noise."""

    def normal(self, size):
        """Zeros."""
        return np.zeros(size)


def main():
    """Print the fractions."""
    stated = options(__doc__, draws=2000, seed=1)
    case = load_case(folder() / "carton" / "case_m.toml")
    model, down = case.robot.model, gravity(case, load_placement(case).T_base_ct)
    series = exciting_motion(
        slowed(model, case.robot.speeds), down, home_configuration(case), lambda _: True, stated.seed
    )
    motion = series.at(np.arange(0.0, PERIOD_S, STEP_S))
    torque = recorded_torques(model, case_tool(case), down, motion, Silent())
    truth = identify(model, TorqueRecording(STEP_S, motion.q, torque), down).values
    rng, inside, within = np.random.default_rng(stated.seed), [], []
    for _ in range(stated.draws):
        noise = NOISE * model.max_torques * rng.normal(size=torque.shape)
        found = identify(model, TorqueRecording(STEP_S, motion.q, torque + noise), down)
        e = found.values - truth
        inside.append(e @ np.linalg.solve(found.covariance, e) <= found.region_limit())
        within.append(np.abs(e) <= 1.96 * np.sqrt(np.diag(found.covariance)))
    print(f"{stated.draws} recordings, {len(truth)} base parameters, condition {found.condition:.0f}")
    print(f"in the 95 % region {np.mean(inside):.1%}, in their intervals {np.mean(within):.1%}")
    print(versions())


if __name__ == "__main__":
    main()
