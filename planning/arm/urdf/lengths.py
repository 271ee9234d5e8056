"""Denavit-Hartenberg lengths and joint limits of an arm built as a UR, from its URDF; another arm is refused.

`arm_chain` finds the six rotating joints, one after another from the root to the flange; `ur_lengths` compares their
axes at the angle zero with a UR's, and names the joint that differs. In the controller's base frame (see
`planning.arm.ur`) these are: axis 1 along z through the origin; axes 2, 3 and 4 along -y at the heights d1, at x = 0,
a2 and a2 + a3; axis 5 along -z at x = a2 + a3, y = -d4; axis 6 along -y at the height d1 - d5; the flange d6 farther,
its z along axis 6, its x along x. Joint limits are its own, or narrower ones that the case states; none is guessed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.urdf.document import UrdfDocument, UrdfJoint, UrdfLink
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose, rotation_angle

SQUARE_RAD = 1e-4
"""How far an axis may be from where a UR has it: 1.5708 for a right angle is off by 4e-6, 1.57 by 8e-4."""
OFF_MM = 0.05
"""mm by which an axis' place and the flange's may be off: what a UR repeats. Rounded angles leave 0.005 mm at a
metre."""
DIGITS_MM = 6
"""Decimals of a length: a URDF's right angles are rounded, so that its chain gives 89.15899999999999."""
DIGITS_TURN = 9
"""Decimals of the base's rotation, for the same reason."""
BASE = "base"
"""The link that ROS has for the controller's base frame."""
DIRECTIONS = np.array([[0, 0, 1], [0, -1, 0], [0, -1, 0], [0, -1, 0], [0, 0, -1], [0, -1, 0]], dtype=np.float64)
"""Directions of a UR's six axes at the angle zero, base frame."""
R_BASE_FLANGE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Orientation of a UR's flange at the angle zero, base frame."""
AS_UR = "six axes like a UR's, with the same zero and sense of rotation (docs/how-to/own-arm.md)"


class UrLengths(NamedTuple):
    """Denavit-Hartenberg lengths of a chain that is a UR's, and its root in the controller's base frame."""

    lengths_mm: tuple[float, ...]  # d1, a2, a3, d4, d5, d6
    T_base_root: Floats  # shape (4, 4), mm: the URDF's root in the controller's base frame


class _Axes(NamedTuple):
    """The six axes and the flange at the angle zero."""

    points: Floats  # shape (6, 3), mm
    directions: Floats  # shape (6, 3), unit
    T_flange: Floats  # shape (4, 4), mm

    def moved(self, T: Floats) -> _Axes:
        """The axes in another frame."""
        return _Axes(apply(T, self.points), self.directions @ T[:3, :3].T, T @ self.T_flange)


def ur_lengths(chain: ArmChain, document: UrdfDocument, T_base_root: Floats | None = None) -> UrLengths:
    """The Denavit-Hartenberg lengths of a chain, and where its root is in the controller's base frame.

    Args:
        T_base_root: Where its root is, if another source says it: shape (4, 4), mm.

    Raises:
        InputError: It is not built as a UR, or does not say which frame its controller's base is.
    """
    axes = _axes(chain)
    T_base_root = _base(chain, axes, document) if T_base_root is None else T_base_root
    axes = axes.moved(T_base_root)
    for joint, (direction, wanted) in enumerate(zip(axes.directions, DIRECTIONS, strict=True)):
        if np.linalg.norm(direction - wanted) > SQUARE_RAD:
            x, y, z = np.round(direction, 4) + 0.0
            as_ur = ", ".join(f"{value:g}" for value in wanted)
            what = f"points along ({x:g}, {y:g}, {z:g}) of the base at angle zero; a UR's points along ({as_ur})"
            raise _other(chain, joint, what, document)
    p, flange = axes.points, axes.T_flange
    d1, d4, fifth = p[1, 2], -p[4, 1], p[5, 2]
    a2, a3, d5, d6 = p[2, 0], p[3, 0] - p[2, 0], d1 - fifth, -flange[1, 3] - d4
    _check_places(chain, axes, document)
    lengths = tuple(round(float(length), DIGITS_MM) for length in (d1, a2, a3, d4, d5, d6))
    for name, length, sign in zip(("d1", "a2", "a3", "d4", "d5", "d6"), lengths, (1, -1, -1, 1, 1, 1), strict=True):
        if not sign * length > OFF_MM:
            what = f"its length {name} is {length:g} mm (flange '{chain.flange}')"
            refuse(what, document.where, f"{'above' if sign > 0 else 'below'} 0, as in a UR", "arm_not_as_ur")
    return UrLengths(lengths, T_base_root)


def _axes(chain: ArmChain) -> _Axes:
    """The six axes and the flange at the angle zero, in the root's frame."""
    poses = chain.body_poses(np.eye(4), np.zeros(len(chain.joints)))
    directions = np.stack([T[:3, :3] @ joint.axis for T, joint in zip(poses[1:], chain.joints, strict=True)])
    return _Axes(poses[1:, :3, 3], directions, poses[-1] @ chain.T_body_flange)


def _base(chain: ArmChain, axes: _Axes, document: UrdfDocument) -> Floats:
    """T_base_root: the frame whose z is axis 1 and whose -y is axis 2 at the angle zero, if the URDF says so."""
    first, second = axes.directions[:2]
    if abs(first @ second) > SQUARE_RAD:
        raise _other(chain, 1, "is not at a right angle to the axis before it", document)
    stated = {member.link.name: member.T_body_link for member in chain.bodies[0]}
    root = chain.bodies[0][0].link.name
    name = BASE if BASE in stated else root
    y = -second
    R = np.round(np.stack([np.cross(y, first), y, first]), DIGITS_TURN) + 0.0
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, np.round(-R @ stated[name][:3, 3], DIGITS_MM) + 0.0
    difference = T @ stated[name]
    angle = rotation_angle(difference[:3, :3])
    if angle > SQUARE_RAD:
        what = f"link '{name}' is rotated by {np.degrees(angle):.4g} degrees from a UR controller's base"
        allowed = (
            "a link 'base', fixed to the root, with z along axis 1 and -y along axis 2 at angle zero "
            '(ur_description: rpy="0 0 3.141592653589793")'
        )
        refuse(what, document.where, allowed, "arm_not_as_ur")
    return T


def _check_places(chain: ArmChain, axes: _Axes, document: UrdfDocument) -> None:
    """Refuse an axis that passes elsewhere than a UR's of these lengths; along itself it may begin anywhere."""
    p, T = axes.points, axes.T_flange
    wanted = {0: (0, 0, None), 1: (0, None, p[1, 2]), 2: (p[2, 0], None, p[1, 2]), 3: (p[3, 0], None, p[1, 2])}
    wanted |= {4: (p[3, 0], p[4, 1], None), 5: (p[3, 0], None, p[5, 2])}
    for joint, place in wanted.items():
        off = [0.0 if want is None else float(at - want) for at, want in zip(p[joint], place, strict=True)]
        if np.linalg.norm(off) > OFF_MM:
            by = ", ".join(f"{value:.4g}" for value in off)
            what = f"passes {np.linalg.norm(off):.4g} mm away from a UR's axis, by ({by}) mm in the base"
            raise _other(chain, joint, what, document)
    off = [float(T[0, 3] - p[3, 0]), 0.0, float(T[2, 3] - p[5, 2])]
    off_angle = rotation_angle(R_BASE_FLANGE.T @ T[:3, :3])
    if np.linalg.norm(off) > OFF_MM or off_angle > SQUARE_RAD:
        what = (
            f"the flange '{chain.flange}' is {np.linalg.norm(off):.4g} mm off axis 6 and rotated by "
            f"{np.degrees(off_angle):.4g} degrees from a UR's"
        )
        refuse(what, document.where, f"a link like a UR's tool0; {AS_UR}", "arm_not_as_ur")


def _other(chain: ArmChain, joint: int, what: str, document: UrdfDocument) -> InputError:
    sentence = f"axis {joint + 1} ('{chain.joints[joint].name}') {what}"
    return InputError(sentence, where=document.where, allowed=AS_UR, code="arm_not_as_ur")


MOST_RAD = 4.0 * math.pi
"""Beyond two whole turns either way a limit is in degrees, or is none."""
MOST_RAD_S = 4.0 * math.pi
"""Twice as fast as any joint of a UR: beyond, a speed is in degrees."""
ROUNDING_RAD = 1e-4
"""rad by which a stated limit may exceed the URDF's: 6.2832 for a whole turn."""


class JointLimits(NamedTuple):
    """Angle, speed and torque limits of six joints."""

    angles: Floats  # shape (6, 2), rad
    speeds: Floats  # shape (6,), rad/s
    torques: Floats  # shape (6,), N m


class StatedLimits(NamedTuple):
    """Limits that a case states; None where it leaves them to the arm."""

    angles: Floats | None = None  # shape (6, 2), rad
    speeds: Floats | None = None  # shape (6,), rad/s


NOTHING_STATED = StatedLimits()


def urdf_limits(joints: tuple[UrdfJoint, ...], stated: StatedLimits, where: Path) -> JointLimits:
    """The limits of a URDF's six joints; what the case states of them takes the place of what the URDF lacks.

    Raises:
        InputError: A limit is missing, is in degrees, or makes no sense.
    """
    angles, speeds, torques = np.empty((6, 2)), np.empty(6), np.empty(6)
    for row, joint in enumerate(joints):
        joint_place = f"{where}: joint '{joint.name}'"
        lacking = joint.kind == "continuous" or not {"lower", "upper"} <= set(joint.limits)
        angles[row] = (-MOST_RAD, MOST_RAD) if stated.angles is not None and lacking else _angles(joint, joint_place)
        speeds[row] = _above_zero(joint, "velocity", joint_place, "rad/s", MOST_RAD_S)
        torques[row] = _above_zero(joint, "effort", joint_place, "N m", math.inf)
    return JointLimits(angles, speeds, torques)


def narrowed(known: JointLimits, stated: StatedLimits, where: str) -> JointLimits:
    """The limits with what a case states in their place.

    Raises:
        InputError: A stated limit is wider than the arm's own.
    """
    angles, speeds = known.angles, known.speeds
    if stated.angles is not None:
        wider = (stated.angles[:, 0] < angles[:, 0] - ROUNDING_RAD) | (
            stated.angles[:, 1] > angles[:, 1] + ROUNDING_RAD
        )
        if wider.any():
            joint = int(np.argmax(wider))
            low, high = np.degrees(angles[joint])
            what = f"the angles of joint {joint + 1} exceed the arm's own range"
            refuse(what, where, f"from {low:g} to {high:g} degrees", "limit_beyond_arm")
        angles = stated.angles
    if stated.speeds is not None:
        faster = stated.speeds > speeds + ROUNDING_RAD
        if faster.any():
            joint = int(np.argmax(faster))
            allowed = f"at most {np.degrees(speeds[joint]):g} degrees/s"
            refuse(f"the speed of joint {joint + 1} exceeds the arm's own", where, allowed, "limit_beyond_arm")
        speeds = stated.speeds
    return JointLimits(angles, speeds, known.torques)


def _angles(joint: UrdfJoint, where: str) -> tuple[float, float]:
    if joint.kind == "continuous":
        refuse("it is continuous, without limits", where, "revolute, or [robot.limits]", "missing_limits")
    if not {"lower", "upper"} <= set(joint.limits):
        refuse("<limit> lacks lower or upper", where, "lower and upper, in rad; or [robot.limits]", "missing_limits")
    low, high = joint.limits["lower"], joint.limits["upper"]
    if not low < high:
        refuse(f"limits from {low:g} to {high:g}", where, "lower less than upper, in rad", "out_of_range")
    if max(-low, high) > MOST_RAD:
        what = f"limits from {low:g} to {high:g} rad, which look like degrees"
        refuse(what, where, f"rad, at most {MOST_RAD:.2f} either way", "wrong_unit")
    return low, high


def _above_zero(joint: UrdfJoint, key: str, where: str, unit: str, most: float) -> float:
    value = joint.limits.get(key, 0.0)
    if not 0.0 < value <= most:
        allowed = f"above 0{'' if math.isinf(most) else f', at most {most:.2f}'} {unit}"
        refuse(f'<limit {key}="{value:g}">', where, allowed, "out_of_range")
    return value


JOINT_COUNT = 6

TURNING = ("revolute", "continuous")
"""Joints that an arm of UR geometry has; a continuous one needs limits from elsewhere."""


@dataclass(frozen=True, eq=False)
class Member:
    """A link of one of the arm's seven rigid bodies, with what is fixed to it."""

    link: UrdfLink
    T_body_link: Floats  # shape (4, 4), mm, in the frame of the body's first link


@dataclass(frozen=True, eq=False)
class ArmChain:
    """An arm as a chain of seven rigid bodies."""

    joints: tuple[UrdfJoint, ...]  # the six joints, from the base on
    T_body_joint: Floats
    """Shape (6, 4, 4), mm: each joint's frame at the angle zero, in that of the body before it."""
    bodies: tuple[tuple[Member, ...], ...]
    """For each of the seven bodies its links: the one that the joint moves (or the root) first."""
    flange: str  # the link in whose frame the needle is mounted
    T_body_flange: Floats  # shape (4, 4), mm, in the frame of the last body
    beyond: frozenset[str]  # names of links that are fixed to the flange

    def body_poses(self, T_base_root: Floats, q: Floats) -> Floats:
        """T_base_body of the seven bodies at a configuration (6,), rad, shape (7, 4, 4), mm."""
        poses = [T_base_root]
        for joint, T, angle in zip(self.joints, self.T_body_joint, q, strict=True):
            poses.append(poses[-1] @ T @ pose(exp_rotation(joint.axis * angle), np.zeros(3)))
        return np.stack(poses)


def arm_chain(document: UrdfDocument, flange: str) -> ArmChain:
    """The chain from the URDF's root to the flange.

    Raises:
        InputError: There is no such link, the links are no tree, or other joints than six that turn.
    """
    where = document.where
    if flange not in document.links:
        allowed = f"[robot] flange, one of {', '.join(document.links)}"
        refuse(f"there is no link '{flange}' to be the flange", where, allowed, "unknown_link")
    above = _parents(document)
    links = reversed([flange, *_ancestors(above, flange)])
    turning = [above[name] for name in links if name in above and above[name].kind != "fixed"]
    for joint in document.joints:
        if joint.kind != "fixed" and joint not in turning:
            what = f"joint '{joint.name}' ({joint.kind}) moves a part outside the chain to the flange '{flange}'"
            refuse(what, where, "six revolute joints; all others fixed", "moving_branch")
    if len(turning) != JOINT_COUNT or any(joint.kind not in TURNING for joint in turning):
        names = ", ".join(f"{joint.name} ({joint.kind})" for joint in turning) or "none"
        refuse(f"the moving joints are {names}", where, "six revolute joints in a row", "not_six_joints")
    bodies, places = _bodies(document, above, turning)
    to_joint = [places[joint.parent] @ joint.T_parent_child for joint in turning]
    beyond = frozenset(name for name in document.links if name != flange and flange in _ancestors(above, name))
    return ArmChain(tuple(turning), np.stack(to_joint), bodies, flange, places[flange], beyond)


def _parents(document: UrdfDocument) -> dict[str, UrdfJoint]:
    """The parent joint of each link; the root has none."""
    above: dict[str, UrdfJoint] = {}
    for joint in document.joints:
        if joint.child in above:
            what = f"link '{joint.child}' has two parent joints, '{above[joint.child].name}' and '{joint.name}'"
            refuse(what, document.where, "a tree of links", "not_a_tree")
        above[joint.child] = joint
    roots = [name for name in document.links if name not in above]
    if len(roots) != 1 or any(roots[0] not in (name, *_ancestors(above, name)) for name in document.links):
        what = f"it is not a tree: links without a parent joint: {', '.join(roots) or 'none'}"
        refuse(what, document.where, "one root, and a tree of links below it", "not_a_tree")
    return above


def _ancestors(above: Mapping[str, UrdfJoint], name: str) -> list[str]:
    """The links above one, the nearest first; a ring ends where it closes."""
    ancestors: list[str] = []
    while name in above and above[name].parent not in ancestors:
        name = above[name].parent
        ancestors.append(name)
    return ancestors


def _bodies(
    document: UrdfDocument, above: Mapping[str, UrdfJoint], turning: list[UrdfJoint]
) -> tuple[tuple[tuple[Member, ...], ...], dict[str, Floats]]:
    """The links of each rigid body, and where each link is in its body."""
    bodies: list[list[Member]] = [[] for _ in range(JOINT_COUNT + 1)]
    places: dict[str, Floats] = {}
    numbers: dict[str, int] = {}
    for name in sorted(document.links, key=lambda name: len(_ancestors(above, name))):  # parents first
        joint = above.get(name)
        if joint is None or joint in turning:
            numbers[name] = 0 if joint is None else turning.index(joint) + 1
            places[name] = np.eye(4)
        else:
            numbers[name] = numbers[joint.parent]
            places[name] = places[joint.parent] @ joint.T_parent_child
        bodies[numbers[name]].append(Member(document.links[name], places[name]))
    return tuple(map(tuple, bodies)), places
