"""The scene as coloured meshes in the CT frame, for image, film and page: patient, room, arm, needle, corridor.

And views of it: of the workcell with the arm, and close to the needle's path.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import Link, visual_links
from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.reasons import SAFE, Rgb
from puncture_twin.planning.case.entry import ANATOMICAL_LPS, outward
from puncture_twin.planning.geometry.containment import hit_fraction
from puncture_twin.planning.geometry.mesh import TriangleMesh, box
from puncture_twin.planning.geometry.rigid import frame_about, pose
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.twin.report import palette
from puncture_twin.twin.report.map_view import grid_step
from puncture_twin.twin.report.raster.camera import ViewCamera, camera_around
from puncture_twin.twin.report.raster.render import Layer, Surface

SECTIONS = 24  # sides of a round bar
LIFT_MM = 1.0  # how far the corridor's mouth is drawn outside the skin, so that the two surfaces do not flicker
KEY = 1e-6  # rad; corners of cells nearer than this are one corner
FLANGE = 6  # the frame with which a tool moves


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
    """The corridor of safe directions: a patch of the skin for every safe cell of the grid, and the walls from there.

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


def _cells(candidates: Candidates, case: Any, rows: Ints) -> tuple[Floats, Ints]:
    """Corner points (n, 3), shared between cells, and the four corners (m, 4) of the cells of some rows."""
    half = grid_step(candidates) / 2
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
    """The closed surface that an outline draws as it is carried once around z; so many flat sides stand for the circle.

    The outline, (k, 2), mm, is radius, at least 0, and height of its corners, around the body to the left.
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
OUTSIDE_SHOWN_MM = np.array([150.0, 150.0, 0.0])  # drawn beyond the skin's box: to the sides, front and back
SKIN_OPACITY = 0.20
GANTRY_OPACITY = 0.15  # opacity of the gantry, so that it does not hide the patient in its bore
MOUTH_OPACITY = 0.88  # where a needle may enter: seen through green, what lies behind would look safe to hit
WALL_OPACITY = 0.10
TARGET_BALL_MM = 3.0  # radius of the ball that marks the target point
PLATE_RADIUS_MM, PLATE_THICK_MM = 130.0, 25.0  # under the arm: wider than any base, to be seen
LEAST_NEEDLE_MM = 1.0  # least radius that is drawn: thinner is below a pixel. The legend says so


@dataclass(frozen=True, eq=False)
class SceneBody:
    """One coloured body of the scene."""

    name: str
    group: str  # "organ", "skin", "safe", "needle", "arm", "room" or "target"
    mesh: TriangleMesh  # CT frame, mm
    colour: Rgb
    alpha: float = 1.0
    frame: int = 0  # of an arm's link: with which of ``link_poses`` it moves

    @property
    def surface(self) -> Surface:
        """Surface to draw; the corridor is flat colour, without the rim that makes a skin look like glass."""
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


class ArmPicture:
    """The arm's links ready to be drawn at any configuration, with a tool that its flange carries beside the needle.

    `T_base_ct`, (4, 4), mm, is where the patient is believed, or known, to be.
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


@dataclass(frozen=True, eq=False)
class Scene:
    """A direction of a search, or its plan, with patient, room and arm."""

    case: Any
    anatomy: Any
    candidates: Candidates
    plan: Any | None = None
    _: KW_ONLY
    pick: Pick | None = None  # the planned candidate, or the one to be shown; None shows the best
    T_base_ct: Floats | None = None  # shape (4, 4), mm, where the arm was checked; else None
    refusal: str = ""  # why there is no plan although one was requested

    @cached_property
    def chosen(self) -> Pick | None:
        """The pick, or the best direction."""
        return self.pick or self.candidates.best

    @property
    def base(self) -> Floats | None:
        """T_base_ct of the plan, else that of the search."""
        return self.T_base_ct if self.plan is None else self.plan.T_base_ct

    @property
    def path_ct(self) -> Floats | None:
        """Target and entry, shape (2, 3), of the plan, else of the chosen candidate."""
        if self.plan is not None:
            return np.stack([self.plan.target_ct, self.plan.entry_ct])
        if self.chosen is None:
            return None
        return np.stack([self.case.target_ct, self.chosen.candidates.path.entry_ct[self.chosen.row]])

    @property
    def outward_ct(self) -> Floats | None:
        """Shape (3,), unit, of the plan, else of the chosen candidate."""
        if self.plan is not None:
            direction = np.asarray(self.plan.entry_ct, dtype=float) - np.asarray(self.plan.target_ct, dtype=float)
            return np.asarray(direction / np.linalg.norm(direction))
        return None if self.chosen is None else self.chosen.candidates.outward_ct[self.chosen.row]

    @property
    def q_target(self) -> Floats | None:
        """Joints (6,), rad, with the needle on the target: as planned, else as the search reaches it, if it does."""
        if self.plan is not None:
            return np.asarray(self.plan.insertion.q[-1])
        q = None if self.chosen is None else self.chosen.candidates.arm.q_insertion[self.chosen.row]
        return q if q is not None and np.isfinite(q).all() else None

    @property
    def needle(self) -> tuple[SceneBody, ...]:
        """The needle on the target; nothing without a direction."""
        return () if self.outward_ct is None else needle_bodies(self.case.needle, self.case.target_ct, self.outward_ct)

    @property
    def arm(self) -> tuple[SceneBody, ...]:
        """With the needle on the target; nothing where that is not known."""
        if self.q_target is None or self.base is None:
            return ()
        return ArmPicture(self.case.robot.model, self.base, self.case.tool).bodies(self.q_target)


Size = tuple[int, int]  # width and height, pixels
FOV = np.radians(28.0)  # a long lens: little perspective, sizes compare
UPRIGHT = 0.5  # an entry frame whose z is so near the long axis (60 degrees) does not say what is up
ALONG_BODY = 0.62  # most cosine of a view along the body: from head or feet little is recognised
ENTRY_SIDE = 0.35  # least cosine between the needle and the way to whoever looks: from behind the body no entry is seen
ELEVATIONS = (np.radians(22.0), np.radians(40.0))
AZIMUTHS = 16
TILTS = (0.0, np.radians(25.0), np.radians(-25.0))
EXTENT_WEIGHT = 0.8  # what the focus' length in the picture counts, where all of it being seen counts 1
PATH_SAMPLES = 24
TARGET_WEIGHT = 8  # the target counts as so many points of the path when one asks what a view hides


def up_ct(case: Any) -> Floats:
    """Up in the workcell, unit, CT frame: the entry frame's z; the front of a patient whose frame is along the body."""
    z = np.asarray(case.T_ct_entry)[:3, 2]
    if str(case.space) != "local" and abs(z @ np.array(ANATOMICAL_LPS["head"])) > UPRIGHT:
        return np.array(ANATOMICAL_LPS["anterior"])
    return z


def overview(
    case: Any, content_ct: Floats, focus_ct: Floats, blockers: Layer, size: Size, outward_ct: Floats | None = None
) -> ViewCamera:
    """A view of everything from above the table and from the needle's side, from where it is best seen.

    The content, (n, 3), must be in the picture; the focus, (k, 3), should not be hidden. `outward_ct`, (3,), unit, is
    from the target out of the body along the needle; None looks from any side.
    """
    up = up_ct(case)
    options = [-one for one in _around(up, ELEVATIONS)]
    if str(case.space) != "local":
        options = [o for o in options if abs(o @ np.array(ANATOMICAL_LPS["head"])) < ALONG_BODY]
    if outward_ct is not None:
        options = [o for o in options if -o @ outward_ct > ENTRY_SIDE] or options
    return _best(options, up, content_ct, focus_ct, blockers, size)


def close_up(case: Any, path_ct: Floats, radius: float, blockers: Layer, size: Size) -> ViewCamera:
    """A view across a path (2, 3), target and entry, from where the fewest structures hide it; `radius` mm about it."""
    along = (path_ct[1] - path_ct[0]) / np.linalg.norm(path_ct[1] - path_ct[0])
    up = up_ct(case)
    options = [o for o in _around(along, TILTS) if o @ up < 0.35]  # not from below the table
    steps = np.linspace(0, 1, PATH_SAMPLES)[:, None]
    focus = path_ct[0] * (1 - steps) + path_ct[1] * steps
    focus = np.concatenate([focus, np.repeat(path_ct[:1], TARGET_WEIGHT, axis=0)])
    cube = radius * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
    content = np.concatenate([path_ct[0] + cube, path_ct[1] + cube])
    return _best(options, up, content, focus, blockers, size)


def _around(axis: Floats, tilts: Sequence[float]) -> list[Floats]:
    """Unit vectors about a unit axis (3,), at so many azimuths, so far toward it from across, rad."""
    side = -frame_about(axis)[:, 0]
    turns = (np.arange(AZIMUTHS) + 0.5) * 2 * np.pi / AZIMUTHS
    levels = [np.cos(turn) * side + np.sin(turn) * np.cross(axis, side) for turn in turns]
    return [np.cos(tilt) * level + np.sin(tilt) * axis for tilt in tilts for level in levels]


def _best(options: list[Floats], up: Floats, content: Floats, focus: Floats, blockers: Layer, size: Size) -> ViewCamera:
    """The option that sees most of the focus; among equals, the one that sees it longest in the picture."""
    content = content[ConvexHull(content).vertices]
    cameras = [
        camera_around(content, toward, up, fov=FOV, width=size[0], height=size[1])
        for toward in options
        if abs(toward @ up) <= 0.95
    ]
    if not cameras:
        return camera_around(content, frame_about(up)[:, 0], up, fov=FOV, width=size[0], height=size[1])
    spans = [np.ptp(camera.project(focus)[:, :2], axis=0) for camera in cameras]
    extents = [float(np.linalg.norm(span) / np.hypot(*size)) for span in spans]  # of the picture's diagonal
    best, best_score = 0, -np.inf
    for i in np.argsort(-np.array(extents), kind="stable").tolist():
        if EXTENT_WEIGHT * extents[i] + 1.0 < best_score:  # nor does one after it, were nothing hidden
            break
        score = float(blockers.sees(cameras[i].eye, focus).mean()) + EXTENT_WEIGHT * extents[i]
        if score > best_score or (score == best_score and i < best):
            best, best_score = i, score
    return cameras[best]
