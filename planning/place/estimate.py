# mypy: disable-error-code="no-untyped-def"
"""Estimated fraction of directions an arm reaches from a placement: kinematics and bounding spheres.

Spheres against the patient's distance field, the workcell's boxes and one another: quick, and approximate. Only to
choose where to look: what a placement is worth is decided by :func:`planning.reach.reach.assess_reach_all`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import N_BRANCHES, inverse
from puncture_twin.planning.arm.kinematics import MIN_SINGULARITY, link_poses, singularity
from puncture_twin.planning.arm.links import collision_links
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.collision.bodies import prism
from puncture_twin.planning.collision.packed import sphere_tree
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.place.mounts import Site, WantedDirections

SPHERE_MM = 30.0
"""Bodies are cut until their spheres are no larger: half of a UR3 wrist's size."""
FLANGE = 6
"""The frame of wrist 3, with which the holder moves."""
WITHIN = 0.65
"""Spheres of two bodies of the arm, at so much of their radii, must not intersect: whole ones of links two joints apart
nearly always do. FCL finds 31 % of 1,500 random states of a UR3 in contact with themselves; spheres of this size miss
6 % of these, and find a contact in 5 % of the others."""


@dataclass(frozen=True, eq=False)
class ArmSpheres:
    """Bounding spheres of the links, the needle's holder and the tool, by body; not the needle."""

    centres: Floats  # shape (n, 3), mm, each in its body's frame
    radii: Floats  # shape (n,), mm
    starts: NDArray[np.int64]
    """Shape (k + 1,): the first sphere of each body, which encloses all of the body; the others cover it."""
    frames: NDArray[np.int64]  # shape (k,), the body's frame among ``link_poses``: 0 is the base's

    @classmethod
    @cache
    def of(cls, model: UrModel, tool: Tool) -> ArmSpheres:
        """The spheres of an arm with its tool.

        Raises:
            InputError: If the model's meshes do not ship.
        """
        bodies = [[piece.vertices for piece in link.pieces] for link in collision_links(model)]
        start, end = tool.holder_span_mm
        bodies.append([prism(tool.holder_diameter_mm / 2, end - start) + [0.0, 0.0, (start + end) / 2]])
        if tool.body is not None:
            bodies.append([piece.vertices for piece in tool.body.pieces])
        trees = [sphere_tree(pieces, SPHERE_MM) for pieces in bodies]
        rows = [np.insert(tree.leaves, 0, 0) for tree in trees]  # row 0 is the root
        return cls(
            np.concatenate([tree.centres[own] for tree, own in zip(trees, rows, strict=True)]),
            np.concatenate([tree.radii[own] for tree, own in zip(trees, rows, strict=True)]),
            np.cumsum([0] + [len(own) for own in rows]),
            np.minimum(np.arange(len(trees)), FLANGE),
        )

    @cached_property
    def own(self) -> tuple[Floats, Floats, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """The spheres against one another: centres, radii, starts, frames; pairs (k, 2) of bodies two joints apart."""
        radii = WITHIN * self.radii
        radii[self.starts[:-1]] = self.radii[self.starts[:-1]]
        return self.centres, radii, self.starts, self.frames, np.argwhere(self.frames - self.frames[:, None] >= 2)


class Surroundings(NamedTuple):
    """Patient, boxes that stand with them (CT frame) and with the arm (base frame), and the distance to be kept."""

    skin: SkinField
    fixed: Boxes
    carried: Boxes
    padding_mm: float

    @property
    def compiled(self) -> tuple[tuple[Floats, ...], ...]:
        """The surroundings as plain tuples, for compiled code."""
        return tuple(self.skin), tuple(self.fixed), tuple(self.carried)


def clear_branches(
    spheres: ArmSpheres, surroundings: Surroundings, T_ct_base: Floats, frames: Floats
) -> NDArray[np.bool_]:
    """Which of k motions keep clear of the surroundings, and the arm of itself, at each of m states.

    The base (T_ct_base (4, 4), mm) is checked against the arm alone. ``frames`` (k, m, 7, 4, 4), mm, are their
    ``link_poses``, base frame.
    """
    arm = (spheres.centres, spheres.radii + surroundings.padding_mm, spheres.starts[1:], spheres.frames[1:])
    clear = np.empty(len(frames), np.bool_)
    _clear(arm, spheres.own, surroundings.compiled, np.ascontiguousarray(T_ct_base), frames, clear)
    return clear


def base_is_clear(spheres: ArmSpheres, surroundings: Surroundings, T_ct_base: Floats) -> bool:
    """Whether the base itself is free of the patient and of the boxes that are fixed to them. Exact for boxes."""
    base = (spheres.centres, spheres.radii + surroundings.padding_mm, spheres.starts[:2], spheres.frames[:1])
    alone = surroundings._replace(carried=Boxes.of([]))  # the base is bolted to what it carries
    clear = np.empty(1, np.bool_)
    own = (*spheres.own[:4], spheres.own[4][:0])
    _clear(base, own, alone.compiled, np.ascontiguousarray(T_ct_base), np.tile(np.eye(4), (1, 1, 7, 1, 1)), clear)
    return bool(clear[0])


@nb.njit(cache=True)
def _moved(T, x, y, z):
    """A point mapped by the frame ``T`` (4, 4)."""
    a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    return a, b, c


@nb.njit(cache=True)
def skin_distance(origin, values, x, y, z):
    """Signed distance to the skin, mm, linear between the nodes; beyond the grid at least the distance to the grid."""
    u, v, w = (x - origin[0]) / CELL_MM, (y - origin[1]) / CELL_MM, (z - origin[2]) / CELL_MM
    a = min(max(u, 0.0), values.shape[0] - 1.000001)
    b = min(max(v, 0.0), values.shape[1] - 1.000001)
    c = min(max(w, 0.0), values.shape[2] - 1.000001)
    beyond = (u - a) ** 2 + (v - b) ** 2 + (w - c) ** 2
    i, j, k = int(a), int(b), int(c)
    a, b, c = a - i, b - j, c - k
    low = (values[i, j, k] * (1 - a) + values[i + 1, j, k] * a) * (1 - b)
    low += (values[i, j + 1, k] * (1 - a) + values[i + 1, j + 1, k] * a) * b
    high = (values[i, j, k + 1] * (1 - a) + values[i + 1, j, k + 1] * a) * (1 - b)
    high += (values[i, j + 1, k + 1] * (1 - a) + values[i + 1, j + 1, k + 1] * a) * b
    inner = low * (1 - c) + high * c
    return inner if beyond == 0.0 else max(inner, CELL_MM * np.sqrt(beyond))


@nb.njit(cache=True)
def _touches_box(boxes, x, y, z, radius):
    poses, halves = boxes
    for k in range(len(halves)):
        squared = 0.0
        for i in range(3):
            along = poses[k, i, 0] * x + poses[k, i, 1] * y + poses[k, i, 2] * z + poses[k, i, 3]
            squared += max(0.0, abs(along) - halves[k, i]) ** 2
        if squared < radius * radius:
            return True
    return False


@nb.njit(cache=True)
def _touches(surroundings, T_ct_base, T_base_body, centre, radius):
    skin, fixed, carried = surroundings
    x, y, z = _moved(T_base_body, centre[0], centre[1], centre[2])
    if _touches_box(carried, x, y, z, radius):
        return True
    x, y, z = _moved(T_ct_base, x, y, z)
    return skin_distance(skin[0], skin[1], x, y, z) < radius or _touches_box(fixed, x, y, z, radius)


@nb.njit(cache=True)
def _is_clear(arm, surroundings, T_ct_base, frames, last):
    """Whether one state is clear: first the sphere ``last`` (body, sphere), then far bodies before near ones."""
    centres, radii, starts, body_frames = arm
    body, ball = last
    if ball >= 0:
        T, first = frames[body_frames[body]], starts[body]
        if _touches(surroundings, T_ct_base, T, centres[ball], radii[ball]) and _touches(
            surroundings, T_ct_base, T, centres[first], radii[first]
        ):
            return False
    for body in range(len(body_frames) - 1, -1, -1):
        T = frames[body_frames[body]]
        first = starts[body]
        if _touches(surroundings, T_ct_base, T, centres[first], radii[first]):
            for ball in range(first + 1, starts[body + 1]):
                if _touches(surroundings, T_ct_base, T, centres[ball], radii[ball]):
                    last[0], last[1] = body, ball
                    return False
    return True


@nb.njit(cache=True)
def _nearest_of(own, frames, body, x, y, z, radius, first, last):
    """Whether a sphere intersects one of a body's spheres ``first`` to ``last``, of the body's own."""
    centres, radii, starts, body_frames, _ = own
    T = frames[body_frames[body]]
    for ball in range(starts[body] + first, starts[body] + last):
        a, b, c = _moved(T, centres[ball, 0], centres[ball, 1], centres[ball, 2])
        if (a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2 < (radius + radii[ball]) ** 2:
            return True
    return False


@nb.njit(cache=True)
def _meets_itself(own, frames):
    """Whether spheres of two bodies of the arm intersect at one state, ``frames`` (7, 4, 4)."""
    centres, radii, starts, body_frames, pairs = own
    for pair in range(len(pairs)):
        one, other = pairs[pair]
        T, count = frames[body_frames[one]], starts[other + 1] - starts[other]
        for ball in range(starts[one], starts[one + 1]):
            x, y, z = _moved(T, centres[ball, 0], centres[ball, 1], centres[ball, 2])
            near = _nearest_of(own, frames, other, x, y, z, radii[ball], 0, 1)
            if ball == starts[one]:
                if not near:
                    break
            elif near and _nearest_of(own, frames, other, x, y, z, radii[ball], 1, count):
                return True
    return False


@nb.njit(cache=True)
def _clear(arm, own, surroundings, T_ct_base, frames, clear):
    """Fill ``clear`` (k,) for motions ``frames`` (k, m, 7, 4, 4)."""
    last = np.array([0, -1])
    for branch in range(len(frames)):
        clear[branch] = True
        for state in range(frames.shape[1] - 1, -1, -1):  # the last is the nearest to the patient
            at = frames[branch, state]
            if not _is_clear(arm, surroundings, T_ct_base, at, last) or _meets_itself(own, at):
                clear[branch] = False
                break


CELL_MM = 8.0
"""Between the field's nodes; where the skin is smooth the values between them are right to about 1 mm."""
SAMPLE_MM = 6.0
"""The skin's triangles are divided until no edge is longer: the distance to a corner exceeds that to the skin by
little where it matters, some mm away."""
MARGIN_CELLS = 4
"""Nodes around the skin's box; beyond them the distance to the box counts."""


class SkinField(NamedTuple):
    """Signed distance to the skin on a regular grid: negative inside, where the skin has an inside."""

    origin: Floats  # shape (3,), mm, CT frame: the first node
    values: Floats  # shape (i, j, k), mm; nodes stand ``CELL_MM`` apart

    @classmethod
    def of(cls, skin: TriangleMesh) -> SkinField:
        """The field of a checked skin, CT frame."""
        import trimesh  # here: it costs a third of a second, and few need it

        points, faces = trimesh.remesh.subdivide_to_size(skin.vertices, skin.faces, SAMPLE_MM, max_iter=20)
        fine = trimesh.Trimesh(points, faces, process=False)
        low, high = skin.bounds
        origin = low - MARGIN_CELLS * CELL_MM
        counts = np.ceil((high - low) / CELL_MM).astype(int) + 2 * MARGIN_CELLS + 1
        nodes = origin + CELL_MM * np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1)
        distance, nearest = scipy.spatial.cKDTree(fine.vertices).query(nodes)
        # A node farther from the skin than half its cell's diagonal lies on one side with all its like neighbours.
        sides, _ = scipy.ndimage.label(distance > CELL_MM * np.sqrt(3.0) / 2.0)
        outside = sides == sides[0, 0, 0]
        inside = ~outside & (sides > 0)
        if inside.any():  # nearer nodes lie where the skin's normals say
            along = ((nodes - fine.vertices[nearest]) * fine.vertex_normals[nearest]).sum(axis=-1)
            outward = np.sign(along[outside].sum() - along[inside].sum())
            inside |= (sides == 0) & (outward * along < 0.0)
        return cls(origin, np.where(inside, -distance, distance))


class Boxes(NamedTuple):
    """Boxes of one frame: ``T_box_frame`` (k, 4, 4), mm, and half sizes (k, 3), mm."""

    T_box_frame: Floats
    halves: Floats

    @classmethod
    def of(cls, boxes: Sequence[Box]) -> Boxes:
        """Boxes whose ``T_base_box`` is their pose in that frame."""
        poses = [np.linalg.inv(box.T_base_box) for box in boxes]
        halves = [np.asarray(box.size_mm) / 2 for box in boxes]
        return cls(np.array(poses).reshape(-1, 4, 4), np.array(halves).reshape(-1, 3))


STATES = 3
"""States of an insertion, from standoff to target: enough to see most of what ends it."""


class Branches(NamedTuple):
    """The straight insertions along n directions on every branch, looked at in m states each."""

    q: Floats  # shape (n, 8, m, 6), rad, standoff first; NaN where a branch does not exist
    margin: Floats
    """Shape (n, 8): least distance from a singularity over the states, 0..1; 0 where the insertion is not possible."""


class ReachEstimate(NamedTuple):
    """Fractions of the directions, 0..1: each counts those that the one before left and that pass its own test."""

    reach: float  # kinematics allow the insertion
    fraction: float
    """Links and holder keep clear of the patient and of what is around, and of one another, too."""
    margin: float
    """Mean distance of the reached directions from singularities, 0..1; 0 where none is reached."""


def insertion_branches(
    model: UrModel, target_base: Floats, outward_base: Floats, distances_mm: Floats, at_least: float = MIN_SINGULARITY
) -> Branches:
    """Every branch of n insertions to a target (3,), mm, by kinematics alone; joint limits are not tested.

    Along unit vectors (n, 3), with the flange at ``distances_mm`` (n, m) at each state, farther than so much from each
    singularity.
    """
    count, states = distances_mm.shape
    poses = flange_poses(target_base, np.repeat(outward_base, states, axis=0), distances_mm.reshape(-1))
    q = inverse(model, poses).reshape(count, states, N_BRANCHES, 6)
    least = singularity(model, q).least().min(axis=1)  # NaN where a state does not exist
    return Branches(np.moveaxis(q, 2, 1), np.where(least > at_least, least, 0.0))


@dataclass(frozen=True, eq=False)
class Estimator:
    """Estimates placements of one arm about one target. Its values can be sent to another process."""

    model: UrModel
    tool: Tool
    surroundings: Surroundings
    T_ct_bed: Floats  # its origin is the target
    wanted: WantedDirections

    def estimate(self, site: Site) -> ReachEstimate:
        """The fractions at one site, 0 where the base would lie in something."""
        model, spheres = self.model, ArmSpheres.of(self.model, self.tool)
        T_ct_base = self.T_ct_bed @ site.T_bed_base()
        if not base_is_clear(spheres, self.surroundings, T_ct_base):
            return ReachEstimate(0.0, 0.0, 0.0)
        T_base_ct = np.linalg.inv(T_ct_base)
        target = T_base_ct[:3, :3] @ self.T_ct_bed[:3, 3] + T_base_ct[:3, 3]
        depths = np.linspace(0.0, 1.0, STATES)
        distances = self.tool.needle_length_mm + self.wanted.standoff_mm[:, None] * (1.0 - depths)
        found = insertion_branches(model, target, self.wanted.outward_ct @ T_base_ct[:3, :3].T, distances)
        # the margin of each direction's best branch that keeps clear of the surroundings, shape (n,); 0 for none
        best, order = np.zeros(len(found.margin)), np.argsort(-found.margin, axis=1, kind="stable")
        rows, weight = np.arange(len(order)), self.wanted.weight
        for place in range(N_BRANCHES):
            rows = rows[found.margin[rows, order[rows, place]] > 0.0]
            branches = order[rows, place]
            frames = link_poses(model, found.q[rows, branches])
            clear = clear_branches(spheres, self.surroundings, T_ct_base, frames)
            best[rows[clear]] = found.margin[rows[clear], branches[clear]]
            rows = rows[~clear]
        reach, fraction = (float(weight[some > 0.0].sum()) for some in (found.margin.max(axis=1), best))
        return ReachEstimate(reach, fraction, float(best @ weight) / fraction if fraction > 0.0 else 0.0)
