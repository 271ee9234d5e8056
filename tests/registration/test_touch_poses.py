"""The configuration in which a marker is taken to be touched: the same on every machine."""

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import singularity
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.geometry.rigid import frame_about, pose
from puncture_twin.planning.registration.fit_uncertainty import touching_configuration

UR3 = ur_model("ur3")
NEEDLE_MM = 200.0
DOWN = np.array([0.0, 0.0, -1.0])


def points(count, seed):
    rng = np.random.default_rng(seed)
    side, away = rng.uniform(-1.0, 1.0, count), rng.uniform(200.0, 380.0, count)
    return np.column_stack([away * np.cos(side), away * np.sin(side), rng.uniform(-50.0, 100.0, count)])


def test_rounding_does_not_choose_between_mirrored_branches():
    """A point moved by less than any machine's rounding is touched in the same configuration."""
    rng = np.random.default_rng(1)
    for point in points(40, seed=0):
        q = touching_configuration(UR3, NEEDLE_MM, point, DOWN)
        for moved in point + rng.normal(scale=1e-12, size=(10, 3)):
            assert np.allclose(touching_configuration(UR3, NEEDLE_MM, moved, DOWN), q, atol=1e-9)


def test_no_other_configuration_of_the_least_tilt_is_farther_from_singular():
    """Against every branch of the poses that are tried; equals are there, of which the first is taken."""
    equals = 0
    for point in points(20, seed=2):
        q = touching_configuration(UR3, NEEDLE_MM, point, DOWN)
        every = inverse(UR3, pose(frame_about(DOWN), point - NEEDLE_MM * DOWN))[0]
        every = every[UR3.within_limits(every)]
        if not len(every) or singularity(UR3, every).least().max() < 0.05:
            continue
        least = singularity(UR3, every).least()
        assert singularity(UR3, q).least() >= least.max() - 1e-9
        equals += np.sum(least > least.max() - 1e-9) > 1
    assert equals > 5
