"""Kinematics of the UR family: laws, the ur-analytic-ik package as oracle, and the URDF's own joint chain."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from refusals import refused

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits, wrap_to_pi, wrapped_solutions
from puncture_twin.planning.arm.kinematics import flange_pose, jacobian, link_poses, singularity
from puncture_twin.planning.arm.links import LINK_NAMES, collision_links, model_urdf, visual_links
from puncture_twin.planning.arm.ur import UR_MODELS, ur_model

EXACT = 1e-9
"""mm and radian parts alike: the kinematics' promise."""

joints = st.lists(st.floats(-np.pi, np.pi), min_size=6, max_size=6).map(np.array)
models = st.sampled_from(sorted(UR_MODELS))


def in_mm(T_m):
    """A pose of the oracle, in metres, in mm."""
    T = np.array(T_m)
    T[:3, 3] *= 1000.0
    return T


def in_m(T_mm):
    """A pose of ours as the oracle wants it."""
    T = np.array(T_mm, order="C")
    T[:3, 3] /= 1000.0
    return T


@given(name=models, q=joints)
@settings(max_examples=150, deadline=None)
def test_every_solution_returns_the_pose_and_the_configuration_is_found(name, q):
    """FK(IK(x)) = x on every branch, singular poses included; and a pose that came from somewhere has a solution.

    But for an aligned wrist, where q6 is free and the 0 that is taken need not be one that reaches, and a stretched arm
    with an all but aligned wrist, which rounding may push out of reach.
    """
    model = ur_model(name)
    T = flange_pose(model, q)
    solutions = inverse(model, T)[0]
    found = solutions[~np.isnan(solutions[:, 0])]
    far = singularity(model, q)
    assert len(found) >= 1 or far.wrist < 1e-9 or (far.elbow < 1e-3 and far.wrist < 1e-3)
    assert np.abs(flange_pose(model, found) - T).max(initial=0.0) < EXACT
    assert (found > -np.pi).all() and (found <= np.pi).all()
    if far.least() > 1e-3:
        assert np.abs(wrap_to_pi(found - q)).max(axis=1).min() < 1e-6


def oracle_of(name):
    """An arm of ur-analytic-ik, of which there is no wheel after Python 3.11."""
    return getattr(pytest.importorskip("ur_analytic_ik", exc_type=ModuleNotFoundError), name)


@pytest.mark.parametrize("name", sorted(UR_MODELS))
def test_forward_kinematics_agrees_with_the_oracle(name):
    """Our DH numbers and frames are those of ur-analytic-ik, for all six arms."""
    oracle = oracle_of(name)
    for q in np.random.default_rng(1).uniform(-2 * np.pi, 2 * np.pi, (100, 6)):
        assert np.abs(in_mm(oracle.forward_kinematics(*q)) - flange_pose(ur_model(name), q)).max() < EXACT


@pytest.mark.parametrize(
    ("name", "count"), [("ur3", 2000), ("ur3e", 300), ("ur5", 300), ("ur5e", 300), ("ur10", 300), ("ur10e", 300)]
)
def test_nothing_is_missed_against_the_oracle(name, count):
    """Every solution of ur-analytic-ik is one of our eight, on reachable and unreachable poses alike."""
    model, oracle = ur_model(name), oracle_of(name)
    rng = np.random.default_rng(2)
    poses = flange_pose(model, rng.uniform(-np.pi, np.pi, (count, 6)))
    poses[::4, :3, 3] *= rng.uniform(0.3, 1.4, (len(poses[::4]), 1))  # some of these are out of reach
    solved = 0
    for T, ours in zip(poses, inverse(model, poses), strict=True):
        theirs = oracle.inverse_kinematics(in_m(T))
        found = ours[~np.isnan(ours[:, 0])]
        assert len(found) >= len(theirs)
        for q in theirs:
            assert np.abs(wrap_to_pi(found - np.asarray(q))).max(axis=1).min() < 1e-5
        solved += bool(theirs)
    assert 0.75 * count <= solved < count


def test_batch_and_single_poses_agree():
    """One call with many poses gives what many calls with one pose give."""
    model = ur_model("ur3")
    poses = flange_pose(model, np.random.default_rng(3).uniform(-np.pi, np.pi, (20, 6)))
    one_by_one = np.concatenate([inverse(model, T) for T in poses])
    assert np.array_equal(inverse(model, poses), one_by_one, equal_nan=True)


@given(name=models, q=joints)
@settings(max_examples=60, deadline=None)
def test_jacobian_is_the_derivative_of_the_pose(name, q):
    """Central differences of position and rotation agree with the Jacobian's columns."""
    model, step = ur_model(name), 1e-5
    J = jacobian(model, q)
    T = flange_pose(model, q)
    for joint in range(6):
        ahead, behind = (flange_pose(model, q + sign * step * np.eye(6)[joint]) for sign in (1, -1))
        rate = (ahead - behind) / (2 * step)
        spin = rate[:3, :3] @ T[:3, :3].T
        assert np.abs(J[:3, joint] - rate[:3, 3]).max() < 1e-4
        assert np.abs(J[3:, joint] - [spin[2, 1], spin[0, 2], spin[1, 0]]).max() < 1e-8


@given(name=models, q=joints)
@settings(max_examples=60, deadline=None)
def test_the_three_singularities_are_all_there_are(name, q):
    """|det J| = a2 a3 L |shoulder elbow wrist|, L the longest in-plane reach: no other factor can vanish."""
    model = ur_model(name)
    far = singularity(model, q)
    longest = abs(model.a2) + abs(model.a3) + model.d5
    expected = model.a2 * model.a3 * longest * far.shoulder * far.elbow * far.wrist
    J = jacobian(model, q)
    J[:3] /= longest  # of one size with the rest
    with np.errstate(divide="ignore"):  # LAPACK divides by a zero pivot on its way to a determinant of 0
        determinant = abs(np.linalg.det(J)) * longest**3
    assert abs(determinant - expected) < 1e-9 * model.a2 * model.a3 * longest


@pytest.mark.parametrize(
    ("q", "name"),
    [
        ([0.3, -1.0, 1.2, 0.4, 0.0, 0.7], "wrist"),
        ([0.3, -1.0, 1.2, 0.4, np.pi, 0.7], "wrist"),
        ([0.3, -1.0, 0.0, 0.4, 0.9, 0.7], "elbow"),
        ([0.3, -np.pi / 2 - 0.2, 0.4, np.nan, 0.9, 0.7], "shoulder"),
    ],
)
def test_singular_configurations_are_named_and_still_solved(q, name):
    """The distance is 0, it is named, and the solutions still return the pose.

    The shoulder's: the wrist stands above axis 1, with q4 from a2 cos q2 + a3 cos q23 + d5 sin q234 = 0.
    """
    model = ur_model("ur3")
    if name == "shoulder":
        q23 = q[1] + q[2]
        q[3] = np.arcsin(-(model.a2 * np.cos(q[1]) + model.a3 * np.cos(q23)) / model.d5) - q23
    assert getattr(singularity(model, np.array(q)), name) < 1e-12
    assert singularity(model, np.array(q)).nearest == name
    T = flange_pose(model, np.array(q))
    solutions = inverse(model, T)[0]
    found = solutions[~np.isnan(solutions[:, 0])]
    assert len(found) and np.abs(flange_pose(model, found) - T).max() < EXACT


@given(q=st.lists(st.floats(-np.pi, np.pi), min_size=6, max_size=6).map(np.array), reference=joints)
@example(q=np.array([0.0, 0.0, 3.1415926535897927, 0.0, 0.0, 0.0]), reference=np.zeros(6))  # rounds beyond the limit
@settings(max_examples=60, deadline=None)
def test_whole_turns_stay_within_limits_and_come_nearest(q, reference):
    """Of all the wrapped solutions the nearest to the reference is the one returned, joint by joint."""
    model = ur_model("ur3")
    reference = 2.0 * reference
    every = wrapped_solutions(model, q)
    nearest = nearest_within_limits(model, q, reference)
    assert len(every) >= 2**5 and model.within_limits(every).all() and model.within_limits(nearest)
    assert np.abs(flange_pose(model, every) - flange_pose(model, q)).max() < EXACT
    assert np.abs(nearest - reference).sum() == pytest.approx(np.abs(every - reference).sum(axis=1).min(), abs=1e-9)


def test_an_elbow_beyond_its_limit_has_no_turn_that_saves_it():
    """The elbow has half the range of the others: no whole turn fits, and the row is NaN."""
    q = np.array([0.0, 0.0, np.pi + 0.1, 0.0, 0.0, 0.0])
    model = ur_model("ur3")
    tight = nearest_within_limits(model, q, np.zeros(6))
    assert tight[2] == pytest.approx(-np.pi + 0.1)
    q[2] = np.nan
    assert np.isnan(nearest_within_limits(model, q, np.zeros(6))).all()


@pytest.mark.parametrize("name", sorted(UR_MODELS))
def test_link_frames_agree_with_the_urdf(name):
    """Each URDF link frame keeps a constant place in ours at any angles, so one constant motion converts its meshes.

    The URDFs write pi with eleven decimals, those of the e-Series with nine: 1e-9 rad over a metre, several times.
    """
    model = ur_model(name)
    constant = np.linalg.inv(link_poses(model, np.zeros(6))) @ model_urdf(model).body_poses(np.zeros(6))
    for q in np.random.default_rng(6).uniform(-2 * np.pi, 2 * np.pi, (20, 6)):
        assert np.abs(link_poses(model, q) @ constant - model_urdf(model).body_poses(q)).max() < (
            5e-7 if name.endswith("e") else 5e-8
        )


def test_the_urdf_base_is_half_a_turn_from_the_controllers():
    """At zero a UR3 points along -x of its controller's base and +x of its URDF's."""
    flange = flange_pose(ur_model("ur3"), np.zeros(6))[:3, 3]
    assert flange == pytest.approx([-456.9, -194.25, 66.55])


def test_meshes_are_in_millimetres_and_named():
    """Seven links, sizes of a real UR3, hulls around the detailed meshes."""
    model = ur_model("ur3")
    hulls, details = collision_links(model), visual_links(model)
    assert [link.name for link in hulls] == [link.name for link in details] == list(LINK_NAMES)
    lengths = {link.name: float(np.ptp(link.mesh.bounds, axis=0).max()) for link in hulls}
    assert lengths["upper_arm"] == pytest.approx(328.2, abs=0.2) and lengths["forearm"] == pytest.approx(282.8, abs=0.2)
    for hull, detail in zip(hulls, details, strict=True):
        assert np.allclose(hull.mesh.bounds, detail.mesh.bounds, atol=1e-6)


def test_unknown_models_and_models_without_meshes_are_refused():
    with refused("unknown_robot"):
        ur_model("kuka")
    with refused("no_link_meshes", "ur10", "ur10e", "ur3", "ur3e", "ur5", "ur5e"):
        collision_links(replace(ur_model("ur3e"), name="ur16e"))


def test_models_cannot_be_changed():
    """Their arrays are read-only, limits are +-360 deg but for the elbow, speeds are per joint."""
    model = ur_model("UR3")
    with pytest.raises(ValueError, match="read-only"):
        model.joint_limits[0, 0] = 0.0
    assert np.degrees(model.joint_limits[:, 1]).tolist() == pytest.approx([360, 360, 180, 360, 360, 360])
    assert np.degrees(model.max_speeds).tolist() == pytest.approx([180, 180, 180, 360, 360, 360])
