"""A workcell drawn from what the case states: arms off their nominal models, mounts off the drawing, a bent needle."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import tangent_basis
from puncture_twin.twin.guidance.ultrasound.selfcal_case import ErrorsSection, SelfcalCase
from puncture_twin.twin.guidance.ultrasound.selfcal_truth import WorkcellTruth
from puncture_twin.twin.plant.true_arm import ArmErrors, draw_true_arm


def draw_workcell(case: SelfcalCase, rng: np.random.Generator) -> WorkcellTruth:
    """A room whose differences from the drawing are drawn from the case's standard deviations."""
    content, off = case.content, case.content.truth
    arms = [
        draw_true_arm(model, _spread(arm.errors), rng)
        for model, arm in zip(case.models, (content.probe_arm, content.needle_arm), strict=True)
    ]
    X, Y = (_shifted(T, off.mount_mm, np.radians(off.mount_deg), rng) for T in (case.T_end1_image, case.T_base1_base2))
    V = np.array([0.0, 0.0, 1.0])
    tip = case.tip_end2 + [*rng.normal(0.0, off.tip_mm, 2), rng.normal(0.0, off.length_mm)]
    bent = V + tangent_basis(V) @ rng.normal(0.0, np.radians(off.needle_deg), 2)
    return WorkcellTruth(arms[0], arms[1], X, Y, tip, bent / np.linalg.norm(bent))


def _spread(stated: ErrorsSection) -> ArmErrors:
    angles = np.radians([stated.twist_deg, stated.joint_deg, stated.backlash_deg, stated.repeatability_deg])
    return ArmErrors(stated.link_mm, *(float(angle) for angle in angles))


def _shifted(T: Floats, mm: float, rad: float, rng: np.random.Generator) -> Floats:
    moved = np.array(T)
    moved[:3, 3] += rng.normal(0.0, mm, 3)
    moved[:3, :3] = T[:3, :3] @ exp_rotation(rng.normal(0.0, rad, 3))
    return moved
