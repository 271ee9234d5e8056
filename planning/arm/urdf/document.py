"""URDF documents as plain values, mm and rad: links with shapes, and joints. What cannot be read whole is refused."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar
from xml.etree import ElementTree

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.text import check_name
from puncture_twin.planning.geometry.rigid import about_fixed_axes, pose

Element = ElementTree.Element

MM_PER_M = 1000.0
"""URDFs speak metres."""
MOST_BYTES = 10_000_000
"""Bytes of a URDF: the largest of a whole humanoid has a tenth of it."""
MOST_LINKS = 1000
"""Of a URDF: an arm has ten."""
MOST_SIZE_MM = 5000.0
"""Of a box or a cylinder in a link: no arm that can be planned for here has a longer one."""
SHAPES = {"mesh": ("filename",), "box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}
"""Kinds of shape that URDF knows, and what each must state."""
JOINTS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
"""Kinds of joint that URDF knows."""
PLAIN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_./-]*")
"""Names of links and joints: they are written into programs of robots."""
TAKEN = ("holder", "needle", "needle_holder", "needle_tip", "tool")
"""Names of what the flange carries."""
LIMITS = ("lower", "upper", "velocity", "effort")

ALLOWED = "a URDF: one <robot> with links and joints, as ROS reads it"

Named = TypeVar("Named", bound="UrdfLink | UrdfJoint")


@dataclass(frozen=True, eq=False)
class UrdfShape:
    """One collision shape of a link."""

    kind: str  # one of ``SHAPES``
    T_link_shape: Floats  # shape (4, 4), mm
    address: str  # of a mesh, as the URDF states it; else ""
    size: Floats
    """Factors of a mesh's axes (3,); a box's edges (3,), a cylinder's radius and length (2,), a sphere's radius (1,),
    mm."""


@dataclass(frozen=True, eq=False)
class UrdfLink:
    """One link."""

    name: str
    collisions: tuple[UrdfShape, ...]  # what it is made of for contacts
    drawn: bool  # whether it has a visual shape
    weighs: bool  # whether it states a mass and a tensor of inertia that physics can use


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint of a URDF."""

    name: str
    kind: str  # one of ``JOINTS``
    parent: str
    child: str
    T_parent_child: Floats  # shape (4, 4), mm, at the angle zero
    axis: Floats  # shape (3,), unit, in the child's frame
    limits: Mapping[str, float]  # those of ``LIMITS`` that are stated: rad, rad/s, N m


@dataclass(frozen=True, eq=False)
class UrdfDocument:
    """All links and joints of a URDF."""

    name: str
    links: Mapping[str, UrdfLink]  # by name, in the file's order
    joints: tuple[UrdfJoint, ...]  # in the file's order
    where: Path


def parse_urdf(data: bytes, where: Path) -> UrdfDocument:
    """The links and joints of a URDF.

    Raises InputError: It is no well-formed XML, no URDF, or says something that is not understood.
    """
    root = _root(data, where)
    name = check_name(root.get("name", ""), "<robot>", where=where)
    links = _by_name([_link(one, where) for one in root.findall("link")], "link", where)
    joints = _by_name([_joint(one, where) for one in root.findall("joint")], "joint", where)
    if len(links) > MOST_LINKS:
        refuse(f"{len(links)} links", where, f"at most {MOST_LINKS}", "too_many")
    for joint in joints.values():
        for end in (joint.parent, joint.child):
            if end not in links:
                refuse(f"joint '{joint.name}': there is no link '{end}'", where, ", ".join(links), "unknown_link")
    return UrdfDocument(name, links, tuple(joints.values()), where)


def _root(data: bytes, where: Path) -> Element:
    try:
        text = data.decode("utf-8-sig")
        if "<!" in text.replace("<!--", ""):
            refuse("a document type or CDATA section", where, "a URDF without either", "xml_doctype")
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        what = f"XML is not well formed ({error})"
        raise InputError(what, where=where, allowed=ALLOWED, code="xml_damaged") from error
    if any("xacro" in one.tag for one in root.iter()):
        allowed = "the expanded URDF: xacro arm.urdf.xacro > arm.urdf"
        refuse("it has xacro macros, which are not expanded", where, allowed, "xacro_macros")
    if root.tag != "robot":
        refuse(f"<{root.tag}> where <robot> was expected", where, ALLOWED, "wrong_format")
    return root


def _by_name(parts: Sequence[Named], what: str, where: Path) -> Mapping[str, Named]:
    for name, count in Counter(part.name for part in parts).items():
        if count > 1:
            refuse(f"{what} '{name}' appears {count} times", where, "each name once", "duplicate_name")
    return {part.name: part for part in parts}  # no proxy: an arm is sent to other processes


def _link(element: Element, where: Path) -> UrdfLink:
    name = _plain(element, "a link", where)
    if name in TAKEN:
        refuse(f"a link called '{name}'", where, f"any name except {', '.join(TAKEN)} (the tool)", "reserved_name")
    link_place = f"{where}: link '{name}'"
    shapes = tuple(_shape(one, link_place) for one in element.findall("collision"))
    return UrdfLink(name, shapes, element.find("visual") is not None, _weighs(element, link_place))


def _plain(element: Element, what: str, where: Path) -> str:
    name = check_name(element.get("name", ""), what, where=where)
    if not PLAIN.fullmatch(name):
        refuse(f"{what} has the name '{name}'", where, "letters, digits and _ . / -", "bad_name")
    return name


def _shape(element: Element, where: str) -> UrdfShape:
    geometry = _only(element, "geometry", where)
    kinds = [one.tag for one in geometry]
    if len(kinds) != 1 or kinds[0] not in SHAPES:
        present = ", ".join(kinds) or "nothing"
        refuse(f"a collision of {present}", where, f"one of {', '.join(SHAPES)}", "unknown_shape")
    kind, shape = kinds[0], geometry[0]
    for key in SHAPES[kind]:
        if not shape.get(key, "").strip():
            refuse(f"<{kind}> without {key}", where, ", ".join(SHAPES[kind]), "missing_key")
    T = _origin(element, where)
    if kind == "mesh":
        scale = _numbers(shape, "scale", 3, where) if "scale" in shape.attrib else np.ones(3)
        if not (scale > 0.0).all():
            what = f'scale="{shape.get("scale")}" mirrors or flattens the mesh'
            refuse(what, where, "three factors above 0", "mirrored")
        return UrdfShape(kind, T, shape.get("filename", ""), scale)
    counts = {"size": 3}
    size = MM_PER_M * np.concatenate([_numbers(shape, key, counts.get(key, 1), where) for key in SHAPES[kind]])
    if not ((size > 0.0) & (size <= MOST_SIZE_MM)).all():
        refuse(
            f"<{kind}> of {', '.join(f'{value:g}' for value in size)} mm",
            where,
            f"above 0, at most {MOST_SIZE_MM:g} mm",
            "out_of_range",
        )
    return UrdfShape(kind, T, "", size)


def _joint(element: Element, where: Path) -> UrdfJoint:
    name = _plain(element, "a joint", where)
    joint_place, kind = f"{where}: joint '{name}'", element.get("type", "")
    if kind not in JOINTS:
        refuse(f"type '{kind}'", joint_place, ", ".join(JOINTS), "unknown_joint_type")
    if element.find("mimic") is not None:
        refuse("it mimics another joint", joint_place, "independent joints", "mimic_joint")
    parent, child = (_only(element, end, joint_place).get("link", "") for end in ("parent", "child"))
    stated_axis, limit = element.find("axis"), element.find("limit")
    axis = np.array([1.0, 0.0, 0.0]) if stated_axis is None else _numbers(stated_axis, "xyz", 3, joint_place)
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        refuse("its axis is zero", joint_place, "a direction", "zero_direction")
    stated = (
        {}
        if limit is None
        else {key: float(_numbers(limit, key, 1, joint_place)[0]) for key in LIMITS if key in limit.attrib}
    )
    return UrdfJoint(name, kind, parent, child, _origin(element, joint_place), axis / length, stated)


def _origin(element: Element, where: str) -> Floats:
    """The ``origin`` of a joint or a shape as (4, 4), mm: rpy about the fixed axes x, y, z, in this order."""
    origins = element.findall("origin")
    if not origins:
        return np.eye(4)
    if len(origins) > 1 or not set(origins[0].attrib) <= {"xyz", "rpy"}:
        refuse("an <origin> with more than xyz and rpy, or two of them", where, "one <origin>", "duplicate_element")
    xyz, rpy = (
        _numbers(origins[0], key, 3, where) if key in origins[0].attrib else np.zeros(3) for key in ("xyz", "rpy")
    )
    return pose(about_fixed_axes(rpy), MM_PER_M * xyz)


def _weighs(element: Element, where: str) -> bool:
    inertial = element.find("inertial")
    if inertial is None:
        return False
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None:
        return False
    diagonal = [_numbers(tensor, key, 1, where)[0] for key in ("ixx", "iyy", "izz") if key in tensor.attrib]
    return len(diagonal) == 3 and min(*diagonal, _numbers(mass, "value", 1, where)[0]) > 0.0


def _only(element: Element, tag: str, where: str) -> Element:
    elements = element.findall(tag)
    if len(elements) != 1:
        refuse(f"{len(elements)} <{tag}>", where, "one", "wrong_count")
    return elements[0]


def _numbers(element: Element, key: str, count: int, where: str) -> Floats:
    """The finite numbers of an attribute, shape (count,); refused where there are more or fewer."""
    text = element.get(key, "")
    try:
        values = [] if "_" in text else [float(word) for word in text.split()]  # Python alone takes 1_000 for a number
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        allowed = "a finite number" if count == 1 else f"{count} finite numbers"
        refuse(f'<{element.tag} {key}="{text}">', where, allowed, "not_a_number")
    return np.array(values)
