"""Where two cameras look from, and what both of them see of the needle's balls and of the markers.

A line of sight is free where it crosses none of the surfaces that are in the way: the skin, what lies outside of the
body, the arm's bodies where the plan has them. A ball is seen where its middle and six points about it are.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import fcl
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import convex_hull
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, read_only
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.base.text import Facts, Shown, brief, first_few, plural
from puncture_twin.planning.case.case import bed_frame
from puncture_twin.planning.collision.bodies import PATIENT, Body, FclSkin, Solid, arm_bodies, touch
from puncture_twin.planning.collision.checker import SweptBodies
from puncture_twin.planning.geometry.containment import contains, crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.geometry.rigid import apply, inverse
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.context import CaseContext

DISTANCE_MM, BASELINE_MM = 1000.0, 500.0
"""Of proposed cameras: from the target, and from each other. The shipped servo workcell has them so."""
LOWEST, ELEVATIONS, AZIMUTHS = np.radians(20.0), 8, 36
"""Where the middle between proposed cameras is looked for: least height over the bed, steps up to straight above it,
and steps around: 10 degrees each. Neither camera is lower."""
STEPS = 7
"""Depths of the insertion at which is looked, from the standoff to the target."""
BALL_MM = 4.0
"""Radius of a ball on the shaft. One on the holder lies around it, and is as much wider."""
MARKER_MM = 5.0
"""A marker lies on the skin, whose surface may be read so far off: nearer to it nothing hides it."""
CAMERA_MM, BETWEEN_MM = 80.0, 20.0
"""Radius of a ball about a proposed camera, its housing and its mount, that nothing is in at some states of the motion;
at all others nothing is nearer than that less by the second."""


class Watched(NamedTuple):
    """A straight insertion without a plan, as `Plan` has its own: the approach is the standoff alone; mm."""

    model: UrModel
    T_base_ct: Floats
    target_ct: Floats
    outward_ct: Floats
    entry_ct: Floats
    needle_length_mm: float
    approach: Trajectory
    insertion: Trajectory


Names = NDArray[np.object_]
"""Texts, of any shape."""
Surfaces = Sequence[tuple[str, TriangleMesh]]
"""Names and surfaces, CT frame, mm."""


@dataclass(frozen=True, eq=False)
class CameraView(Shown):
    """What two cameras see during an insertion."""

    cameras_ct: Floats  # shape (2, 3), mm
    proposed: bool  # whether the case left their places open
    tip_to_target_mm: Floats  # shape (k,): the depths of the insertion, from the standoff to the target
    names: tuple[str, ...]  # what is to be seen: balls by their distance from the tip, then markers
    balls: int
    hidden: tuple[tuple[str, ...], ...]
    """For each depth and name, by what it is hidden from at least one camera; empty where both see it."""
    clear: bool  # whether nothing is or comes near the cameras; of proposed ones it is so

    @cached_property
    def seen(self) -> Bools:
        """What both cameras see at each depth, shape (k, n)."""
        return np.array([[not name for name in row] for row in self.hidden], np.bool_)

    @property
    def lost_mm(self) -> float | None:
        """Tip to target where the needle is first lost: no ball is seen by both; None where it never is."""
        lost = np.flatnonzero(~self.seen[:, : self.balls].any(axis=1))
        return float(self.tip_to_target_mm[lost[0]]) if len(lost) else None

    @property
    def sentence(self) -> str:
        """Sentence on what the cameras see."""
        always = plural(int(self.seen[:, self.balls :].all(axis=0).sum()), "marker") + " seen throughout"
        if not self.clear:
            always += f"; a camera is nearer than {CAMERA_MM:g} mm to patient, surroundings or moving arm"
        if self.lost_mm is None:
            return f"both cameras see a ball during the whole insertion; {always}"
        at = self.tip_to_target_mm.tolist().index(self.lost_mm)
        by = first_few(sorted({name for name in self.hidden[at][: self.balls] if name}))
        return f"no ball is seen {self.lost_mm:.0f} mm before the target: hidden by {by}; {always}"

    @brief
    def __repr__(self) -> str:
        return self.sentence

    def _facts(self) -> Facts:
        how = "proposed" if self.proposed else "stated"
        yield f"cameras, CT ({how})", "; ".join("({:.0f}, {:.0f}, {:.0f}) mm".format(*one) for one in self.cameras_ct)
        yield "seen", self.sentence
        for name, hidden in zip(self.names, zip(*self.hidden, strict=True), strict=True):
            by = first_few(sorted({one for one in hidden if one}))
            yield name, f"seen at {hidden.count('')} of {len(hidden)} depths" + (f"; hidden by {by}" if by else "")


def camera_view(context: CaseContext, plan: Plan | Watched) -> CameraView:
    """Where two cameras look from, and what they see during the insertion of a plan.

    Stated cameras are taken. Others are proposed: one meter from the target and half a meter apart, higher than the
    bed, where at most depths a ball is seen, then most balls, then most markers, then the needle from its side; and
    where neither patient, surroundings nor the moving arm comes near.

    Args:
        context: The case, with ``[stereo]``.

    Raises:
        InputError: The case declares no cameras, or states one in the patient.
        NoAnswerError: Whatever lies around the target leaves no place for two cameras.
    """
    stereo = context.case.stereo
    if stereo is None:
        refuse("no cameras are declared", context.case.path, "a table [stereo]", "no_stereo")
    checker = context.require_arm().checker
    tool, bodies = checker.tool, arm_bodies(plan.model, checker.tool, 0.0)
    static = [(PATIENT, context.anatomy.skin.mesh), *((one.name, one.mesh) for one in context.anatomy.surroundings)]
    known = None if context.placement is None else context.placement.registration
    markers = {} if known is None else dict(zip(known.markers.names, known.markers.points_ct, strict=True))
    looks = [*_looks(plan, bodies, stereo.balls_mm, tool.shaft_mm, tool.holder_diameter_mm / 2.0)]
    names = (*(f"ball {mm:g} mm" for mm in stereo.balls_mm), *(f"marker {name}" for name in markers))
    points = np.array([*markers.values()]).reshape(-1, 3)

    count, may_be = len(stereo.balls_mm), _free_places(static, bodies, checker.swept, plan)

    def answer(cameras_ct: Floats, hidden: Names) -> CameraView:
        rows = tuple(tuple(str(one or other) for one, other in row) for row in hidden)
        left_mm, clear = read_only(np.array([look.left_mm for look in looks])), all(map(may_be, cameras_ct))
        return CameraView(read_only(cameras_ct), stereo.cameras_ct is None, left_mm, names, count, rows, clear)

    if stereo.cameras_ct is not None:
        if any(contains(static[0][1], camera) for camera in stereo.cameras_ct):
            what = "stereo.cameras_mm: a camera is in the patient"
            refuse(what, context.case.path, "places outside of the skin", "camera_in_patient")
        return answer(stereo.cameras_ct, _hidden(looks, static, points, stereo.cameras_ct))
    T_ct_bed = bed_frame(context.case)
    pairs, middles = candidate_pairs(T_ct_bed)
    cameras, of_pair = np.unique(pairs.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    hidden = _hidden(looks, static, points, cameras)[:, :, of_pair.reshape(-1, 2)]  # depth, name, pair, camera
    both = (hidden == "").all(axis=3)
    keys = (-middles @ T_ct_bed[:3, 2], np.abs(middles @ plan.outward_ct).round(6), -both[:, count:].sum(axis=(0, 1)))
    order = np.lexsort((*keys, -both[:, :count].sum(axis=(0, 1)), -both[:, :count].any(axis=1).sum(axis=0)))
    for row in order:
        view = answer(pairs[row], hidden[:, :, row])
        if view.clear:
            return view
    what = f"no place for two cameras {DISTANCE_MM:g} mm from the target; state cameras_mm in [stereo]"
    raise NoAnswerError(what, code="no_camera_place", counts={"pairs": len(order)})


def candidate_pairs(T_ct_bed: Floats) -> tuple[Floats, Floats]:
    """Pairs of cameras about the origin of the bed frame, side by side and one above the other.

    That is ``T_ct_bed`` (4, 4), mm, z up, its origin on the target.

    Returns:
        Cameras, shape (n, 2, 3), CT mm, and the direction to the middle of each pair, shape (n, 3), unit.
    """
    height, around = np.linspace(LOWEST, np.pi / 2, ELEVATIONS), 2.0 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    up, turn = (grid.ravel() for grid in np.meshgrid(height, around, indexing="ij"))
    level = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    middle = np.cos(up)[:, None] * level + np.sin(up)[:, None] * [0.0, 0.0, 1.0]
    aside = np.stack([-level[:, 1], level[:, 0], level[:, 2]], axis=1)
    half = BASELINE_MM / 2.0 / DISTANCE_MM  # sine of half the angle between the two
    ahead = np.sqrt(1.0 - half**2) * np.concatenate([middle, middle])
    apart = half * np.concatenate([aside, np.cross(middle, aside)])
    bed = DISTANCE_MM * np.stack([ahead - apart, ahead + apart], axis=1)
    high = (bed[:, :, 2] >= DISTANCE_MM * np.sin(LOWEST) - 1e-6).all(axis=1)
    return apply(T_ct_bed, bed[high]), np.concatenate([middle, middle])[high] @ T_ct_bed[:3, :3].T


def hidden_by(surfaces: Surfaces, points_ct: Floats, cameras_ct: Floats, near_mm: float = 0.0) -> Names:
    """Name of the surface that hides any of the points from each camera; of several the first in the list.

    Args:
        points_ct: Shape (k, 3), mm.
        cameras_ct: Shape (n, 3), mm.
        near_mm: What is nearer to a point than this does not hide it.

    Returns:
        Names, shape (n,); empty where all of the points are seen.
    """
    names = np.full(len(cameras_ct), "", object)
    for name, mesh in surfaces:
        for point in points_ct:
            rows = np.flatnonzero((names == "") & (cameras_ct != point).any(axis=1))
            apart = cameras_ct[rows] - point
            far = np.linalg.norm(apart, axis=1)
            crossing = crossings(mesh, point, apart / far[:, None], float(far.max(initial=0.0)))
            names[rows[crossing.ray[(crossing.depth >= near_mm) & (crossing.depth <= far[crossing.ray])]]] = name
    return names


class _Look(NamedTuple):
    """One depth of the insertion."""

    left_mm: float  # tip to target
    arm: Surfaces
    balls: tuple[tuple[Floats, bool, bool], ...]
    """Of each ball: seven points, shape (7, 3), CT mm; whether it is in the body; whether it is around the holder."""


def _looks(
    plan: Plan | Watched, bodies: Sequence[Body], balls_mm: Sequence[float], shaft_mm: float, holder_mm: float
) -> Iterator[_Look]:
    """Arm and balls at each depth. The needle hides no ball: it runs through it. Nor does the holder one around it."""
    poses = inverse(plan.T_base_ct) @ link_poses(plan.model, plan.insertion.q)
    tips = poses[:, -1, :3, 3] + plan.needle_length_mm * poses[:, -1, :3, 2]
    left_mm, skin_mm = (tips - plan.target_ct) @ plan.outward_ct, float(np.linalg.norm(plan.entry_ct - plan.target_ct))
    surfaces = [(body, joined([*filter(None, map(convex_hull, body.bare.hulls))])) for body in bodies[:-1]]
    cross = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    for wanted in np.linspace(left_mm[0], left_mm[-1], STEPS):
        row, balls = int(np.argmin(np.abs(left_mm - wanted))), []
        for mm in balls_mm:
            around = mm + BALL_MM > shaft_mm
            radius = BALL_MM + (holder_mm if around else 0.0)
            inside = bool(left_mm[row] + mm - radius < skin_mm)  # however open the skin is
            balls.append((tips[row] + mm * plan.outward_ct + radius * cross, inside, around))
        arm = [(body.name, mesh.transformed(poses[row, body.frame] @ body.T_frame_body)) for body, mesh in surfaces]
        yield _Look(float(left_mm[row]), arm, tuple(balls))


def _hidden(looks: Sequence[_Look], static: Surfaces, markers_ct: Floats, cameras_ct: Floats) -> Names:
    """Names of what hides each ball and marker at each depth from each camera (m, 3): shape (k, n, m), texts."""
    still = [hidden_by(static, marker[None], cameras_ct, MARKER_MM) for marker in markers_ct]
    names = []
    for look in looks:
        rows = []
        for points, inside, around in look.balls:
            arm = [one for one in look.arm if not (around and one[0] == "holder")]
            by_body = np.full(len(cameras_ct), PATIENT, object)
            rows.append(by_body if inside else hidden_by([*static, *arm], points, cameras_ct))
        moving = [hidden_by(look.arm, marker[None], cameras_ct, MARKER_MM) for marker in markers_ct]
        names.append([*rows, *(np.where(one == "", other, one) for one, other in zip(still, moving, strict=True))])
    return np.array(names, object)


def _free_places(
    static: Surfaces, bodies: Sequence[Body], swept: SweptBodies, plan: Plan | Watched
) -> Callable[[Floats], bool]:
    """Whether a ball of `CAMERA_MM` about a point (3,), CT, is outside of everything while the arm moves."""
    q = np.concatenate([plan.approach.q, plan.insertion.q])
    moving = inverse(plan.T_base_ct) @ link_poses(plan.model, q[swept.rows_within(q, BETWEEN_MM)])
    skins = [FclSkin(mesh, name) for name, mesh in static]
    box = CAMERA_MM * np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])

    def free(camera_ct: Floats) -> bool:
        ball = Solid(partial(fcl.Sphere, CAMERA_MM), fcl.Transform(np.eye(3), camera_ct))
        if any(skin.touches(ball, box) for skin in skins) or any(contains(mesh, camera_ct) for _, mesh in static):
            return False
        for poses in moving:
            for body in bodies:
                centre = apply(poses[body.frame], body.T_frame_body[:3, 3])
                if np.linalg.norm(centre - camera_ct) <= body.radius_mm + CAMERA_MM:
                    body.place(poses)
                    if any(touch(ball.made, piece.made) for piece in body.bare.solids):
                        return False
        return True

    return free
