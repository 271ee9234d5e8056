"""The ground truth of a stereo workcell: arm, cameras, head; frames are those of `twin.guidance.stereo.servo_case`."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.containment import crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose, rotated_about
from puncture_twin.twin.devices import GreyImage
from puncture_twin.twin.guidance.stereo.camera import Camera, tangent_axes
from puncture_twin.twin.guidance.stereo.servo_case import (
    CamerasSection,
    ServoCase,
    ServoErrors,
    calibration_frame,
    head_pose,
    planned_cameras,
)
from puncture_twin.twin.plant.ball_image import BallScene, render
from puncture_twin.twin.plant.truth import Gears, PlantArm, TrueArm, draw_true_arm

LINE_OF_SIGHT_RINGS = ((0.0, 1), (0.55, 6), (0.95, 12))
"""Where on the ball's disc a line of sight ends: fraction of the radius, and how many around."""
DIFFUSE = {"diffuse": 0.8, "lamp": 0.4}
"""Fraction of diffuse light; the rest is from one direction."""
WINDOW_MARGIN_PX = 24
"""An image, and the rod in it, are drawn this far beyond the region that is queried: the rest is never looked at."""
POINTED_MM = 3.0
"""Deviation of an operator's pointing at a marker in the images, per axis."""


class TrueNeedle(NamedTuple):
    """True tip minus true target (3,), mm, image axes; and the needle's axes as columns (3, 3), z to the tip."""

    error_m: Floats  # shape (3,), mm: true tip minus true target
    R_m_needle: Floats  # shape (3, 3): its axes as columns, z to the tip


class ShownBall(NamedTuple):
    """A true ball or marker, C, mm, and the direction (3,) along its rod; a marker has none."""

    center_c: Floats  # shape (3,)
    radius_mm: float
    rod_c: Floats | None  # shape (3,): along the rod; None for a marker, which has none


class TrueTool(NamedTuple):
    """Errors (3,) of rod and needle, flange axes: ball against belief, tip against ball, mm; lean about x, y, rad."""

    ball_offset: Floats  # shape (3,), mm: the ball's centre against where the controller has it
    tip_offset: Floats  # shape (3,), mm: the needle's tip against the ball's centre
    lean: Floats


@dataclass(frozen=True, eq=False)
class StereoWorkcell:
    """The ground truth of one workcell; T_c_m (4, 4), mm: the head when its markers are seen, and from then on."""

    case: ServoCase
    arm: TrueArm
    T_c_base: Floats  # shape (4, 4), mm: the true arm's base in C
    cameras: tuple[Camera, ...]
    T_c_m: Floats
    T_c_m_after: Floats  # shape (4, 4), mm: where it is from then on
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

    def _on_flange_c(self, q_true: Floats, offset: Floats) -> Floats:
        flange = self.arm.flange_pose(q_true)
        on_flange = offset + np.array([0.0, 0.0, self.case.file.tool.rod_mm])
        return apply(self.T_c_base, flange[..., :3, 3] + flange[..., :3, :3] @ on_flange)

    def needle_m(self, q_true: Floats, target: int) -> TrueNeedle:
        """The needle against a target of the case, by its number, at a true configuration (6,), rad."""
        tip_c = self._on_flange_c(q_true, self.tool.ball_offset + self.tool.tip_offset)
        R_c_needle = self.T_c_base[:3, :3] @ self.arm.flange_pose(q_true)[:3, :3] @ exp_rotation(self.tool.lean)
        R_m_c = self.T_c_m_after[:3, :3].T
        return TrueNeedle(R_m_c @ (tip_c - self.targets_c[target]), R_m_c @ R_c_needle)

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
        hits = crossings(self.head_c, camera.center_c, rays / lengths[:, None])
        nearest = np.full(len(rays), np.inf)
        nearest[hits.count > 0] = hits.depth[hits.first[hits.count > 0]]
        return float(np.mean(nearest < lengths - radius_mm))


class StereoPlant(PlantArm):
    """A workcell in time; it answers as arm, cameras and touch do. Each of them draws by a generator of its own."""

    def __init__(
        self, workcell: StereoWorkcell, pictures: np.random.Generator, arm: np.random.Generator,
        operator: np.random.Generator,
    ) -> None:  # fmt: skip
        super().__init__(workcell.arm, arm)
        self.workcell, self.pictures, self._operator = workcell, pictures, operator
        self.head_there = False  # in the workcell
        self._shown: ShownBall | None = None

    def show(self, ball: ShownBall | None) -> None:
        """Show a ball in place of the arm's; None shows the arm's again."""
        self._shown = ball

    @property
    def ball(self) -> ShownBall:
        """The ball on the arm, or what is shown in its place."""
        if self._shown is not None:
            return self._shown
        q, radius_mm = self.rests[-1], self.workcell.case.file.tool.ball_diameter_mm / 2
        return ShownBall(self.workcell.ball_c(q), radius_mm, self.workcell.rod_c(q))

    def nearest(self, number: int, about_px: Floats) -> ShownBall:
        """Of all that a camera may see, the ball or marker that is nearest to a pixel (2,)."""
        head, balls = self.workcell.case.file.head, [self.ball]
        if self.head_there:
            balls += [ShownBall(one, head.marker_diameter_mm / 2, None) for one in self.workcell.markers_c]
        away = [np.linalg.norm(self.workcell.cameras[number].project(one.center_c) - about_px) for one in balls]
        return balls[int(np.argmin(np.nan_to_num(away, nan=np.inf)))]

    def measured_image(self, number: int, about_px: Floats, reach_px: float) -> GreyImage:
        """An image with noise, of the part that holds what is queried and the ball; what the head hides is hidden."""
        camera, plan = self.workcell.cameras[number], self.workcell.case.file.cameras
        ball = self.nearest(number, about_px)
        hidden = self.workcell.hidden_fraction(camera, ball.center_c, ball.radius_mm) if self.head_there else 0.0
        away = np.abs(camera.project(ball.center_c) - about_px).max()
        radius = camera.ball_radius_px(ball.center_c, ball.radius_mm)
        half = int(np.ceil(np.nan_to_num(away, nan=0.0) + reach_px + 2 * radius)) + WINDOW_MARGIN_PX
        rng = self.pictures
        scene = replace(ball_scene(plan, ball, hidden, rng), rod_length_mm=half * ball.radius_mm / radius)
        return render(camera, scene, rng=rng, noise=plan.noise_grey, blur_px=plan.blur_px, half_px=half)

    def measured_cp(self) -> Floats:
        """The measuring arm's reading of the ball's centre, shape (3,), mm, C."""
        sigma = self.workcell.case.truth_errors.measuring_arm_mm
        return np.asarray(self.ball.center_c + self._rng.normal(0.0, sigma, 3))

    def pointed_cp(self, marker: str) -> Floats:
        """Point that an operator marks for a marker, shape (3,), mm, C."""
        point = self.workcell.markers_c[self.workcell.case.markers.names.index(marker)]
        return np.asarray(point + self._operator.normal(0.0, POINTED_MM, 3))


def ball_scene(plan: CamerasSection, ball: ShownBall, hidden: float, rng: np.random.Generator) -> BallScene:
    """The scene of a ball; an occluder that the case demands comes from any side."""
    from_side, diffuse = float(rng.uniform(-np.pi, np.pi)), DIFFUSE[plan.light]
    if ball.rod_c is None:
        return BallScene(ball.center_c, ball.radius_mm, rod=False, diffuse=diffuse,
                         hidden_fraction=min(hidden, 0.99), hidden_from=from_side)  # fmt: skip
    fraction = min(max(plan.occlusion, hidden), 0.99)
    return BallScene(ball.center_c, ball.radius_mm, ball.rod_c, diffuse=diffuse, hidden_fraction=fraction,
                     hidden_from=from_side)  # fmt: skip


def draw_workcell(case: ServoCase, rng: np.random.Generator) -> StereoWorkcell:
    """A workcell with its errors drawn from what the case declares, or from what it states as its truth."""
    errors = case.truth_errors
    arm = draw_true_arm(case.model, errors, rng)
    T_c_base = np.asarray(np.linalg.inv(calibration_frame(case)), dtype=np.float64)
    cameras = tuple(_misplaced(camera, errors, rng) for camera in planned_cameras(case))
    cameras = tuple(replace(one, distortion=one.distortion + rng.normal(0.0, errors.lens)) for one in cameras)
    ball, tip = (rng.normal(0.0, mm, 3) for mm in (errors.ball_offset_mm, errors.tip_offset_mm))
    tool = TrueTool(ball, tip, np.append(rng.normal(0.0, errors.needle_direction, 2), 0.0))
    T_c_m = T_c_base @ head_pose(case)
    moved = np.concatenate([rng.normal(0.0, errors.head_turn, 3), rng.normal(0.0, errors.head_shift_mm, 3)])
    after = rotated_about(T_c_m, apply(T_c_m, case.markers.points.mean(axis=0)), moved)
    if errors.gear_deg > 0.0:
        arm = arm._replace(gears=Gears(np.radians(errors.gear_deg), errors.gear_cycles, rng.uniform(-np.pi, np.pi, 6)))
    return StereoWorkcell(case, arm, T_c_base, cameras, T_c_m, after, tool)


def _misplaced(camera: Camera, errors: ServoErrors, rng: np.random.Generator) -> Camera:
    T = pose(exp_rotation(rng.normal(0.0, errors.camera_turn, 3)), rng.normal(0.0, errors.camera_shift_mm, 3))
    cx, cy = np.array([camera.cx, camera.cy]) + rng.normal(0.0, errors.camera_axis_px, 2)
    focal = camera.fx * (1.0 + rng.normal(0.0, errors.camera_focal))
    return replace(camera, fx=focal, fy=focal, cx=float(cx), cy=float(cy), T_camera_c=T @ camera.T_camera_c)
