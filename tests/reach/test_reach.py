"""Which directions the arm reaches: the windows and shares of the specification, laws of a drive, and known scenes."""

import json
import math

import numpy as np
import pytest
import trimesh
from case_world import write_case
from chen2019_reach import SHARES, WINDOWS, cap, runs
from refusals import refused

from puncture_twin.planning.arm.insertion import (
    MAX_SWEEP_MM,
    ReachRequest,
    every_branch,
    fill_branch_path,
    flange_poses,
    needle_lines,
    reach_margin,
)
from puncture_twin.planning.arm.inverse_kinematics import inverse, missing_reach_mm
from puncture_twin.planning.arm.kinematics import MIN_SINGULARITY, flange_pose, link_poses, singularity
from puncture_twin.planning.arm.links import collision_links
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.collision.checker import CellChecker, SweptBodies
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.reach.reach import assess_reach_all, sampled
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main

UR3 = ur_model("ur3")
TOOL = Tool(needle_length_mm=200.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
TARGET = np.array([360.0, 20.0, 100.0])
STANDOFF_MM = 120.0

MARKERS_CT = np.array([[10.0, 20.0, 147.0], [110.0, 120.0, 147.0], [60.0, -10.0, 80.0]])
MARKERS_BASE = np.array([[417.67, -291.23, 534.59], [557.74, -272.83, 534.57], [423.48, -231.41, 604.06]])
LESION_M_CT = np.array([50.0, 130.0, 63.0])
"""Markers A, B, C and lesion M: Tables 1 and 2 of Chen 2019, mm."""


def triad(points):
    """Chen 2019 Eq. 1-3: the frame of three markers, as a rotation."""
    e1 = points[1] - points[0]
    e3 = np.cross(e1, points[2] - points[0])
    e1, e3 = e1 / np.linalg.norm(e1), e3 / np.linalg.norm(e3)
    return np.stack([e1, np.cross(e3, e1), e3], axis=1)


def paper_placement():
    """R_base_ct and lesion M in the base frame, mm: setup 1, A-B-C."""
    R = triad(MARKERS_BASE) @ triad(MARKERS_CT).T
    t = np.mean(MARKERS_BASE - MARKERS_CT @ R.T, axis=0)
    return R, R @ LESION_M_CT + t


def outward(R_base_ct, theta_deg, beta_deg):
    """u(theta, beta) in the base frame, (n, 3)."""
    theta, beta = np.radians(theta_deg), np.radians(np.atleast_1d(beta_deg))
    u = np.stack(
        [np.sin(theta) * np.cos(beta), np.sin(theta) * np.sin(beta), np.full_like(beta, np.cos(theta))], axis=1
    )
    return u @ R_base_ct.T


def directions(count, seed):
    """Random unit vectors of the upper half space, (n, 3)."""
    u = np.random.default_rng(seed).normal(size=(count, 3))
    u[:, 2] = np.abs(u[:, 2])
    return np.asarray(u / np.linalg.norm(u, axis=1, keepdims=True))


def request(u, standoff_mm=STANDOFF_MM):
    return ReachRequest(TARGET, u, TOOL.needle_length_mm, standoff_mm)


def reached(checker, count, seed):
    found = []
    for u in directions(60, seed):
        answer = assess_reach_all(checker, [request(u)])[0]
        if answer.reachable:
            found.append((request(u), answer))
        if len(found) == count:
            return found
    raise AssertionError("the scene must leave enough directions")


def ik_exists(model, target, u, *, needle_length_mm, standoff_mm, depths_mm=None):
    """Which directions ``u`` (n, 3) one and the same branch reaches at some depths, standoff and target if None.

    By the inverse kinematics of single poses, away from singularities; rolls and joint limits are not asked for.
    """
    u = np.atleast_2d(u)
    holds = np.ones((len(u), 8), bool)
    for depth in (0.0, standoff_mm) if depths_mm is None else depths_mm:
        q = inverse(model, flange_poses(target, u, needle_length_mm + standoff_mm - depth))
        holds &= singularity(model, q).least() > MIN_SINGULARITY
    return holds.any(axis=1)


@pytest.mark.parametrize("theta_deg", sorted(WINDOWS))
def test_the_windows_of_the_papers_placement(theta_deg):
    """Exactly the specification's windows with |sin q5| > .05; within 1 deg with all three singularities kept off."""
    R, target = paper_placement()
    u = outward(R, theta_deg, np.arange(360))
    q = inverse(UR3, flange_poses(target, u, 551.0))
    wrist_only = (singularity(UR3, q).wrist > 0.05).any(axis=1)
    assert runs(wrist_only) == WINDOWS[theta_deg]
    ours = runs(ik_exists(UR3, target, u, needle_length_mm=401.0, standoff_mm=150.0, depths_mm=(0.0,)))
    assert len(ours) == len(WINDOWS[theta_deg])
    assert np.abs(np.array(ours).reshape(-1) - np.array(WINDOWS[theta_deg]).reshape(-1)).max(initial=0) <= 1


@pytest.mark.parametrize("row", SHARES, ids=str)
def test_the_shares_of_the_reach_table(row):
    """Share of the cap of 60 deg that a UR3 holds: within 1 point with |sin q5| > .05, as the table counts.

    With the other two singularities kept off as well it stays within 3.
    """
    target, u = np.array([row.rho_mm, 0.0, row.z_mm]), cap(row.cap_axis_base)
    wrist = singularity(UR3, inverse(UR3, flange_poses(target, u, row.distance_mm))).wrist
    assert (wrist > 0.05).any(axis=1).mean() == pytest.approx(row.share, abs=0.01)
    exists = ik_exists(UR3, target, u, needle_length_mm=row.distance_mm, standoff_mm=0.0, depths_mm=(0.0,))
    assert exists.mean() == pytest.approx(row.share, abs=0.03)


def test_the_worked_example_of_the_paper_is_out_of_reach():
    """The flange would stand 701.9 mm from the shoulder; the answer says so. A UR5 has eight solutions there."""
    R, target = paper_placement()
    u = outward(R, 10.0, np.array([45.0]))[0]
    T = flange_poses(target, u, 551.0)[0]
    assert T[:3, 3] == pytest.approx([623.69, -313.01, 76.70], abs=0.006)
    assert np.linalg.norm(T[:3, 3] - UR3.shoulder_base) == pytest.approx(701.9, abs=0.05)
    checker = CellChecker(UR3, Tool(401.0, 150.0, 1.2, 30.0))
    answer = assess_reach_all(checker, [ReachRequest(target, u, 401.0, 150.0)])[0]
    assert not answer.reachable and answer.reason is Reason.UNREACHABLE and answer.depth_mm is None
    assert "701.9 mm from the shoulder" in answer.detail and "out of the arm's reach" in answer.detail
    assert not np.isnan(inverse(ur_model("ur5"), T)).any()


def test_a_reachable_answer_is_a_straight_clear_drive():
    """At every row the needle lies on its line, within limits, without contact; the tip ends on the target."""
    T_base_table = np.eye(4)
    T_base_table[2, 3] = -60.0
    table = Box("table", T_base_table, (2000.0, 2000.0, 100.0))
    checker = CellChecker(UR3, TOOL, [table])
    for asked, answer in reached(checker, 4, seed=1):
        depths, q = answer.insertion_depth_mm, answer.insertion_q
        assert depths[0] == 0.0 and depths[-1] == pytest.approx(STANDOFF_MM) and (np.diff(depths) > 0).all()
        assert answer.reason is Reason.NONE and answer.detail == ""
        distance = TOOL.needle_length_mm + STANDOFF_MM - depths
        expected = flange_poses(TARGET, asked.outward_base, distance, answer.roll)
        assert np.abs(flange_pose(UR3, q) - expected).max() < 1e-9
        tip = flange_pose(UR3, q[-1]) @ [0.0, 0.0, TOOL.needle_length_mm, 1.0]
        assert tip[:3] == pytest.approx(TARGET, abs=1e-9)
        assert UR3.within_limits(q).all()
        assert (singularity(UR3, q).least() > MIN_SINGULARITY).all()
        assert checker.sweep_mm(q).max() <= MAX_SWEEP_MM
        assert checker.contact(q[0], needle_may_touch_patient=False) is None
        assert all(checker.contact(row, needle_may_touch_patient=True) is None for row in q)
        assert answer.margin == pytest.approx(reach_margin(UR3, q)) and MIN_SINGULARITY < answer.margin <= 1.0
        with pytest.raises(ValueError, match="read-only"):
            q[0, 0] = 0.0


def test_in_an_empty_room_the_best_margin_wins():
    """A branch with a higher margin than the answer's was passed over only for a contact."""
    checker = CellChecker(UR3, Tool(200.0, 199.0, 0.1, 0.1))
    tried = 0
    for u in directions(12, seed=2):
        answer = assess_reach_all(checker, [request(u)])[0]
        if not answer.reachable:
            continue
        tried += 1
        paths = every_branch(UR3, needle_lines(TARGET[None], u[None])[0], 320.0 - np.linspace(0.0, STANDOFF_MM, 61))
        for path in paths[(singularity(UR3, paths).least() > MIN_SINGULARITY).all(axis=1)]:
            if reach_margin(UR3, path) > answer.margin + 0.01:
                assert any(checker.contact(row, needle_may_touch_patient=True) for row in path)
    assert tried >= 2


def test_a_drive_that_leaves_the_arms_reach_is_blocked_at_its_depth():
    """Standoff holds and the target does not: blocked by kinematics, at a depth before which the branch exists."""
    checker = CellChecker(UR3, Tool(200.0, 199.0, 0.1, 0.1))
    near_base, lengths = np.array([250.0, 0.0, 100.0]), {"needle_length_mm": 200.0, "standoff_mm": STANDOFF_MM}
    u = directions(400, seed=9)
    begins = ik_exists(UR3, near_base, u, depths_mm=(0.0,), **lengths)
    stuck = u[begins & ~ik_exists(UR3, near_base, u, **lengths)]
    assert len(stuck) >= 10
    for direction in stuck:
        answer = assess_reach_all(checker, [ReachRequest(near_base, direction, **lengths)])[0]
        assert answer.reason is Reason.INSERTION_BLOCKED and 0.0 <= answer.depth_mm <= STANDOFF_MM
        assert any(word in answer.detail for word in ("does not reach", "singularity", "jump"))
        assert ik_exists(UR3, near_base, direction, depths_mm=(0.0, max(0.0, answer.depth_mm - 2.0)), **lengths).all()


def test_what_kinematics_rejects_is_never_reached():
    """A False of the batch is final: the full answer for it is a refusal by kinematics."""
    checker = CellChecker(UR3, TOOL)
    u = directions(120, seed=3)
    might = ik_exists(UR3, TARGET, u, needle_length_mm=TOOL.needle_length_mm, standoff_mm=STANDOFF_MM)
    assert 20 < might.sum() < 100
    for direction in u[~might]:
        answer = assess_reach_all(checker, [request(direction)])[0]
        assert answer.reason in (Reason.UNREACHABLE, Reason.INSERTION_BLOCKED)
        assert "touches" not in answer.detail


def slab(u, start_mm, thickness_mm):
    """T_base_box of a plate square to the needle, from ``start_mm`` outward of the target."""
    return flange_poses(TARGET, u, start_mm + thickness_mm / 2.0)[0]


def test_the_holder_stops_at_the_skin_where_geometry_says():
    """Skin h above the target: the holder's end, r - depth + shaft away, meets it at depth r + shaft - h."""
    empty = CellChecker(UR3, TOOL)
    height, standoff = 170.0, 180.0  # the tip starts 10 mm outside the skin
    for u in directions(60, 5):
        if assess_reach_all(empty, [request(u, standoff)])[0].reachable:
            break
    plate = trimesh.creation.box(extents=(60.0, 60.0, 4.0), transform=slab(u, height - 4.0, 4.0))
    skin = TriangleMesh(np.asarray(plate.vertices), np.asarray(plate.faces))
    answer = assess_reach_all(CellChecker(UR3, TOOL, patient=skin), [request(u, standoff)])[0]
    assert answer.reason is Reason.INSERTION_BLOCKED and answer.detail.startswith("holder touches patient")
    exact = standoff + TOOL.shaft_mm - height
    assert exact - 1e-6 <= answer.depth_mm <= exact + MAX_SWEEP_MM


def test_a_plate_across_the_needles_way_blocks_at_its_depth():
    """A room's box is not skin: the tip meets it r - height deep, and the needle is named."""
    empty = CellChecker(UR3, TOOL)
    asked, _ = reached(empty, 1, seed=6)[0]
    plate = Box("plate", slab(asked.outward_base, 40.0, 5.0), (20.0, 20.0, 5.0))
    answer = assess_reach_all(CellChecker(UR3, TOOL, [plate]), [asked])[0]
    assert answer.reason is Reason.INSERTION_BLOCKED and answer.detail.startswith("needle touches plate")
    exact = STANDOFF_MM - 45.0
    assert exact - 1e-6 <= answer.depth_mm <= exact + MAX_SWEEP_MM


def test_an_obstacle_at_the_flange_is_a_collision_at_standoff():
    """A box about the standoff flange stops every branch and roll; link and box are named."""
    asked, _ = reached(CellChecker(UR3, TOOL), 1, seed=7)[0]
    lamp = Box("lamp", flange_poses(TARGET, asked.outward_base, 320.0)[0], (40.0, 40.0, 40.0))
    answer = assess_reach_all(CellChecker(UR3, TOOL, [lamp]), [asked])[0]
    assert answer.reason is Reason.ARM_COLLISION and answer.depth_mm is None and not answer.reachable
    assert "touches lamp at standoff" in answer.detail
    assert answer.insertion_q.shape == (0, 6) and answer.branch == -1 and answer.margin == 0.0


def test_another_roll_is_taken_where_one_meets_something():
    """A knob where the rim of wrist 3 ends up at roll 0: that roll is passed over, and the drive holds another."""
    asked, plain = reached(CellChecker(UR3, TOOL), 1, seed=7)[0]
    assert plain.roll == 0.0
    rim = collision_links(UR3)[6].mesh.vertices
    T_flange_knob = np.eye(4)
    T_flange_knob[:3, 3] = rim[np.argmin(rim[:, 1])]
    at_target = flange_poses(TARGET, asked.outward_base, TOOL.needle_length_mm)[0]
    knob = Box("knob", at_target @ T_flange_knob, (1.0, 1.0, 1.0))
    only_roll = assess_reach_all(CellChecker(UR3, TOOL, [knob]), [asked], n_rolls=1)[0]
    assert only_roll.reason is Reason.INSERTION_BLOCKED and only_roll.detail.startswith("wrist_3 touches knob")
    answer = assess_reach_all(CellChecker(UR3, TOOL, [knob]), [asked])[0]
    assert answer.reachable and answer.roll != 0.0
    distance = TOOL.needle_length_mm + STANDOFF_MM - answer.insertion_depth_mm
    expected = flange_poses(TARGET, asked.outward_base, distance, answer.roll)
    assert np.abs(flange_pose(UR3, answer.insertion_q) - expected).max() < 1e-9


def test_a_standoff_that_starts_inside_the_skin_is_a_collision():
    asked, _ = reached(CellChecker(UR3, TOOL), 1, seed=8)[0]
    ball = trimesh.creation.icosphere(subdivisions=3, radius=STANDOFF_MM + 5.0)
    skin = TriangleMesh(np.asarray(ball.vertices) + TARGET, np.asarray(ball.faces))
    answer = assess_reach_all(CellChecker(UR3, TOOL, patient=skin), [asked])[0]
    assert answer.reason is Reason.ARM_COLLISION and "patient at standoff" in answer.detail


class Unfolded(FastChecker):
    """Never says that an arm is folded: of each motion its contacts are checked."""

    def folded(self, q):
        return np.zeros(len(q), np.bool_)


def test_branches_on_which_the_arm_is_folded_are_passed_over_and_change_no_answer():
    """The same answers, to the bit, as where each of their motions is tried."""
    ball = trimesh.creation.icosphere(radius=80.0)
    skin = TriangleMesh(ball.vertices + TARGET - [0.0, 0.0, 90.0], np.asarray(ball.faces))
    requests = [request(u, 60.0) for u in directions(150, 4)]
    with_it, without = (kind(UR3, TOOL, patient=skin, padding_mm=2.0) for kind in (FastChecker, Unfolded))
    answers = assess_reach_all(with_it, requests)
    for answer, expected in zip(answers, assess_reach_all(without, requests), strict=True):
        assert (answer.reason, answer.detail, answer.contact) == (expected.reason, expected.detail, expected.contact)
        assert (answer.branch, answer.depth_mm) == (expected.branch, expected.depth_mm)
        np.testing.assert_array_equal(answer.insertion_q, expected.insertion_q)
    starts = [answer.insertion_q[0] for answer in answers if answer.reachable]
    assert not with_it.folded(np.array(starts)).any() and 5 < len(starts) < 145


@pytest.mark.parametrize("roll", np.linspace(0.0, 2 * np.pi, 5))
def test_the_roll_is_joint_six_alone(roll):
    """Turning the flange about the needle adds to q6 and moves no other joint; tip and axis stay."""
    u = next(d for d in directions(60, 1) if ik_exists(UR3, TARGET, d, needle_length_mm=200.0, standoff_mm=120.0)[0])
    plain, turned = (inverse(UR3, flange_poses(TARGET, u, 320.0, angle))[0] for angle in (0.0, roll))
    assert np.array_equal(np.isnan(plain), np.isnan(turned))
    difference = np.exp(1j * (turned - plain)[~np.isnan(plain[:, 0])])
    assert len(difference) >= 2
    assert np.max(np.abs(difference[:, :5] - 1.0)) < 1e-9
    assert np.max(np.abs(difference[:, 5] - np.exp(1j * roll))) < 1e-9


def test_the_samples_are_those_of_the_plain_loop():
    """Depths as ``np.linspace`` has them, states as ``fill_branch_path``, as many as the largest motion asks for."""
    swept, rng = SweptBodies.of(UR3, TOOL), np.random.default_rng(5)
    ended = 0
    for _ in range(200):
        u = rng.normal(size=3)
        line = needle_lines(TARGET[None], u[None] / np.linalg.norm(u))[0]
        branch, turn, standoff = int(rng.integers(8)), rng.normal(size=6), float(rng.uniform(20.0, 200.0))
        lengths = TOOL.needle_length_mm, standoff
        count = math.ceil(standoff / MAX_SWEEP_MM) + 1
        found_q, found_depths = sampled(swept, line, branch, turn, lengths, count, MAX_SWEEP_MM)
        while True:
            depths = np.linspace(0.0, standoff, count)
            q = np.empty((len(depths), 6))
            fill_branch_path(UR3.lengths, *line, sum(lengths) - depths, branch, turn, q)
            if not (worst := swept.bounds_mm(q).max()) > MAX_SWEEP_MM:
                break
            count = math.ceil((count - 1) * worst / MAX_SWEEP_MM) + 1
        ended += bool(np.isnan(q).any())
        assert np.array_equal(found_depths, depths) and np.array_equal(found_q, q, equal_nan=True)
    assert 20 < ended < 180


def test_how_far_a_path_may_have_moved_is_the_sum_of_its_bounds():
    swept = SweptBodies.of(UR3, TOOL, 5.0)
    path = np.random.default_rng(6).uniform(-3.0, 3.0, (30, 6))
    frames, moved, rotated = swept.moving(path)
    assert np.array_equal(frames, link_poses(UR3, path))
    assert not moved[0].any() and not moved[:, 0].any() and not rotated[0].any()
    assert np.array_equal(moved[1:, 1:], np.cumsum(swept.bounds_mm(path), axis=0))
    assert np.array_equal(rotated[1:], np.cumsum(np.abs(np.diff(path, axis=0)), axis=0))


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


@pytest.mark.parametrize(("shaft", "warned"), [(80.0, True), (95.0, False)])
def test_a_needle_shorter_than_the_shortest_way_is_a_warning(tmp_path, shaft, warned):
    """The skin is 90 mm away in every direction: a shaft of 80 mm reaches it nowhere."""
    path = write_case(tmp_path, ("shaft_mm = 150.0", f"shaft_mm = {shaft}"))
    found = [warning for warning in prepare(path, arm=False).anatomy.warnings if "every path is too long" in warning]
    assert len(found) == warned
    assert all("the needle's longest path is 80 mm, and the skin is 8" in warning for warning in found)


def test_a_standoff_too_short_for_the_way_is_the_same(tmp_path):
    """With a fixed standoff the tip must still wait outside of the skin."""
    path = write_case(tmp_path, ("diameter_mm = 1.2", "diameter_mm = 1.2\nstandoff_mm = 90.0"))
    assert any("longest path is 80 mm" in warning for warning in prepare(path, arm=False).anatomy.warnings)


def test_a_needle_too_short_for_most_directions_is_said_after_the_search(tmp_path, capfd):
    off = ("position_mm = [0.0, 0.0, 0.0]", "position_mm = [0.0, 15.0, 0.0]")
    path = write_case(tmp_path, off, ("shaft_mm = 150.0", "shaft_mm = 80.0"), ("[0, 10]", "[0, 180]"))
    command = ["search", str(path), "--no-arm", "--no-pictures", "--out", str(tmp_path / "out")]
    main(command)
    said = capfd.readouterr().out
    assert "the needle is too short for " in said
    main([*command, "--json"])
    found = json.loads(capfd.readouterr().out)
    assert found["counts"]["too_long"] > found["directions"] / 2
    text = f"the needle is too short for {found['counts']['too_long']} of {found['directions']} directions"
    assert any(text in warning for warning in found["warnings"])


def test_check_says_how_deep_the_target_lies_in_its_structure(tmp_path, capfd):
    """A ball of 20 mm about a target 15 mm from its middle: 5 mm below the surface, as its triangles have it."""
    path = write_case(tmp_path, ("position_mm = [0.0, 0.0, 0.0]", "position_mm = [0.0, 15.0, 0.0]"))
    main(["check", str(path), "--theta", "0", "--beta", "0", "--no-arm", "--json"])
    assert json.loads(capfd.readouterr().out)["target_depth_mm"] == pytest.approx(5, abs=0.5)
    main(["check", str(path), "--theta", "0", "--beta", "0", "--no-arm"])
    assert "mm below the surface of organ" in capfd.readouterr().out


def test_a_target_outside_says_by_how_much(tmp_path):
    """Ten mm beyond a ball of 20 mm."""
    path = write_case(tmp_path, ("position_mm = [0.0, 0.0, 0.0]", "position_mm = [0.0, 30.0, 0.0]"))
    with refused("target_misplaced", "organ"):
        prepare(path, arm=False)
