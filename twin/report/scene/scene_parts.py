"""The scene as coloured meshes in the CT frame, for image, film and page: patient, room, arm, needle, corridor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import Link, visual_links
from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import SAFE, Rgb
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.geometry.containment import hit_fraction
from puncture_twin.planning.geometry.mesh import TriangleMesh, box
from puncture_twin.planning.geometry.rigid import frame_about, pose
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.twin.report import palette
from puncture_twin.twin.report.map_view import step_of
from puncture_twin.twin.report.raster.render import Layer, Surface

SECTIONS = 24  # sides of a round bar
LIFT_MM = 1.0  # how far the corridor's mouth is drawn outside the skin, so that the two surfaces do not flicker
KEY = 1e-6
"""rad; corners of cells nearer than this are one corner."""


def bar(start_ct: Floats, end_ct: Floats, radius: float) -> TriangleMesh:
    """A closed round bar between two points, mm."""
    along = np.asarray(end_ct, float) - start_ct
    length = float(np.linalg.norm(along))
    outline = np.array([[0.0, 0.0], [radius, 0.0], [radius, length], [0.0, length]])
    return revolved(outline, SECTIONS).transformed(pose(frame_about(along / length), start_ct))


def ball(centre_ct: Floats, radius: float) -> TriangleMesh:
    """A sphere, mm."""
    latitude = np.linspace(-np.pi / 2.0, np.pi / 2.0, SECTIONS // 2 + 1)
    outline = radius * np.stack([np.cos(latitude), np.sin(latitude)], axis=1)
    outline[[0, -1], 0] = 0.0  # the poles
    return revolved(outline, SECTIONS).transformed(pose(np.eye(3), centre_ct))


def ring(T_ct_ring: Floats, inner: float, outer: float, thickness: float) -> TriangleMesh:
    """A flat ring about the z axis of its frame, two radii and the extent along z, mm."""
    half = thickness / 2.0
    outline = np.array([[inner, -half], [outer, -half], [outer, half], [inner, half]])
    return revolved(outline, 2 * SECTIONS).transformed(np.asarray(T_ct_ring))


def corridor(candidates: Candidates, case: Any) -> list[TriangleMesh]:
    """Where a needle may enter: a patch of the skin for every safe cell of the grid, and the walls from there.

    These are triangles from the target to the rim of the patches. Nothing where nothing is safe; no walls where all is.
    """
    rows = np.flatnonzero(candidates.safe & np.isfinite(candidates.path.length))
    if len(rows) == 0:
        return []
    points, corners = _cells(candidates, case, rows)
    mouth = TriangleMesh(points, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]))
    edges = np.sort(np.concatenate([corners[:, [i, (i + 1) % 4]] for i in range(4)]), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    rim = edges[uses == 1]
    rim = rim[np.linalg.norm(points[rim[:, 0]] - points[rim[:, 1]], axis=1) > KEY]
    if len(rim) == 0:
        return [mouth]
    apex = np.full((len(rim), 1), len(points))
    return [mouth, TriangleMesh(np.vstack([points, case.target_ct]), np.hstack([apex, rim]))]


def _cells(candidates: Candidates, case: Any, rows: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64]]:
    """Corner points (n, 3), shared between cells, and the four corners (m, 4) of the cells of some rows."""
    half = step_of(candidates) / 2
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    theta = np.clip(candidates.theta[rows, None] + half * signs[:, 0], 0.0, np.pi)
    beta = candidates.beta[rows, None] + half * signs[:, 1]
    turn = round(2 * np.pi / KEY)
    around = np.where(np.sin(theta) < KEY, 0, np.mod(np.round(beta / KEY), turn))  # a pole is one corner
    keys = np.stack([np.round(theta / KEY), around], axis=-1).reshape(-1, 2)
    _, first, shared = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    shared = shared.reshape(-1)
    lengths = np.repeat(candidates.path.length[rows], 4)
    length = np.bincount(shared, weights=lengths) / np.bincount(shared) + LIFT_MM
    T = np.asarray(case.T_ct_entry)
    points = case.target_ct + length[:, None] * (outward(theta.ravel()[first], beta.ravel()[first]) @ T[:3, :3].T)
    return points, shared.reshape(-1, 4)


def revolved(outline: Floats, sections: int) -> TriangleMesh:
    """The closed surface that an outline draws as it is carried once around z.

    Args:
        outline: Shape (k, 2), mm: radius, at least 0, and height of its corners, around the body to the left.
        sections: How many flat sides stand for the circle.
    """
    angle = 2.0 * np.pi * np.arange(sections) / sections
    radius, height = outline[:, 0, None], outline[:, 1, None]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), height), axis=-1)
    corner = np.arange(points[..., 0].size).reshape(len(outline), sections)
    corner[outline[:, 0] == 0.0] = corner[outline[:, 0] == 0.0, :1]  # on the axis all are one
    above, aside = np.roll(corner, -1, axis=0), np.roll(corner, -1, axis=1)
    across = np.roll(above, -1, axis=1)
    faces = np.concatenate([np.stack([corner, aside, across], -1), np.stack([corner, across, above], -1)]).reshape(
        -1, 3
    )
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, number = np.unique(faces, return_inverse=True)
    return TriangleMesh(points.reshape(-1, 3)[used], number.reshape(-1, 3).astype(np.int32))


ORGAN_OPACITY = 0.38  # opacity of the organ that holds the target, so that the lesion and its vessels show
MOST_AROUND = 0.7
"""A structure that hides the target from more than so much of all directions holds it: also an organ from whose label
the lesion is left out, and one with an opening, as of a vessel."""

UNKNOWN_OPACITY = 0.30
OUTSIDE_SHOWN_MM = np.array([150.0, 150.0, 0.0])
"""How far beyond the skin's box what is outside of the body is drawn: to the sides, front and back, along the bed."""
SKIN_OPACITY = 0.20
GANTRY_OPACITY = 0.15  # opacity of the gantry, so that it does not hide the patient in its bore
MOUTH_OPACITY = 0.88
"""Of where a needle may enter: what lies behind it hardly shows, since seen through green it would look safe to hit."""

WALL_OPACITY = 0.10
TARGET_BALL_MM = 3.0  # radius of the ball that marks the target point
PLATE_RADIUS_MM, PLATE_THICK_MM = 130.0, 25.0
"""Of the plate under the arm's base: wider than any base, so that it is seen."""

LEAST_NEEDLE_MM = 1.0
"""Least radius at which the needle is drawn: thinner ones would be below a pixel. The legend says so."""


@dataclass(frozen=True, eq=False)
class SceneBody:
    """One thing of the scene."""

    name: str
    group: str
    """"organ", "skin", "safe", "needle", "arm", "room" or "target"."""
    mesh: TriangleMesh
    """CT frame, mm."""
    colour: Rgb
    alpha: float = 1.0
    frame: int = 0
    """Of an arm's link: with which of ``link_poses`` it moves."""

    @property
    def surface(self) -> Surface:
        """For the ray caster; the corridor is flat colour, without the rim that makes a skin look like glass."""
        rim = 0.0 if self.group == "safe" else Surface.rim
        return Surface(self.mesh, self.colour, self.alpha, rim)


def patient(anatomy: Any, case: Any) -> tuple[SceneBody, ...]:
    """Organs, skin and the target's mark; what holds the target, and unknown structures, are see-through."""
    structures = anatomy.structures
    colours = palette.organ_colours(tuple(s.name for s in structures))
    bodies = [SceneBody(s.name, "organ", s.mesh, colours[s.name], _opacity(s, case)) for s in structures]
    low, high = anatomy.skin.mesh.bounds + OUTSIDE_SHOWN_MM * np.array([[-1.0], [1.0]])
    for s in anatomy.surroundings:  # of what goes on beyond the image the part about the skin, flattened at the rest
        if str(s.role) == "unknown":
            mesh = TriangleMesh(np.clip(s.mesh.vertices, low, high), s.mesh.faces)
            bodies.append(SceneBody(s.name, "organ", mesh, palette.OUTSIDE, UNKNOWN_OPACITY))
    bodies.append(SceneBody("skin", "skin", anatomy.skin.mesh, palette.SKIN, SKIN_OPACITY))
    bodies.append(SceneBody("target", "target", ball(case.target_ct, TARGET_BALL_MM), palette.TARGET_POINT))
    return tuple(bodies)


def _opacity(structure: Any, case: Any) -> float:
    if str(structure.role) == "unknown":
        return UNKNOWN_OPACITY
    if structure.name == case.target_structure:
        return ORGAN_OPACITY
    low, high = structure.mesh.bounds
    near = bool(np.all((low <= case.target_ct) & (case.target_ct <= high)))
    return ORGAN_OPACITY if near and hit_fraction(structure.mesh, case.target_ct) > MOST_AROUND else 1.0


def safe_region(candidates: Candidates, case: Any) -> tuple[SceneBody, ...]:
    """The safe directions: where they pierce the skin, and the walls of the corridor; empty when nothing is safe."""
    looks = (("safe entry", MOUTH_OPACITY), ("safe corridor", WALL_OPACITY))
    meshes = corridor(candidates, case)
    return tuple(SceneBody(name, "safe", mesh, SAFE, alpha) for mesh, (name, alpha) in zip(meshes, looks, strict=False))


def needle_bodies(
    needle: Any, tip_ct: Floats, outward_ct: Floats, least_mm: float = LEAST_NEEDLE_MM
) -> tuple[SceneBody, ...]:
    """Needle and holder, the tip at (3,), along `outward_ct`, (3,), unit; the needle alone where its shaft is all."""
    radius = max(needle.radius_mm, least_mm)
    shaft, top = tip_ct + needle.shaft_mm * outward_ct, tip_ct + needle.length_mm * outward_ct
    body = SceneBody("needle", "needle", bar(tip_ct, shaft, radius), palette.NEEDLE)
    if needle.length_mm - needle.shaft_mm < 1e-6:
        return (body,)
    holder = bar(shaft, top, needle.holder_diameter_mm / 2)
    return body, SceneBody("needle holder", "needle", holder, palette.HOLDER)


def chosen_direction(pick: Pick | None, plan: Any | None) -> Floats | None:
    """The outward direction of the plan, else of the picked candidate, else None; shape (3,), CT frame."""
    if plan is not None:
        direction = np.asarray(plan.entry_ct, dtype=float) - np.asarray(plan.target_ct, dtype=float)
        return np.asarray(direction / np.linalg.norm(direction))
    return None if pick is None else pick.candidates.outward_ct[pick.row]


def arm_bodies(case: Any, plan: Any | None, pick: Pick | None, T_base_ct: Floats | None) -> tuple[SceneBody, ...]:
    """The arm with the needle on the target: as it is planned, else as the search reaches it; nothing where unknown."""
    q, base = joints_on_target(plan, pick), T_base_ct if plan is None else plan.T_base_ct
    return () if q is None or base is None else ArmPicture(case.robot.model, base, case.tool).bodies(q)


def joints_on_target(plan: Any | None, pick: Pick | None) -> Floats | None:
    """Joints (6,), rad, with the needle on the target: of the plan, else of the pick; None where it is not reached."""
    if plan is not None:
        return np.asarray(plan.insertion.q[-1])
    q = None if pick is None else pick.candidates.arm.q_insertion[pick.row]
    return q if q is not None and np.isfinite(q).all() else None


def needle_text(needle: Any) -> str:
    """The needle in the legend, honest about a drawn thickness."""
    if needle.radius_mm >= LEAST_NEEDLE_MM:
        return "needle"
    return f"needle (drawn ⌀ {2 * LEAST_NEEDLE_MM:g} mm, is ⌀ {needle.diameter_mm:g} mm)"


FLANGE = 6  # the frame with which a tool moves


class ArmPicture:
    """The arm's links ready to be drawn at any configuration.

    Args:
        T_base_ct: Shape (4, 4), where the patient is believed (or known) to be.
        tool: What its flange carries beside needle and holder, or None.
    """

    def __init__(self, model: UrModel, T_base_ct: Floats, tool: ToolBody | None = None) -> None:
        self._model = model
        own = () if tool is None else (Link("tool", FLANGE, (tool.mesh,)),)
        self._links = (*visual_links(self._model), *own)
        self._T_ct_base = np.linalg.inv(T_base_ct)
        self.layers = tuple(Layer([Surface(link.mesh, palette.ARM)]) for link in self._links)

    def poses_ct(self, q: Floats) -> Floats:
        """T_ct_link of every layer, shape (k, 4, 4), mm, at a configuration (6,), rad."""
        frames = [link.frame for link in self._links]
        return np.asarray(self._T_ct_base @ link_poses(self._model, np.asarray(q))[frames])

    def bodies(self, q: Floats) -> tuple[SceneBody, ...]:
        """The links in the CT frame at one configuration."""
        links = []
        for link, T in zip(self._links, self.poses_ct(q), strict=True):
            colour = palette.HOLDER if link.name == "tool" else palette.ARM
            links.append(SceneBody(link.name, "arm", link.mesh.transformed(T), colour, frame=link.frame))
        return (*links, self.plate)

    @property
    def plate(self) -> SceneBody:
        """A plate under the arm's base, to show that it is mounted; a case does not say on what."""
        T = self._T_ct_base
        top, down = np.asarray(T[:3, 3], dtype=np.float64), np.asarray(T[:3, 2], dtype=np.float64)
        return SceneBody("base plate", "arm", bar(top, top - PLATE_THICK_MM * down, PLATE_RADIUS_MM), palette.TABLE)


def room(case: Any, T_base_ct: Floats | None) -> tuple[SceneBody, ...]:
    """The case's gantry and obstacles (table and the like); those given in the base frame need to know where it is."""
    bodies, gantry = [], case.gantry
    if gantry is not None:
        radius = gantry.bore_diameter_mm / 2
        wall = ring(gantry.T_ct_gantry, radius, radius + gantry.wall_mm, gantry.thickness_mm)
        bodies.append(SceneBody("gantry", "room", wall, palette.TABLE, GANTRY_OPACITY))
    for obstacle in case.obstacles:
        T = pose(np.eye(3), obstacle.center_mm)
        if obstacle.frame == "base":
            if T_base_ct is None:
                continue
            T = np.linalg.inv(T_base_ct) @ T
        bodies.append(SceneBody(obstacle.name, "room", box(T, obstacle.size_mm), palette.TABLE))
    return tuple(bodies)
