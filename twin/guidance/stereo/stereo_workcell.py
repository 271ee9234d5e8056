"""The ground truth of a stereo workcell: an arm off its nominal model, two cameras, a head; drawn once for each seed.

Two frames matter to the guidance: the base's, in which the arm is commanded, and C, which the measuring arm defines at
the calibration and in which the cameras are known. How C lies in the base is not given to the guidance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.containment import crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, frame_yz, pose, rotated_about
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera, stereo_pair, tangent_axes
from puncture_twin.twin.guidance.stereo.declared_errors import CameraErrors
from puncture_twin.twin.guidance.stereo.joint.needle_error import TrueNeedle
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase, ToolSection
from puncture_twin.twin.plant.truth import ArmErrors, TrueArm, draw_true_arm

LINE_OF_SIGHT_RINGS = ((0.0, 1), (0.55, 6), (0.95, 12))
"""Where on the ball's disc a line of sight ends: fraction of the radius, and how many around."""


class TrueTool(NamedTuple):
    """Errors of rod and needle, flange axes."""

    ball_offset: Floats
    """Shape (3,), mm: the ball's centre against where the controller has it."""
    tip_offset: Floats
    """Shape (3,), mm: the needle's tip against the ball's centre."""
    lean: Floats
    """Shape (3,), rad: the needle's rotation against the flange, about x and y."""


@dataclass(frozen=True, eq=False)
class StereoWorkcell:
    """The ground truth of one workcell. Guidance must not look in here.

    Attributes:
        case: What it was drawn from.
        arm: The true arm.
        T_c_base: Shape (4, 4), mm: the true arm's base in C.
        cameras: The true cameras.
        T_c_m: Shape (4, 4), mm: true pose of the head when its markers are seen.
        T_c_m_after: Shape (4, 4), mm: where it is from then on.
        tool: The true tool.
    """

    case: ServoCase
    arm: TrueArm
    T_c_base: Floats
    cameras: tuple[Camera, ...]
    T_c_m: Floats
    T_c_m_after: Floats
    tool: TrueTool

    @property
    def model(self) -> UrModel:
        """The nominal arm."""
        return self.arm.nominal

    @property
    def markers_c(self) -> Floats:
        """True markers, shape (n, 3), mm."""
        return apply(self.T_c_m, self.case.markers.points)

    @property
    def targets_c(self) -> Floats:
        """True targets when the ball comes, shape (n, 3), mm."""
        return apply(self.T_c_m_after, self.case.targets.points)

    @cached_property
    def head_c(self) -> TriangleMesh:
        """True surface of the head when the ball comes, C, mm."""
        return self.case.skin.transformed(self.T_c_m_after)

    def ball_c(self, q_true: Floats) -> Floats:
        """True centre of the ball, shape (..., 3), mm, at true configurations (..., 6), rad."""
        return self._on_flange_c(q_true, self.tool.ball_offset)

    def tip_c(self, q_true: Floats) -> Floats:
        """True tip of the needle, shape (..., 3), mm, at true configurations (..., 6), rad."""
        return self._on_flange_c(q_true, self.tool.ball_offset + self.tool.tip_offset)

    def _on_flange_c(self, q_true: Floats, offset: Floats) -> Floats:
        flange = self.arm.flange_pose(q_true)
        on_flange = offset + np.array([0.0, 0.0, self.case.file.tool.rod_mm])
        return apply(self.T_c_base, flange[..., :3, 3] + flange[..., :3, :3] @ on_flange)

    def needle_c(self, q_true: Floats) -> Floats:
        """The needle's true axes as columns, z to the tip, shape (3, 3), C, at a true configuration (6,), rad."""
        R = self.T_c_base[:3, :3] @ self.arm.flange_pose(q_true)[:3, :3]
        return np.asarray(R @ exp_rotation(self.tool.lean))

    def needle_m(self, q_true: Floats, target: int) -> TrueNeedle:
        """The needle against a target of the case, by its number, at a true configuration (6,), rad."""
        R_m_c = self.T_c_m_after[:3, :3].T
        return TrueNeedle(R_m_c @ (self.tip_c(q_true) - self.targets_c[target]), R_m_c @ self.needle_c(q_true))

    def rod_c(self, q_true: Floats) -> Floats:
        """Unit direction from the ball along the rod to the flange, shape (3,), C."""
        return np.asarray(-self.T_c_base[:3, :3] @ self.arm.flange_pose(q_true)[:3, 2])

    def hidden_fraction(self, camera: Camera, point_c: Floats, radius_mm: float) -> float:
        """Fraction of a ball's disc that the head hides from a camera, 0 to 1, by lines of sight."""
        toward = point_c - camera.center_c
        across = tangent_axes(toward / np.linalg.norm(toward))
        angles = [(r * radius_mm, 2 * np.pi * k / n) for r, n in LINE_OF_SIGHT_RINGS for k in range(n)]
        ends = np.array([r * (np.cos(a) * across[:, 0] + np.sin(a) * across[:, 1]) for r, a in angles])
        rays = toward + ends
        lengths = np.linalg.norm(rays, axis=1)
        nearby = self._head_about(camera.center_c, toward / np.linalg.norm(toward), radius_mm)
        if nearby is None:
            return 0.0
        found = crossings(nearby, camera.center_c, rays / lengths[:, None])
        nearest = np.full(len(rays), np.inf)
        nearest[found.count > 0] = found.depth[found.first[found.count > 0]]
        return float(np.mean(nearest < lengths - radius_mm))

    @cached_property
    def _head_triangles(self) -> tuple[Floats, Floats]:
        """Middle (n, 3) of each of the head's triangles, and how far its corners are from there (n,), mm."""
        corners = self.head_c.triangles
        middles = corners.mean(axis=1)
        return middles, np.asarray(np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1))

    def _head_about(self, origin: Floats, direction: Floats, radius_mm: float) -> TriangleMesh | None:
        """Triangles of the head that a cylinder about a line may intersect; None where there are none."""
        middles, reach = self._head_triangles
        offsets = middles - origin
        aside = np.linalg.norm(offsets - (offsets @ direction)[:, None] * direction, axis=1)
        near = aside <= radius_mm + reach
        return TriangleMesh(self.head_c.vertices, self.head_c.faces[near]) if near.any() else None


def draw_workcell(case: ServoCase, rng: np.random.Generator) -> StereoWorkcell:
    """A workcell with its errors drawn from what the case declares, or from what it states as its truth.

    Raises:
        InputError: Cameras or arm that cannot be.
    """
    errors = case.truth_errors
    spread = ArmErrors(errors.link_mm, errors.twist, errors.joint, errors.backlash, errors.repeatability)
    arm = draw_true_arm(case.model, spread, rng)
    T_base_c = calibration_frame(case)
    T_c_base = np.asarray(np.linalg.inv(T_base_c), dtype=np.float64)
    cameras = tuple(_misplaced(camera, errors.camera, rng) for camera in planned_cameras(case))
    cameras = tuple(_with_other_lens(camera, errors.camera, rng) for camera in cameras)
    tool = TrueTool(
        rng.normal(0.0, errors.ball_offset_mm, 3),
        rng.normal(0.0, errors.tip_offset_mm, 3),
        np.append(rng.normal(0.0, errors.needle_direction, 2), 0.0),
    )
    T_c_m = T_c_base @ head_pose(case)
    moved = np.concatenate([rng.normal(0.0, errors.head_turn, 3), rng.normal(0.0, errors.head_shift_mm, 3)])
    after = rotated_about(T_c_m, apply(T_c_m, case.markers.points.mean(axis=0)), moved)
    return StereoWorkcell(case, arm, T_c_base, cameras, T_c_m, after, tool)


def planned_cameras(case: ServoCase) -> tuple[Camera, ...]:
    """The cameras as the case plans them; only a calibration tells where they are."""
    plan = case.file.cameras
    return stereo_pair(*plan.size_px, plan.focal_px, plan.baseline_mm, plan.distance_mm, plan.distortion)


def _misplaced(camera: Camera, errors: CameraErrors, rng: np.random.Generator) -> Camera:
    """A camera as it is in truth: rotated, shifted, its lens off its focal length and axis."""
    T = pose(exp_rotation(rng.normal(0.0, errors.turn, 3)), rng.normal(0.0, errors.shift_mm, 3))
    cx, cy = np.array([camera.cx, camera.cy]) + rng.normal(0.0, errors.axis_px, 2)
    focal = camera.fx * (1.0 + rng.normal(0.0, errors.focal))
    return replace(camera, fx=focal, fy=focal, cx=float(cx), cy=float(cy), T_camera_c=T @ camera.T_camera_c)


def _with_other_lens(camera: Camera, errors: CameraErrors, rng: np.random.Generator) -> Camera:
    return replace(camera, distortion=camera.distortion + rng.normal(0.0, errors.lens))


def calibration_frame(case: ServoCase) -> Floats:
    """T_base_c, shape (4, 4), mm: C at the calibrated volume's middle, z along the cameras' view, y down.

    The cameras stand on the far side of the head, seen from the arm, and look back and down at it.
    """
    down = np.radians(case.file.cameras.elevation_deg)
    z, y = np.array([-np.cos(down), 0.0, -np.sin(down)]), np.array([np.sin(down), 0.0, -np.cos(down)])
    return pose(frame_yz(y, z), case.file.calibration.center_mm)


def head_pose(case: ServoCase) -> Floats:
    """T_base_m, shape (4, 4), mm: the head's z up, its face (-y) along the base's x at yaw 0."""
    head = case.file.head
    return pose(Rotation.from_euler("z", 90.0 + head.yaw_deg, degrees=True).as_matrix(), head.position_mm)


def rod_tool(tool: ToolSection) -> Tool:
    """Rod and holder for the collision checker; the rod as thick as its ball, and up to the ball's far side."""
    length = tool.rod_mm + tool.ball_diameter_mm / 2
    return Tool(length, length - tool.holder_mm, tool.ball_diameter_mm, tool.holder_diameter_mm)


def workcell_checker(case: ServoCase, T_base_m: Floats | None) -> FastChecker:
    """The planner's collision checker of the workcell.

    Args:
        case: The case.
        T_base_m: Where the head is believed to stand, shape (4, 4), mm; None for a workcell without it.
    """
    boxes = []
    for box in case.file.box:
        boxes.append(Box(box.name, pose(np.eye(3), box.center_mm), box.size_mm))
    skin = None if T_base_m is None else case.skin.transformed(T_base_m)
    model, padding = case.model, case.file.servo.padding_mm
    return FastChecker(model, rod_tool(case.file.tool), boxes, skin, padding_mm=padding)
