"""The ground truth of an ultrasound workcell: two arms as they move, the mounts of probe and needle."""

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import tangent_basis
from puncture_twin.twin.guidance.ultrasound.pose_choice import between_arms, nearest_configuration, needle_flange
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.plant.bmode_image import NeedleInImage, render
from puncture_twin.twin.plant.truth import PlantArm, TrueArm, draw_true_arm


class WorkcellTruth(NamedTuple):
    """The ground truth of one workcell: X is T_end1_image, Y is T_base1_base2, both (4, 4), mm; V the needle's axis."""

    probe_arm: TrueArm
    needle_arm: TrueArm
    X: Floats
    Y: Floats
    tip_end2: Floats  # shape (3,), mm
    V: Floats

    def image_pose(self, q_probe: Floats) -> Floats:
        """The true T_base1_image, shape (4, 4), mm, of the probe's arm at rest at ``q_probe`` (6,), rad."""
        return np.asarray(self.probe_arm.flange_pose(q_probe) @ self.X)

    def needle_in_image(self, q_probe: Floats, q_needle: Floats) -> NeedleInImage:
        """The true needle in the true image, both arms at rest."""
        T = np.linalg.inv(self.image_pose(q_probe)) @ self.Y @ self.needle_arm.flange_pose(q_needle)
        direction = T[:3, :3] @ self.V
        return NeedleInImage(T[:3, :3] @ self.tip_end2 + T[:3, 3], direction / np.linalg.norm(direction))


JOG_STEPS = 4
"""Steps of the operator's correction: each leaves about the arms' relative error, 1e-3, of what was left before."""


def jog_into_slice(
    truth: WorkcellTruth, q_probe: Floats, q_needle: Floats, wanted: NeedleInImage, roll: float
) -> Floats:
    """Move the needle's arm until the true needle is in the true image as wanted.

    It stands for the operator, or a servo on the image, that jogs until the needle shows: what is left is in
    ``wanted``. The probe's joints (6,), rad, rest, the needle's arm begins at ``q_needle`` (6,); roll, rad, is about
    the needle. Returns what the arm is commanded, (6,), rad, by the nominal kinematics, corrected by what the true arm
    did before; NaN where no configuration reaches it.
    """
    nominal = truth.needle_arm.nominal
    T_base2_image = (np.linalg.inv(truth.Y) @ truth.image_pose(q_probe))[None]
    tip, along = wanted.tip_image[None], wanted.direction_image[None]
    goal = needle_flange(T_base2_image, tip, along, np.array([roll]), truth.tip_end2, truth.V)[0]
    command, q = goal, np.array(q_needle)
    for _ in range(JOG_STEPS):
        q = nearest_configuration(nominal, command, q)
        if np.isnan(q).any():
            return q
        command = flange_pose(nominal, q) @ np.linalg.inv(truth.needle_arm.flange_pose(q)) @ goal
    return q


class ShownNeedle(NamedTuple):
    """Ground truth when an image was taken, and whether the arms touched each other."""

    needle: NeedleInImage
    touched: bool


class UltrasoundPlant:
    """A workcell in time: both arms, the probe, and the operator who jogs."""

    def __init__(self, case: SelfcalCase, truth: WorkcellTruth, rng: np.random.Generator) -> None:
        self._case, self._truth, self._rng = case, truth, rng
        self._between = between_arms(case, truth.X, truth.Y, 0.0)
        self.probe_arm, self.needle_arm = PlantArm(truth.probe_arm, rng), PlantArm(truth.needle_arm, rng)
        self.shown: list[ShownNeedle] = []
        """What was true at each image."""

    def jogged_jp(self, tip_mm: Floats, direction: Floats, roll: float, q: Floats) -> Floats:
        """Joints at which the true needle shows as wished, but for what a jog leaves: off the plane, and leaning."""
        off = self._case.content.truth
        lean = self._rng.normal(0.0, np.radians(off.lean_deg))
        tip = np.array([*tip_mm, self._rng.normal(0.0, off.off_plane_mm)])
        wanted = NeedleInImage(tip, np.array([*(np.cos(lean) * direction), np.sin(lean)]))
        return jog_into_slice(self._truth, self.probe_arm.rests[-1], q, wanted, roll)

    def measured_image(self) -> Pixels:
        """A B-mode image of the needle where both arms rest."""
        probe, needle, image = self.probe_arm.rests[-1], self.needle_arm.rests[-1], self._case.content.image
        shown = self._truth.needle_in_image(probe, needle)
        picture = render(image.imager(), shown, self._rng, echo=image.echo())
        self.shown.append(ShownNeedle(shown, not self._between.apart(probe, needle)))
        return picture


def draw_workcell(case: SelfcalCase, rng: np.random.Generator) -> WorkcellTruth:
    """A workcell whose differences from the drawing are drawn from the case's standard deviations."""
    content, off = case.content, case.content.truth
    declared = content.probe_arm, content.needle_arm
    arms = [draw_true_arm(model, arm.errors, rng) for model, arm in zip(case.models, declared, strict=True)]
    X, Y = (_shifted(T, off.mount_mm, np.radians(off.mount_deg), rng) for T in (case.T_end1_image, case.T_base1_base2))
    V = np.array([0.0, 0.0, 1.0])
    tip = case.tip_end2 + [*rng.normal(0.0, off.tip_mm, 2), rng.normal(0.0, off.length_mm)]
    bent = V + tangent_basis(V) @ rng.normal(0.0, np.radians(off.needle_deg), 2)
    return WorkcellTruth(arms[0], arms[1], X, Y, tip, bent / np.linalg.norm(bent))


def _shifted(T: Floats, mm: float, rad: float, rng: np.random.Generator) -> Floats:
    moved = np.array(T)
    moved[:3, 3] += rng.normal(0.0, mm, 3)
    moved[:3, :3] = T[:3, :3] @ exp_rotation(rng.normal(0.0, rad, 3))
    return moved
