"""How markers are touched: in which order, along which lines, and never through the patient."""

from itertools import pairwise, permutations

import numpy as np
import pytest
import trimesh

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import farthest_from_singular, flange_pose
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.touch.tour_motions import TIP_MM, ApproachCheckers, line_to, shortest_tour, why_not

UR3, TIP = ur_model("ur3"), 210.0
HOME = np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])
CENTRE, RADIUS = np.array([330.0, 20.0, 60.0]), 60.0


def patient():
    """A ball."""
    ball = trimesh.creation.icosphere(3, RADIUS)
    return TriangleMesh(ball.vertices + CENTRE, ball.faces)


def checkers(*boxes):
    tools = (Tool(TIP, 150.0, 1.2, 30.0), Tool(TIP - TIP_MM, 150.0 - TIP_MM, 1.2, 30.0))
    return ApproachCheckers(*(CellChecker(UR3, tool, boxes, patient(), padding_mm=4.0) for tool in tools))


def touching(outward, point=None):
    """Joints with the tip on the ball, or on a point, the needle along a direction."""
    outward = np.array(outward) / np.linalg.norm(outward)
    point = CENTRE + RADIUS * outward if point is None else point
    q = nearest_within_limits(UR3, inverse(UR3, flange_poses(point, outward, TIP)[0])[0], HOME)
    q = q[~np.isnan(q).any(axis=1)]
    return farthest_from_singular(UR3, q, outward)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_the_tour_is_the_shortest_of_all_orders(n):
    cost = np.random.default_rng(n).uniform(1, 9, (n + 1, n + 1))

    def length(order):
        stops = [n, *order, n]
        return sum(cost[a, b] for a, b in pairwise(stops))

    assert length(shortest_tour(cost)) == pytest.approx(min(map(length, permutations(range(n)))))


def test_a_tour_and_its_reverse_are_told_apart_by_no_rounding():
    """They cost the same where costs are symmetric: another processor's last bit must not choose."""
    rng = np.random.default_rng(5)
    for n in (2, 4, 6):
        cost = np.abs(rng.normal(size=(n + 1, n + 1)))
        cost += cost.T
        orders = {shortest_tour(cost + 1e-14 * rng.normal(size=cost.shape)) for _ in range(20)}
        (order,) = orders
        assert order[0] < order[-1]


def test_the_line_to_a_marker_is_straight_and_keeps_the_needle():
    q = touching([-0.2, 0.1, 1.0])
    line = line_to(UR3, TIP, q, 20.0, -5.0)
    poses, there = flange_pose(UR3, line), flange_pose(UR3, q)
    tips = poses[:, :3, 3] + TIP * poses[:, :3, 2]
    wanted = there[:3, 3] + TIP * there[:3, 2] - np.linspace(20.0, -5.0, len(line))[:, None] * there[:3, 2]
    np.testing.assert_allclose(tips, wanted, atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, :3], np.tile(there[:3, :3], (len(line), 1, 1)), atol=1e-9)


def test_a_touch_is_refused_for_what_is_in_its_way():
    assert why_not(checkers(), TIP, touching([-0.2, 0.1, 1.0])) == ""
    side, along = CENTRE + np.array([0.0, -RADIUS, 0.0]), np.array([0.0, -0.1, 1.0])
    assert "patient" in why_not(checkers(), TIP, touching(along, side))
    q = touching([-0.2, 0.1, 1.0])
    T = flange_pose(UR3, q)
    box = Box("monitor", pose(np.eye(3), T[:3, 3] + 30 * T[:3, 2]), (20.0, 20.0, 20.0))
    assert "monitor" in why_not(checkers(box), TIP, q)
    assert why_not(checkers(), TIP, HOME + 100.0) == "a joint would exceed its limits"


@pytest.mark.parametrize("aside", [0.0, 30.0, 55.0])
def test_a_touch_through_the_patient_is_refused(aside):
    outward = np.array([0.0, 0.0, 1.0])
    far = CENTRE + np.array([0.0, aside, -np.sqrt(RADIUS**2 - aside**2)])
    assert why_not(checkers(), TIP, touching(outward, far)) in (
        "the needle's shaft would go through the patient",
        "at the standoff needle touches patient",
    )
