# mypy: disable-error-code="no-untyped-def"
"""The scene as coloured meshes in the CT frame, for image, film and page.

Whether a surface hides its own back from whoever is outside of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import Link, visual_links
from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.base.reasons import SAFE, Rgb
from puncture_twin.planning.geometry.containment import hit_fraction
from puncture_twin.planning.geometry.mesh import TriangleMesh, box
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.twin.report import palette
from puncture_twin.twin.report.raster.render import Layer, Surface
from puncture_twin.twin.report.scene.shapes import ball, bar, corridor_mouth, corridor_walls, ring

ORGAN_OPACITY = 0.38
"""Opacity of the organ that holds the target, so that the lesion and its vessels show."""

MOST_AROUND = 0.7
"""A structure that hides the target from more than so much of all directions holds it: also an organ from whose label
the lesion is left out, and one with an opening, as of a vessel."""

UNKNOWN_OPACITY = 0.30
OUTSIDE_SHOWN_MM = np.array([150.0, 150.0, 0.0])
"""How far beyond the skin's box what is outside of the body is drawn: to the sides, front and back, along the bed."""
SKIN_OPACITY = 0.20
GANTRY_OPACITY = 0.15
"""Opacity of the gantry, so that it does not hide the patient in its bore."""

MOUTH_OPACITY = 0.88
"""Of where a needle may enter: what lies behind it hardly shows, since seen through green it would look safe to hit."""

WALL_OPACITY = 0.10

TARGET_BALL_MM = 3.0
"""Radius of the ball that marks the target point."""

PLATE_RADIUS_MM, PLATE_THICK_MM = 130.0, 25.0
"""Of the plate under the arm's base: wider than any base, so that it is seen."""

LEAST_NEEDLE_MM = 1.0
"""Least radius at which the needle is drawn: thinner ones would be below a pixel. The legend says so."""


@dataclass(frozen=True, eq=False)
class SceneBody:
    """One thing of the scene.

    Attributes:
        name: What the legend calls it.
        group: "organ", "skin", "safe", "needle", "arm", "room" or "target".
        mesh: CT frame, mm.
        colour: RGB.
        alpha: 1 for opaque; less for see-through.
        solid: See `Surface`.
        frame: Of an arm's link: with which of ``link_poses`` it moves.
    """

    name: str
    group: str
    mesh: TriangleMesh
    colour: Rgb
    alpha: float = 1.0
    solid: bool = False
    frame: int = 0

    @property
    def surface(self) -> Surface:
        """For the ray caster; the corridor is flat colour, without the rim that makes a skin look like glass."""
        rim = 0.0 if self.group == "safe" else Surface.rim
        return Surface(self.mesh, self.colour, self.alpha, rim, self.solid)

    def seen_from(self, eye_ct: Floats) -> Surface:
        """This part for an eye (3,), mm: solid where it looks solid, and the eye is not within its box."""
        low, high = self.mesh.bounds
        within = bool(np.all((low <= eye_ct) & (eye_ct <= high)))
        return replace(self.surface, solid=not within and self._hides_its_back)

    @cached_property
    def _hides_its_back(self) -> bool:
        return self.solid or (self.alpha >= 1 and faces_outwards(self.mesh))


@dataclass(frozen=True, eq=False)
class NeedleBodies:
    """Needle and holder at one place."""

    needle: SceneBody
    holder: SceneBody | None

    @property
    def all(self) -> tuple[SceneBody, ...]:
        """Both, or the needle alone where the shaft reaches the flange."""
        return (self.needle,) if self.holder is None else (self.needle, self.holder)


def patient(anatomy: Any, case: Any) -> tuple[SceneBody, ...]:
    """Organs, skin and the target's mark; what holds the target, and unknown structures, are see-through."""
    structures = anatomy.structures
    colours = palette.organ_colours(tuple(s.name for s in structures))
    bodies = [SceneBody(s.name, "organ", s.mesh, colours[s.name], _opacity(s, case)) for s in structures]
    bodies += [
        SceneBody(s.name, "organ", _near(s.mesh, anatomy.skin.mesh), palette.OUTSIDE, UNKNOWN_OPACITY)
        for s in anatomy.surroundings
        if str(s.role) == "unknown"
    ]
    bodies.append(SceneBody("skin", "skin", anatomy.skin.mesh, palette.SKIN, SKIN_OPACITY))
    bodies.append(SceneBody("target", "target", ball(case.target_ct, TARGET_BALL_MM), palette.TARGET_POINT))
    return tuple(bodies)


def _near(mesh: TriangleMesh, skin: TriangleMesh) -> TriangleMesh:
    """What is drawn of a surface that goes on beyond the image: its part about the skin, flattened at the rest."""
    low, high = skin.bounds
    return TriangleMesh(np.clip(mesh.vertices, low - OUTSIDE_SHOWN_MM, high + OUTSIDE_SHOWN_MM), mesh.faces)


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
    mouth, walls = corridor_mouth(candidates, case), corridor_walls(candidates, case)
    bodies = []
    if mouth is not None:
        bodies.append(SceneBody("safe entry", "safe", mouth, SAFE, MOUTH_OPACITY))
    if walls is not None:
        bodies.append(SceneBody("safe corridor", "safe", walls, SAFE, WALL_OPACITY))
    return tuple(bodies)


def needle_bodies(needle: Any, tip_ct: Floats, outward_ct: Floats, least_mm: float = LEAST_NEEDLE_MM) -> NeedleBodies:
    """Needle and holder with the tip at a point.

    Args:
        needle: With ``length_mm``, ``shaft_mm``, ``radius_mm``, ``holder_diameter_mm``.
        tip_ct: Shape (3,).
        outward_ct: Shape (3,), unit, from the tip to the flange.
        least_mm: Its radius at least.
    """
    radius = max(needle.radius_mm, least_mm)
    shaft, top = tip_ct + needle.shaft_mm * outward_ct, tip_ct + needle.length_mm * outward_ct
    body = SceneBody("needle", "needle", bar(tip_ct, shaft, radius), palette.NEEDLE)
    if needle.length_mm - needle.shaft_mm < 1e-6:
        return NeedleBodies(body, None)
    holder = bar(shaft, top, needle.holder_diameter_mm / 2)
    return NeedleBodies(body, SceneBody("needle holder", "needle", holder, palette.HOLDER))


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


FLANGE = 6
"""The frame with which a tool moves."""


class ArmPicture:
    """The arm's links ready to be drawn at any configuration.

    Args:
        model: The arm.
        T_base_ct: Shape (4, 4), where the patient is believed (or known) to be.
        tool: What its flange carries beside needle and holder, or None.
    """

    def __init__(self, model: UrModel, T_base_ct: Floats, tool: ToolBody | None = None) -> None:
        self._model = model
        own = () if tool is None else (Link("tool", FLANGE, (tool.mesh,)),)
        self._links = (*visual_links(self._model), *own)
        self._T_ct_base = np.linalg.inv(T_base_ct)
        self.layers = tuple(
            Layer([Surface(link.mesh, palette.ARM, solid=self._is_solid(link))]) for link in self._links
        )

    def _is_solid(self, link: Link) -> bool:
        """Links of the arms that ship are; of an own arm and tool nobody knows."""
        return self._model.urdf is None and link.name != "tool"

    def poses_ct(self, q: Floats) -> Floats:
        """T_ct_link of every layer, shape (k, 4, 4), mm, at a configuration (6,), rad."""
        frames = [link.frame for link in self._links]
        return np.asarray(self._T_ct_base @ link_poses(self._model, np.asarray(q))[frames])

    def bodies(self, q: Floats) -> tuple[SceneBody, ...]:
        """The links in the CT frame at one configuration."""
        poses = self.poses_ct(q)
        links = (
            SceneBody(
                link.name,
                "arm",
                link.mesh.transformed(T),
                palette.HOLDER if link.name == "tool" else palette.ARM,
                solid=self._is_solid(link),
                frame=link.frame,
            )
            for link, T in zip(self._links, poses, strict=True)
        )
        return (*links, self.plate)

    @property
    def plate(self) -> SceneBody:
        """A plate under the arm's base, to show that it is mounted; a case does not say on what."""
        T = self._T_ct_base
        top, down = np.asarray(T[:3, 3], dtype=np.float64), np.asarray(T[:3, 2], dtype=np.float64)
        return SceneBody("base plate", "arm", bar(top, top - PLATE_THICK_MM * down, PLATE_RADIUS_MM), palette.TABLE)


def room(case: Any, T_base_ct: Floats | None) -> tuple[SceneBody, ...]:
    """The case's gantry and obstacles (table and the like); those given in the base frame need to know where it is."""
    bodies = [] if case.gantry is None else [_gantry(case.gantry)]
    for obstacle in case.obstacles:
        T = pose(np.eye(3), obstacle.center_mm)
        if obstacle.frame == "base":
            if T_base_ct is None:
                continue
            T = np.linalg.inv(T_base_ct) @ T
        bodies.append(SceneBody(obstacle.name, "room", box(T, obstacle.size_mm), palette.TABLE))
    return tuple(bodies)


def _gantry(gantry: Any) -> SceneBody:
    radius = gantry.bore_diameter_mm / 2
    wall = ring(gantry.T_ct_gantry, radius, radius + gantry.wall_mm, gantry.thickness_mm)
    return SceneBody("gantry", "room", wall, palette.TABLE, GANTRY_OPACITY)


def faces_outwards(mesh: TriangleMesh) -> bool:
    """Whether a surface is closed, and every triangle that faces away from an eye outside of it is behind another.

    No where it has a hollow, which is wound like a piece that is inside out.
    """
    return mesh.closed and mesh.wound_alike and bool(_every_piece_holds_volume(mesh.vertices, mesh.faces))


@nb.njit(cache=True, error_model="numpy")
def _every_piece_holds_volume(vertices, faces):
    """Whether triangles that hang together by their corners enclose more than nothing, seen from their outside.

    Where a surface repeats corners, its pieces may be open, and what they enclose is measured from its first corner:
    of those of a closed surface that is inside out at least one holds less than nothing.

    Args:
        vertices: Shape (n, 3), mm, read-only.
        faces: Shape (m, 3), read-only.
    """
    piece = np.arange(len(vertices))  # of each corner another one of the same piece, of one corner itself
    for f in range(len(faces)):
        a = _first_of(piece, faces[f, 0])
        for k in range(1, 3):
            b = _first_of(piece, faces[f, k])
            a, b = min(a, b), max(a, b)
            piece[b] = a
    volume = np.zeros(len(vertices))
    for f in range(len(faces)):
        ax, ay, az = _from_first(vertices, faces[f, 0])
        bx, by, bz = _from_first(vertices, faces[f, 1])
        cx, cy, cz = _from_first(vertices, faces[f, 2])
        holds = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        volume[_first_of(piece, faces[f, 0])] += holds
    least = np.inf
    for f in range(len(faces)):
        least = min(least, volume[_first_of(piece, faces[f, 0])])
    return least > 0.0


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _first_of(piece, corner):
    while piece[corner] != corner:
        piece[corner] = piece[piece[corner]]  # halves the way for whoever comes next
        corner = piece[corner]
    return corner


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _from_first(vertices, corner):
    return (
        vertices[corner, 0] - vertices[0, 0],
        vertices[corner, 1] - vertices[0, 1],
        vertices[corner, 2] - vertices[0, 2],
    )
