"""Which joints of a URDF are the arm: six that turn, one after another from the root to the flange, and fixed ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.urdf.document import UrdfDocument, UrdfJoint, UrdfLink
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.rotations import exp_rotation

JOINT_COUNT = 6

TURNING = ("revolute", "continuous")
"""Joints that an arm of UR geometry has; a continuous one needs limits from elsewhere."""


@dataclass(frozen=True, eq=False)
class Member:
    """A link of one of the arm's seven rigid bodies, with what is fixed to it.

    Attributes:
        link: The link.
        T_body_link: Shape (4, 4), mm, in the frame of the body's first link.
    """

    link: UrdfLink
    T_body_link: Floats


@dataclass(frozen=True, eq=False)
class ArmChain:
    """An arm as a chain of seven rigid bodies.

    Attributes:
        joints: The six joints, from the base on.
        T_body_joint: Shape (6, 4, 4), mm: each joint's frame at the angle zero, in that of the body before it.
        bodies: For each of the seven bodies its links: the one that the joint moves (or the root) first.
        flange: The link in whose frame the needle is mounted.
        T_body_flange: Shape (4, 4), mm, in the frame of the last body.
        beyond: Names of links that are fixed to the flange.
    """

    joints: tuple[UrdfJoint, ...]
    T_body_joint: Floats
    bodies: tuple[tuple[Member, ...], ...]
    flange: str
    T_body_flange: Floats
    beyond: frozenset[str]

    def body_poses(self, T_base_root: Floats, q: Floats) -> Floats:
        """T_base_body of the seven bodies at a configuration (6,), rad, shape (7, 4, 4), mm."""
        poses = [T_base_root]
        for joint, T, angle in zip(self.joints, self.T_body_joint, q, strict=True):
            poses.append(poses[-1] @ T @ pose(exp_rotation(joint.axis * angle), np.zeros(3)))
        return np.stack(poses)


def arm_chain(document: UrdfDocument, flange: str) -> ArmChain:
    """The chain from the URDF's root to the flange.

    Args:
        document: The URDF.
        flange: Name of the link that carries the needle.

    Raises:
        InputError: There is no such link, the links are no tree, or other joints than six that turn.
    """
    where = document.where
    if flange not in document.links:
        what = f"there is no link '{flange}', which would be the flange"
        raise InputError(what, where=where, allowed=f"[robot] flange, one of {', '.join(document.links)}")
    above = _parents(document)
    path = _path(above, flange, document)
    turning = [joint for joint in path if joint.kind != "fixed"]
    for joint in document.joints:
        if joint.kind != "fixed" and joint not in turning:
            what = f"joint '{joint.name}' ({joint.kind}) moves something beside the way to the flange '{flange}'"
            raise InputError(what, where=where, allowed="six joints that turn; everything else fixed")
    if len(turning) != JOINT_COUNT or any(joint.kind not in TURNING for joint in turning):
        found = ", ".join(f"{joint.name} ({joint.kind})" for joint in turning) or "none"
        raise InputError(f"the joints that move are {found}", where=where, allowed="six revolute joints in a row")
    bodies, places = _bodies(document, above, turning)
    to_joint = [places[joint.parent] @ joint.T_parent_child for joint in turning]
    beyond = frozenset(name for name in document.links if name != flange and flange in _ancestors(above, name))
    return ArmChain(tuple(turning), np.stack(to_joint), bodies, flange, places[flange], beyond)


def _parents(document: UrdfDocument) -> dict[str, UrdfJoint]:
    """The joint that each link hangs on; only the root hangs on none."""
    above: dict[str, UrdfJoint] = {}
    for joint in document.joints:
        if joint.child in above:
            what = f"link '{joint.child}' hangs on two joints, '{above[joint.child].name}' and '{joint.name}'"
            raise InputError(what, where=document.where, allowed="a tree of links")
        above[joint.child] = joint
    roots = [name for name in document.links if name not in above]
    if len(roots) != 1 or any(roots[0] not in (name, *_ancestors(above, name)) for name in document.links):
        what = f"it is not a tree: links that hang on no joint: {', '.join(roots) or 'none'}"
        raise InputError(what, where=document.where, allowed="one root, and a tree of links below it")
    return above


def _ancestors(above: Mapping[str, UrdfJoint], name: str) -> list[str]:
    """The links above one, the nearest first; a ring ends where it closes."""
    found: list[str] = []
    while name in above and above[name].parent not in found:
        name = above[name].parent
        found.append(name)
    return found


def _path(above: Mapping[str, UrdfJoint], flange: str, document: UrdfDocument) -> list[UrdfJoint]:
    """The joints from the root to the flange."""
    links = [flange, *_ancestors(above, flange)]
    return [above[name] for name in reversed(links) if name in above]


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
