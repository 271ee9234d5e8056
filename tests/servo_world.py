"""A servo session without pictures, for tests: the embedded head, a drawn arm, pixels with normal errors."""

from typing import NamedTuple

import numpy as np

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.twin.guidance.stereo.joint_model import N_ROD, Guess, Observed, Unknowns
from puncture_twin.twin.guidance.stereo.servo_case import (
    calibration_frame,
    grid_points,
    head_pose,
    load_servo_case,
    planned_cameras,
)
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod, ball_base, configurations, rod_orientation
from puncture_twin.twin.plant.stereo_workcell import draw_workcell

CASE = load_servo_case(folder() / "head")
HELD = CarriedRod(ur_model("ur3"), CASE.file.tool.rod_mm, rod_orientation(np.radians(CASE.file.tool.tilt_deg)))
PIXEL_PX, MEASURING_MM, IMAGE_MM = 0.03, 0.01, 0.3


class NoContacts:
    """A judge who sees no contact anywhere."""

    model = HELD.model

    def first_contact(self, q_path, *, needle_may_touch_patient):
        return

    def sweep_mm(self, q_path):
        return np.zeros(len(q_path) - 1)


class Simulated(NamedTuple):
    """What was measured, and the truth."""

    observed: Observed
    guess: Guess
    balls_c: np.ndarray
    targets_c: np.ndarray
    workcell: object
    truth: Unknowns


def start_configurations():
    targets = apply(head_pose(CASE), CASE.targets.points)
    return configurations(HELD, np.concatenate([grid_points(CASE), targets]), NoContacts()).q


def simulate(seed, stays=2):
    """A session up to the marker pictures and a few stays at targets, everything with normal errors."""
    rng = np.random.default_rng(seed)
    workcell = draw_workcell(CASE, rng)
    cameras = workcell.cameras
    q = start_configurations()[: 12 + stays]
    spread = np.sqrt(workcell.arm.repeatability**2 + workcell.arm.backlash**2 / 4)
    spheres = workcell.ball_c(q + rng.normal(0.0, spread, q.shape))
    pixels, markers = ([c.project(p) for c in cameras] for p in (spheres, workcell.markers_c))
    pixels, markers = (np.array(p) + rng.normal(0.0, PIXEL_PX, np.shape(p)) for p in (pixels, markers))
    round_errors = [np.broadcast_to(PIXEL_PX**2 * np.eye(2), (*p.shape, 2)) for p in (pixels, markers)]
    measured = spheres[:12] + rng.normal(0.0, MEASURING_MM, (12, 3))
    image = CASE.markers.points + rng.normal(0.0, IMAGE_MM, CASE.markers.points.shape)
    T_c_base = fit_rigid(ball_base(HELD, q[:12]), measured)
    T_c_m = np.linalg.inv(calibration_frame(CASE)) @ head_pose(CASE)
    guess = Guess(T_c_base, T_c_m, np.concatenate([measured, apply(T_c_base, ball_base(HELD, q[12:]))]))
    observed = Observed(
        planned_cameras(CASE), HELD, CASE.errors, q, pixels, round_errors[0], measured, markers, round_errors[1], image
    )  # fmt: skip
    truth = Unknowns(np.zeros((2, 13)), np.zeros(6), np.zeros(N_ROD), np.zeros(6), CASE.markers.points.copy(), spheres)
    return Simulated(observed, guess, spheres, workcell.targets_c, workcell, truth)
