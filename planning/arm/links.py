"""The bodies of the arm's links, in the link frames of :mod:`puncture_twin.planning.arm.kinematics`, in mm.

Source: the URDFs and collision meshes of ``ur_description`` in ``meshes/ur``, whose LICENSE says whence.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np
import scipy

from puncture_twin import meshes
from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Arrays, user_cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.mesh_list import packed_meshes, unpacked_meshes
from puncture_twin.planning.geometry.rigid import exp_rotation, pose

LINK_NAMES = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
"""The URDF's names without their ``_link``; index = frame of ``link_poses``."""

JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""The joints as the URDF (and ROS) names them."""

SHAPES = "ur"
"""Where URDFs and shapes lie below our meshes, and how the URDFs' addresses begin."""

T_BASE_URDFBASE = np.diag([-1.0, -1.0, 1.0, 1.0])
"""The URDF's ``base_link`` against the controller's base: half a turn about z."""


SLABS: Mapping[str, int] = MappingProxyType({"base": 3, "upper_arm": 3, "forearm": 4})
"""Into how many slabs along its longest side a link is cut before the hulls are taken; the others stay whole.

One hull of the whole forearm bulges over the wrist and meets wrist 2 in 21 % of random configurations of a UR3 where
the mesh itself never does; with these slabs 73.3 % of them are free against 73.8 % for the open meshes themselves.
"""


PIN_RADIUS_MM = 10.0
"""Of the pin that stands for a joint where the meshes leave a gap: well inside every link."""

FLUSH_MM = 1e-4
"""Meshes that overlap along their joint's axis by less than this end in one plane: rounding says whether they touch."""

PIN_ROOT_MM = 5.0
"""How far such a pin reaches into the links at both sides."""


@dataclass(frozen=True, eq=False)
class Link:
    """One body of the arm.

    Attributes:
        name: One of ``LINK_NAMES``.
        frame: Index into the poses of ``link_poses``.
        pieces: Meshes in that frame, mm; their union is the body.
    """

    name: str
    frame: int
    pieces: tuple[TriangleMesh, ...]

    @cached_property
    def mesh(self) -> TriangleMesh:
        """All pieces as one mesh, mm."""
        return joined(self.pieces)


@cache
def collision_links(model: UrModel) -> tuple[Link, ...]:
    """Convex pieces that together contain each link's collision mesh.

    What is clear of them is clear of the link; the price is a few mm where a link is hollow. Most of the UR3's own
    meshes are open, where "inside" means nothing; a hull is always closed.

    Args:
        model: The arm.

    Raises:
        InputError: If no meshes ship for this model, or one cannot be used.
    """
    files = (urdf_path(model), *_mesh_files(model))
    lengths = (model.d1, model.a2, model.a3, model.d4, model.d5, model.d6)
    made_from = {"what": "collision links", "lengths": lengths, "files": [_sha256(file) for file in files]}
    kept = user_cache().arrays(made_from, lambda: _packed(_convex_links(model)), by=__name__, check=unpacked_meshes)
    pieces, ends = unpacked_meshes(kept), np.cumsum(kept["pieces"])
    parts = zip(LINK_NAMES, [0, *ends], ends, strict=False)
    return tuple(Link(name, i, pieces[start:end]) for i, (name, start, end) in enumerate(parts))


def _convex_links(model: UrModel) -> list[tuple[TriangleMesh, ...]]:
    """The pieces of each link."""
    pieces = [_convex_pieces(mesh, SLABS.get(name, 1)) for name, mesh in _link_meshes(model)]
    pins = _joint_pins(model, [joined(parts) for parts in pieces])
    return [some + pin for some, pin in zip(pieces, pins, strict=True)]


def _packed(links: Sequence[Sequence[TriangleMesh]]) -> Arrays:
    """The links' pieces for the cache, and how many each link has."""
    return {**packed_meshes([piece for link in links for piece in link]), "pieces": np.array([*map(len, links)])}


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def joined(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Several meshes of one frame as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


@cache
def visual_links(model: UrModel) -> tuple[Link, ...]:
    """The links in full detail, for pictures: same frames as :func:`collision_links`.

    They are the collision STL files as they ship (43,000 triangles for the UR3): reading the coloured Collada files
    would need one more package.
    """
    return tuple(Link(name, i, (mesh,)) for i, (name, mesh) in enumerate(_link_meshes(model)))


def urdf_path(model: UrModel) -> Path:
    """The URDF of a model.

    Raises:
        InputError: Nobody has the shapes of such a model.
    """
    path = meshes.folder() / SHAPES / f"{model.name}.urdf"
    if not path.is_file():
        allowed = ", ".join(sorted(p.stem for p in path.parent.glob("*.urdf")))
        raise InputError(f"no link meshes for robot {model.name!r}", where=f"meshes/{SHAPES}", allowed=allowed)
    return path


def resolve_package(address: str) -> Path:
    """The file behind a URDF's ``package://`` address."""
    return meshes.folder() / address.removeprefix("package://")


def urdf_link_poses(model: UrModel, q: Floats) -> Floats:
    """The links' frames as the URDF's own joint chain gives them, in the controller's base frame.

    Args:
        model: The arm.
        q: Shape (6,), rad.

    Returns:
        T_base_urdflink, shape (7, 4, 4), mm, in the order of ``LINK_NAMES``.
    """
    root = ElementTree.parse(urdf_path(model)).getroot()
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    poses = [T_BASE_URDFBASE]
    for name, angle in zip(JOINT_NAMES, q, strict=True):
        axis = joints[name].find("axis")
        turn = pose(exp_rotation(_floats(axis, "xyz") * angle), np.zeros(3))
        poses.append(poses[-1] @ _origin(joints[name]) @ turn)
    return np.stack(poses)


def _link_meshes(model: UrModel) -> list[tuple[str, TriangleMesh]]:
    """The collision meshes as they ship, turned from the URDF's link frames to ours: a constant motion per link."""
    T_link_urdflink = np.linalg.inv(link_poses(model, np.zeros(6))) @ urdf_link_poses(model, np.zeros(6))
    origins = [_origin(collision) for collision in _collisions(model)]
    moved = zip(LINK_NAMES, T_link_urdflink, origins, _mesh_files(model), strict=True)
    return [(name, _load(file).transformed(T @ origin)) for name, T, origin, file in moved]


def _collisions(model: UrModel) -> list[ElementTree.Element]:
    """The URDF's collision bodies, in the order of `LINK_NAMES`."""
    root = ElementTree.parse(urdf_path(model)).getroot()
    links = {link.get("name"): link for link in root.findall("link")}
    found = []
    for name in LINK_NAMES:
        collision = links[f"{name}_link"].find("collision")
        if collision is None or collision.find("geometry/mesh") is None:
            raise InputError(f"link {name} has no collision mesh", where=urdf_path(model), allowed="one mesh a link")
        found.append(collision)
    return found


def _mesh_files(model: UrModel) -> list[Path]:
    """The files of the collision meshes, in the order of `LINK_NAMES`."""
    named = [collision.find("geometry/mesh") for collision in _collisions(model)]
    files = [resolve_package("" if mesh is None else mesh.get("filename", "")) for mesh in named]
    for file in files:
        if not file.is_file():
            raise InputError("mesh file is missing", where=file, allowed="the file that the URDF names")
    return files


def _load(path: Path) -> TriangleMesh:
    import trimesh  # here: it costs a third of a second, and few need it

    mesh = trimesh.load_mesh(path, process=False)
    vertices = 1000.0 * np.asarray(mesh.vertices)  # URDF meshes are in metres
    if len(mesh.faces) == 0 or not np.isfinite(vertices).all():
        raise InputError("mesh is empty or not finite", where=path, allowed="a mesh with triangles")
    return TriangleMesh(vertices, np.asarray(mesh.faces))


def _convex_pieces(mesh: TriangleMesh, count: int) -> tuple[TriangleMesh, ...]:
    """The hulls of the surface's parts in equal slabs across the longest side. Their union contains the surface."""
    import trimesh  # here: it costs a third of a second, and few need it

    low, high = mesh.bounds
    axis = int(np.argmax(high - low))
    cuts = np.linspace(low[axis], high[axis], count + 1)
    corners = mesh.triangles
    starts, ends = corners.reshape(-1, 3), np.roll(corners, -1, axis=1).reshape(-1, 3)
    points = [mesh.vertices] + [_crossings(starts, ends, axis, cut) for cut in cuts[1:-1]]
    cloud = np.concatenate(points)
    along = cloud[:, axis]
    slabs = [cloud[(along >= a) & (along <= b)] for a, b in pairwise(cuts)]
    hulls = [trimesh.convex.convex_hull(slab) for slab in slabs]
    return tuple(TriangleMesh(np.asarray(hull.vertices), np.asarray(hull.faces)) for hull in hulls)


def _joint_pins(model: UrModel, meshes: Sequence[TriangleMesh]) -> list[tuple[TriangleMesh, ...]]:
    """For each link the pin that closes the gap to the next one along their joint's axis, if the meshes leave one.

    The UR5's leave up to 3 mm, and a flat surface passing there would meet neither link.
    """
    poses = link_poses(model, np.zeros(6))
    pins: list[tuple[TriangleMesh, ...]] = []
    for link, (mesh, following) in enumerate(pairwise(meshes)):
        T_link_next = np.linalg.inv(poses[link]) @ poses[link + 1]
        low, high = mesh.bounds[:, 2]  # the joint turns about this frame's z: heights are the same at every angle
        next_low, next_high = following.transformed(T_link_next).bounds[:, 2]
        gaps = [(a, b) for a, b in ((high, next_low), (next_high, low)) if b >= a - FLUSH_MM]
        pins.append(tuple(_pin(a - PIN_ROOT_MM, b + PIN_ROOT_MM) for a, b in gaps))
    return [*pins, ()]


def _pin(low: float, high: float) -> TriangleMesh:
    import trimesh  # here: it costs a third of a second, and few need it

    turn = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    ring = PIN_RADIUS_MM * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    hull = trimesh.convex.convex_hull(np.concatenate([np.insert(ring, 2, z, axis=1) for z in (low, high)]))
    return TriangleMesh(np.asarray(hull.vertices), np.asarray(hull.faces))


def _crossings(starts: Floats, ends: Floats, axis: int, cut: float) -> Floats:
    """Where edges (n, 3) to (n, 3) pass the plane ``axis = cut``, shape (k, 3), mm."""
    a, b = starts[:, axis], ends[:, axis]
    crosses = (a - cut) * (b - cut) < 0.0
    fraction = ((cut - a[crosses]) / (b[crosses] - a[crosses]))[:, None]
    points = starts[crosses] + fraction * (ends[crosses] - starts[crosses])
    points[:, axis] = cut
    return np.asarray(points)


def _origin(element: ElementTree.Element) -> Floats:
    """The ``origin`` of a URDF joint or collision as a 4x4 in mm; identity where there is none."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    return pose(
        scipy.spatial.transform.Rotation.from_euler("xyz", _floats(origin, "rpy")).as_matrix(),
        1000.0 * _floats(origin, "xyz"),
    )


def _floats(element: ElementTree.Element | None, key: str) -> Floats:
    text = "0 0 0" if element is None else element.get(key, "0 0 0")
    values = np.array([float(word) for word in text.split()])
    if values.shape != (3,) or not all(map(math.isfinite, values)):
        raise InputError(f"{key} = {text!r}", where="URDF", allowed="three finite numbers")
    return values
