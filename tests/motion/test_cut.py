"""The proof that the upper arm cannot get by: blocked cells are in contact for FCL, and what it cuts no path joins."""

import numpy as np
import pytest
from kept_checkers import built
from refusals import refused

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.bodies import arm_bodies
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.motion.approach import plan_approach
from puncture_twin.planning.motion.shortest import UPPER_ARM, UPPER_ARM_FRAME, Cut

TOOL = Tool(needle_length_mm=200.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
FREE = np.array([0.9, -1.9, 1.6, -1.2, -1.5, 0.3])
TURNED = FREE + 2.0 * np.pi * np.eye(6)[1]
"""The same pose, a whole turn of the shoulder on: past the table."""


def floor(thickness_mm: float = 100.0) -> Box:
    T = np.eye(4)
    T[2, 3] = -10.0 - thickness_mm / 2.0
    return Box("table", T, (2000.0, 2000.0, thickness_mm))


def cut_of(checker: CellChecker, goals: np.ndarray) -> Cut:
    return Cut(checker.model, checker.boxes, checker.points_of(UPPER_ARM), FREE, goals)


@pytest.mark.parametrize("model", ["ur3", "ur5", "ur10e"])
def test_all_of_a_blocked_cell_is_in_contact(model: str) -> None:
    arm, rng = ur_model(model), np.random.default_rng(1)
    T = np.eye(4)
    T[:3, 3] = (-300.0, 100.0, 250.0)
    checker = CellChecker(arm, TOOL, [floor(), Box("block", T, (150.0, 200.0, 300.0))])
    cut = cut_of(checker, FREE[None])
    blocked = np.argwhere(cut._blocking >= 0)
    assert len(blocked) > 100
    for cell in rng.choice(blocked, 150):
        q = rng.uniform(-np.pi, np.pi, 6)
        for joint, row in enumerate(cell):
            low, high = cut._edges[joint][row : row + 2]
            q[joint] = rng.choice([low, high, rng.uniform(low, high)])
        assert checker.nearest(q, "boxes", UPPER_ARM).mm == 0.0


def test_the_upper_arm_moves_with_the_first_two_joints() -> None:
    for model in ("ur3", "ur5e", "ur10"):
        frames = [body.frame for body in arm_bodies(ur_model(model), TOOL, 0.0) if body.name == UPPER_ARM]
        assert frames == [UPPER_ARM_FRAME]


def test_a_whole_turn_through_the_table_is_proven_impossible() -> None:
    """The same pose a turn of the shoulder on is cut off by the table; a turn of the base is not; both are said."""
    checker = built(FastChecker, ur_model("ur3"), TOOL, [floor()])
    base_turned = FREE - 2.0 * np.pi * np.eye(6)[0]
    assert cut_of(checker, np.stack([TURNED, base_turned])).off.tolist() == [True, False]
    with refused("no_approach", "upper_arm", by=NoAnswerError):
        plan_approach(checker, FREE, TURNED, seed=1)
    assert plan_approach(checker, FREE, np.stack([TURNED, base_turned]), seed=1).goal_index == 1


def test_what_is_not_proven_is_unknown():
    checker = built(FastChecker, ur_model("ur3"), TOOL, [floor(2.0)])
    assert not cut_of(checker, TURNED[None]).off.any()
    with refused("no_approach", "200", by=NoAnswerError):
        plan_approach(checker, FREE, TURNED, seed=1, max_samples=200)
    assert not cut_of(CellChecker(ur_model("ur3"), TOOL), np.stack([TURNED, FREE])).off.any()
