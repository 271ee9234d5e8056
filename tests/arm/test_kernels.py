"""The compiled ways along a needle against the plain inverse, and the survey against its parts."""

import numpy as np
import pytest

from puncture_twin.planning.arm.insertion import (
    FULL_MARGIN_RAD,
    ReachRequest,
    every_branch,
    fill_branch_path,
    first_stop,
    flange_poses,
    needle_lines,
    reach_margin,
    surveyed,
)
from puncture_twin.planning.arm.inverse_kinematics import (
    EVERY_BRANCH,
    fill_branches,
    inverse,
    nearest_within_limits,
    wrap_to_pi,
)
from puncture_twin.planning.arm.kinematics import flange_pose, singularity
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UR_MODELS, ur_model
from puncture_twin.planning.collision.checker import SweptBodies

DEPTHS = np.linspace(0.0, 120.0, 61)
DISTANCES = 320.0 - DEPTHS
ROLLS = 2.0 * np.pi * np.arange(8) / 8.0


def lines(count, seed):
    """Random needle lines about a target that a UR3 reaches from some sides."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return needle_lines(np.array([300.0, 20.0, 60.0]) + rng.uniform(-80, 80, (count, 3)), u)


@pytest.mark.parametrize("name", sorted(UR_MODELS))
def test_a_way_holds_every_flange_pose_along_the_line(name):
    """Each row of a branch returns its pose to 1e-9 mm and is that branch of the plain inverse, but for whole turns."""
    model = ur_model(name)
    drawn = 0
    for line in lines(15, seed=1):
        q = every_branch(model, line, DISTANCES)
        poses = flange_poses(line.target, line.outward, DISTANCES)
        plain = np.swapaxes(inverse(model, poses), 0, 1)
        exists = ~np.isnan(q[..., 0])
        assert (~exists | ~np.isnan(plain[..., 0])).all()
        assert np.abs(wrap_to_pi(q - plain))[exists].max(initial=0.0) < 1e-9
        for branch in range(8):
            way = q[branch][exists[branch]]
            assert exists[branch][: len(way)].all()  # nothing after the first gap
            assert np.abs(flange_pose(model, way) - poses[: len(way)]).max(initial=0.0) < 1e-9
            assert np.abs(np.diff(way, axis=0)).max(initial=0.0) <= np.pi
        drawn += int(exists.sum())
    assert drawn > 300


def test_one_branch_alone_and_all_eight_agree():
    """The same way to 1e-12 rad, the turn added to every row; NaN in the same rows."""
    model, turn = ur_model("ur3"), np.array([0.0, 2 * np.pi, 0.0, -2 * np.pi, 0.0, 0.7])
    for line in lines(10, seed=2):
        every = every_branch(model, line, DISTANCES)
        for branch in range(8):
            alone = np.empty((len(DISTANCES), 6))
            fill_branch_path(model.lengths, *line, DISTANCES, branch, turn, alone)
            assert np.allclose(alone, every[branch] + turn, rtol=0.0, atol=1e-12, equal_nan=True)


def test_the_branches_that_are_wanted_are_the_same_ones_as_of_all():
    """To the last bit, whichever others are wanted with them: so a survey may drop those that have ended."""
    model, rng, there = ur_model("ur3"), np.random.default_rng(5), 0
    for line in lines(40, seed=5):
        at = line.target + 300.0 * line.outward
        every, some = np.empty((2, 8, 6))
        fill_branches(model.lengths, line[0], at, every, EVERY_BRANCH)
        wanted = int(rng.integers(256))
        fill_branches(model.lengths, line[0], at, some, wanted)
        rows = [branch for branch in range(8) if wanted >> branch & 1]
        assert some[rows].tobytes() == every[rows].tobytes()
        there += int((~np.isnan(some[rows, 0])).sum())
    assert there > 30


def test_the_survey_is_what_its_parts_say():
    """Stops as ``first_stop`` has them, margins as ``reach_margin`` of the motion that the turns give."""
    model, many = ur_model("ur3"), lines(60, seed=4)
    requests = [ReachRequest(line.target, line.outward, DISTANCES[-1], DEPTHS[-1]) for line in many]
    allowed = 0
    for found in surveyed(model, requests, many, ROLLS):
        line, stop_at, starts, margins, turns = found.line, found.stop_at, found.starts, found.margins, found.turns
        assert np.array_equal(found.depths, DEPTHS) and np.array_equal(found.distances, DISTANCES)
        ways = every_branch(model, line, DISTANCES)
        assert np.array_equal(starts, ways[:, 0], equal_nan=True)
        for branch in range(8):
            stop = first_stop(model, ways[branch], DEPTHS)
            assert (stop is None) == (stop_at[branch] < 0)
            if stop is not None:
                assert stop.depth_mm == DEPTHS[stop_at[branch]] and np.isnan(margins[branch]).all()
                continue
            for i, roll in enumerate(ROLLS):
                rolled = ways[branch] + [0, 0, 0, 0, 0, roll]
                middle = rolled[len(rolled) // 2]
                moved = rolled + nearest_within_limits(model, middle, np.zeros(6)) - middle
                assert np.abs(ways[branch] + turns[branch, i] - moved).max() < 1e-12
                if model.within_limits(moved).all():
                    assert margins[branch, i] == pytest.approx(reach_margin(model, moved), abs=1e-12)
                    allowed += 1
                else:
                    assert np.isnan(margins[branch, i])
    assert allowed > 200


def test_margins_are_the_least_term_of_all():
    """Over random motions: joint limits in quarter turns and the three singular terms, nothing else."""
    model = ur_model("ur3")
    for seed in range(20):
        q = np.random.default_rng(seed).uniform(-3.0, 3.0, (10, 6))
        limits = np.minimum(q - model.joint_limits[:, 0], model.joint_limits[:, 1] - q).min() / FULL_MARGIN_RAD
        assert reach_margin(model, q) == pytest.approx(min(1.0, limits, singularity(model, q).least().min()), abs=1e-15)


def test_a_jump_and_a_singularity_stop_a_way_where_they_are():
    """A joint that turns 0.2 rad in 2 mm stops at the sample before; a stretched elbow at its own."""
    model = ur_model("ur3")
    still = np.tile([0.4, -1.9, 1.6, -1.2, -1.5, 0.3], (10, 1))
    depths = 2.0 * np.arange(10.0)
    assert first_stop(model, still, depths) is None
    jump, stretched, lost = still.copy(), still.copy(), still.copy()
    jump[6:, 5] += 0.2
    stretched[4, 2] = 0.01
    lost[7:] = np.nan
    assert first_stop(model, jump, depths) == (10.0, "a joint would jump 10.0 mm after the standoff")
    stop = first_stop(model, stretched, depths)
    assert stop is not None and stop.depth_mm == 6.0 and "jump" in stop.detail  # 1.6 to 0.01 rad in 2 mm comes first
    stop = first_stop(model, stretched[4:], depths[4:])
    assert stop is not None and stop.depth_mm == 8.0 and "elbow" in stop.detail
    stop = first_stop(model, lost, depths)
    assert stop is not None and stop.depth_mm == 14.0 and "cannot reach" in stop.detail


def test_padding_moves_farther():
    """The bound of the padded bodies is never below that of the bare ones, and holds their outermost corners."""
    model, tool = ur_model("ur3"), Tool(250.0, 150.0, 1.2, 30.0)
    bare, full = SweptBodies.of(model, tool), SweptBodies.of(model, tool, 5.0)
    path = np.random.default_rng(9).uniform(-np.pi, np.pi, (30, 6))
    assert (full.bounds_mm(path) >= bare.bounds_mm(path)).all()
    assert np.allclose(np.ptp(full.corners, axis=1) - np.ptp(bare.corners, axis=1), 10.0)
