"""The bodies of the arm's links, in the link frames of :mod:`puncture_twin.planning.arm.kinematics`, in mm.

Source: the collision shapes of the URDF behind an arm's model: the user's own, if it is built as a UR, or the one that
ships under its name (``meshes/ur/LICENSE`` says whence).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType

import numpy as np

from puncture_twin import meshes
from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import FLANGE, ArmUrdf, Read, hull, read_arm_urdf, ring_corners
from puncture_twin.planning.arm.urdf.lengths import NOTHING_STATED, StatedLimits, urdf_limits
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined, packed_meshes, unpacked_meshes

LINK_NAMES = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
"""The arm's seven bodies, as their links' names in a UR's URDF without ``_link``; index = frame of ``link_poses``."""
SLABS: Mapping[str, int] = MappingProxyType({"base": 3, "upper_arm": 3, "forearm": 4})
"""Into how many slabs along its longest side a link is cut before the hulls are taken; the others stay whole.

One hull of the whole forearm bulges over the wrist and touches wrist 2 in 21 % of random configurations of a UR3 where
the mesh itself never does; with these slabs 73.3 % of them are free against 73.8 % for the open meshes themselves.
"""
PIN_RADIUS_MM, PIN_SIDES = 10.0, 8
"""Radius of the pin that replaces a joint where the meshes leave a gap: well inside every link."""
FLUSH_MM = 1e-4
"""Overlap along their joint's axis below which two meshes end in one plane: whether they touch is rounding."""
FLAT_MM = 0.05
"""Points that lie within such a sheet span no body: their hull would be one of rounding."""
MOST_GAP_MM = 5.0
"""Gap between an own URDF's shapes, at most: the UR5's meshes leave 3 mm, and a mesh in another unit hundreds."""
PIN_ROOT_MM = 5.0
"""How far such a pin reaches into the links at both sides."""


@dataclass(frozen=True, eq=False)
class Link:
    """One body of the arm."""

    name: str  # one of ``LINK_NAMES``
    frame: int  # index into the poses of ``link_poses``
    pieces: tuple[TriangleMesh, ...]  # meshes in that frame, mm; their union is the body

    @cached_property
    def mesh(self) -> TriangleMesh:
        """All pieces as one mesh, mm."""
        return joined(self.pieces)


@cache
def collision_links(model: UrModel) -> tuple[Link, ...]:
    """Convex pieces that together contain each link's collision mesh.

    What is clear of them is clear of the link; the price is a few mm where a link is hollow. Most of the UR3's own
    meshes are open, where "inside" means nothing; a hull is always closed.

    Raises:
        InputError: If no meshes ship for this model, or one cannot be used.
    """

    def packed() -> Arrays:
        shapes = [link.pieces for link in visual_links(model)]
        links = [
            tuple(piece for mesh in meshes for piece in _pieces(mesh, name, model))
            for name, meshes in zip(LINK_NAMES, shapes, strict=True)
        ]
        pins = _joint_pins(model, [joined(parts) for parts in links])
        counts = [len(some) + len(pin) for some, pin in zip(links, pins, strict=True)]
        return {
            **packed_meshes([piece for both in zip(links, pins, strict=True) for some in both for piece in some]),
            "pieces": np.array(counts),
        }

    made_from = {
        "what": "collision links",
        "lengths": model.lengths.tolist(),
        "urdf": model_urdf(model).digest,
        "shipped": model.shipped,
    }
    cached = user_cache().arrays(made_from, packed, by=__name__, check=unpacked_meshes)
    pieces, ends = unpacked_meshes(cached), np.cumsum(cached["pieces"])
    parts = zip(LINK_NAMES, [0, *ends], ends, strict=False)
    return tuple(Link(name, i, pieces[start:end]) for i, (name, start, end) in enumerate(parts))


@cache
def visual_links(model: UrModel) -> tuple[Link, ...]:
    """The links in full detail, for images: same frames as :func:`collision_links`.

    They are the collision shapes themselves (43,000 triangles for the UR3): Collada files would need one more package.
    """
    urdf = model_urdf(model)
    T_link_urdflink = np.linalg.inv(link_poses(model, np.zeros(6))) @ urdf.body_poses(np.zeros(6))
    rows = enumerate(zip(LINK_NAMES, urdf.shapes, T_link_urdflink, strict=True))
    return tuple(
        Link(name, i, tuple(shape.mesh.transformed(T @ shape.T_body_shape) for shape in shapes))
        for i, (name, shapes, T) in rows
    )


def _pieces(mesh: TriangleMesh, name: str, model: UrModel) -> tuple[TriangleMesh, ...]:
    pieces = convex_pieces(mesh, SLABS.get(name, 1))
    if not pieces:
        refuse(f"a shape of the {name} is flat", model_urdf(model).where, "bodies, not sheets", "flat_mesh")
    return pieces


def convex_pieces(mesh: TriangleMesh, count: int) -> tuple[TriangleMesh, ...]:
    """The hulls of the surface's parts in ``count`` equal slabs across the longest side; they contain the surface.

    One hull of all where a slab's part of the surface is flat, none where the whole is.
    """
    low, high = mesh.bounds
    axis = int(np.argmax(high - low))
    cuts = np.linspace(low[axis], high[axis], count + 1)
    corners = mesh.triangles
    starts, ends = corners.reshape(-1, 3), np.roll(corners, -1, axis=1).reshape(-1, 3)
    points = [mesh.vertices] + [plane_crossings(starts, ends, axis, cut) for cut in cuts[1:-1]]
    cloud = np.concatenate(points)
    along = cloud[:, axis]
    slabs = [cloud[(along >= a) & (along <= b)] for a, b in pairwise(cuts)]
    hulls = [one for one in map(convex_hull, slabs) if one is not None]
    if len(hulls) == count:
        return tuple(hulls)
    whole = convex_hull(cloud)  # a slab of it is flat or empty: the hull of all contains it
    return () if whole is None else (whole,)


def convex_hull(points: Floats) -> TriangleMesh | None:
    """The convex hull of points (n, 3), mm; None where they lie in one plane."""
    if not len(points):
        return None
    centred = points - points.mean(axis=0)
    across = np.linalg.eigh(centred.T @ centred).eigenvectors[:, 0]  # of the least eigenvalue
    return None if np.ptp(centred @ across) < FLAT_MM else hull(points)


def _joint_pins(model: UrModel, meshes: Sequence[TriangleMesh]) -> list[tuple[TriangleMesh, ...]]:
    """For each link the pin that closes the gap to the next one along their joint's axis, if the meshes leave one.

    The UR5's leave up to 3 mm, and a flat surface passing there would touch neither link.
    """
    poses = link_poses(model, np.zeros(6))
    pins: list[tuple[TriangleMesh, ...]] = []
    for link, (mesh, following) in enumerate(pairwise(meshes)):
        T_link_next = np.linalg.inv(poses[link]) @ poses[link + 1]
        low, high = mesh.bounds[:, 2]  # the joint turns about this frame's z: heights are the same at every angle
        next_low, next_high = following.transformed(T_link_next).bounds[:, 2]
        gaps = [(a, b) for a, b in ((high, next_low), (next_high, low)) if b >= a - FLUSH_MM]
        if not model.shipped and (widest := max((b - a for a, b in gaps), default=0.0)) > MOST_GAP_MM:
            what = f"the shapes of {LINK_NAMES[link]} and {LINK_NAMES[link + 1]} are {widest:.4g} mm apart"
            allowed = (
                f"shapes that touch along their joint's axis, within {MOST_GAP_MM:g} mm: check unit, scale and origin"
            )
            refuse(what, model_urdf(model).where, allowed, "links_apart")
        ends = [(a - PIN_ROOT_MM, b + PIN_ROOT_MM) for a, b in gaps]
        pins.append(tuple(hull(ring_corners(PIN_RADIUS_MM, PIN_SIDES, one)) for one in ends))
    return [*pins, ()]


def plane_crossings(starts: Floats, ends: Floats, axis: int, cut: float) -> Floats:
    """Points where edges (n, 3) to (n, 3) pass the plane ``axis = cut``, shape (k, 3), mm."""
    a, b = starts[:, axis], ends[:, axis]
    crosses = (a - cut) * (b - cut) < 0.0
    fraction = ((cut - a[crosses]) / (b[crosses] - a[crosses]))[:, None]
    points = starts[crosses] + fraction * (ends[crosses] - starts[crosses])
    points[:, axis] = cut
    return np.asarray(points)


SHAPES = "ur"
"""Where URDFs and shapes lie below our meshes, and how the URDFs' addresses begin."""
T_BASE_URDFBASE = np.diag([-1.0, -1.0, 1.0, 1.0])
"""A UR's URDF has its ``base_link`` against the controller's base: half a turn about z."""
MEANS = "://"
"""What an address has that is more than a path."""


def model_urdf(model: UrModel) -> ArmUrdf:
    """The URDF of a model, with its shapes. Raises InputError: Nobody has the shapes of such a model."""
    if model.urdf is not None:
        return model.urdf
    if not model.shipped:
        what = f"the arm {model.name!r} is known only by its numbers"
        refuse(what, "robot", "the case that states its URDF", "urdf_missing")
    return _shipped(model.name)


def address_file(urdf: ArmUrdf, address: str) -> str:
    """The absolute path of a mesh that a URDF names, or the address itself where it is one of another program."""
    if address.startswith(f"package://{SHAPES}/"):
        return str(_resolved(address))
    return address if MEANS in address else str((urdf.where.parent / address).resolve())


@cache
def _shipped(name: str) -> ArmUrdf:
    path = meshes.folder() / SHAPES / f"{name}.urdf"
    if not path.is_file():
        allowed = ", ".join(sorted(p.stem for p in path.parent.glob("*.urdf")))
        refuse(f"no link meshes for robot {name!r}", f"meshes/{SHAPES}", allowed, "no_link_meshes")
    data, read = path.read_bytes(), lambda address: _resolved(address).read_bytes()
    return read_arm_urdf(data, path, flange=FLANGE, read=read, T_base_root=T_BASE_URDFBASE)


def _resolved(address: str) -> Path:
    return meshes.folder() / address.removeprefix("package://")


def own_arm(data: bytes, where: Path, *, flange: str, read: Read, stated: StatedLimits = NOTHING_STATED) -> UrModel:
    """The arm of a URDF, with the limits that the URDF states; its name is the robot's.

    Args:
        where: The file, to which its meshes are relative.
        read: Reads a mesh file by its address in the URDF.
        stated: Limits that the case states, for joints for which the URDF has none.

    Raises:
        InputError: It cannot be read whole, or is not built as a UR; says what and where.
    """
    urdf = read_arm_urdf(data, where, flange=flange, read=read)
    limits = urdf_limits(urdf.chain.joints, stated, where)
    d1, a2, a3, d4, d5, d6 = urdf.lengths_mm
    names = tuple(joint.name for joint in urdf.chain.joints)
    return UrModel(urdf.document.name, d1, a2, a3, d4, d5, d6, *limits, joint_names=names, shipped=False, urdf=urdf)
