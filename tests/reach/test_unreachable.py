"""What keeps every branch from a flange pose."""

import numpy as np
import pytest

from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.reach.reach import missing_reach_mm


def test_reach_is_missing_exactly_where_no_solution_exists():
    """0 mm missing and a solution go together; a straight arm asked to be 12.5 mm longer misses 12.5 mm."""
    model = ur_model("ur3")
    rng = np.random.default_rng(5)
    poses = flange_pose(model, rng.uniform(-np.pi, np.pi, (500, 6)))
    poses[:, :3, 3] *= rng.uniform(0.2, 1.6, (500, 1))
    missing = missing_reach_mm(model, poses)
    exists = ~np.isnan(inverse(model, poses)[..., 0]).all(axis=1)
    assert np.array_equal(missing == 0.0, exists)
    assert 100 < exists.sum() < 450
    straight_up = flange_pose(model, np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0]))
    straight_up[2, 3] += 12.5
    assert missing_reach_mm(model, straight_up)[0] == pytest.approx(12.5, abs=1e-6)
