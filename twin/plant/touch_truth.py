"""What is true when markers are touched: where patient and markers are, and what is wrong with the arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.marker_noise import parameter_variances
from puncture_twin.planning.touch.tour_motions import Touch
from puncture_twin.twin.plant.true_needle import driven_onto


@dataclass(frozen=True, eq=False)
class TouchTruth:
    """One draw of the declared errors.

    Attributes:
        seed: Of it.
        T_base_ct: Shape (4, 4), mm: where the patient truly lies.
        eta: Shape (28,): what is wrong with the arm's parameters, mm and rad.
        aim_ct: Marker to shape (3,), mm: where the tip comes to on the marker, its touch noise included.
        arrival: Marker to shape (6,), rad: true joints minus what the encoders say there.
    """

    seed: int
    T_base_ct: Floats
    eta: Floats
    aim_ct: dict[str, Floats]
    arrival: dict[str, Floats]

    def q_contact(self, model: UrModel, tip_mm: float, touch: Touch) -> Floats:
        """What the encoders say, shape (6,), rad, when the true tip is on the marker, the needle as planned."""
        there = apply(self.T_base_ct, self.aim_ct[touch.name])
        q_true = driven_onto(model, there[None], touch.q_touch[None], self.eta[None], tip_mm)[0]
        return np.asarray(q_true - self.arrival[touch.name])


def draw_touch_truth(
    T_base_ct: Floats, names: tuple[str, ...], points_ct: Floats, errors: ErrorModel, seed: int
) -> TouchTruth:
    """Draw where everything truly is.

    Args:
        T_base_ct: Shape (4, 4), mm: where the patient lies.
        names: The N markers.
        points_ct: Shape (N, 3), mm, as read.
        errors: As declared.
        seed: Of all draws.
    """
    rng = np.random.default_rng(seed)
    eta = rng.normal(size=28) * np.sqrt(parameter_variances(errors.arm))
    values, axes = np.linalg.eigh(errors.marker_cov_ct)
    read = rng.normal(size=points_ct.shape) * np.sqrt(np.maximum(values, 0.0)) @ axes.T
    aim = points_ct - read + rng.normal(0.0, errors.touch_mm, points_ct.shape)
    arrival = rng.normal(size=(len(names), 6)) * errors.arm.repeatability
    return TouchTruth(seed, T_base_ct, eta, dict(zip(names, aim, strict=True)), dict(zip(names, arrival, strict=True)))


def draw_pivot_truth(
    T_base_ct: Floats, names: tuple[str, ...], place_base: Floats, errors: ErrorModel, seed: int
) -> TouchTruth:
    """Draw what is wrong with an arm that sets its tip onto one place n times; the patient lies as believed.

    Args:
        T_base_ct: Shape (4, 4), mm.
        names: Of the touches.
        place_base: Shape (3,), mm.
        errors: As declared.
        seed: Of all draws.
    """
    rng = np.random.default_rng(seed)
    eta = rng.normal(size=28) * np.sqrt(parameter_variances(errors.arm))
    aim_base = place_base + rng.normal(0.0, errors.touch_mm, (len(names), 3))
    aim = apply(np.linalg.inv(T_base_ct), aim_base)
    arrival = rng.normal(size=(len(names), 6)) * errors.arm.repeatability
    return TouchTruth(seed, T_base_ct, eta, dict(zip(names, aim, strict=True)), dict(zip(names, arrival, strict=True)))


class AtTarget(NamedTuple):
    """What is true when the needle arrives: joints minus encoders, (6,), rad; and where the target is, (3,), mm."""

    arrival: Floats
    target_ct: Floats


def draw_at_target(target_ct: Floats, errors: ErrorModel, seed: int) -> AtTarget:
    """The joints drifted since the touches and arrive with their own error; the target was read with one.

    Args:
        target_ct: Shape (3,), mm, as read.
        errors: As declared.
        seed: Of the truth.
    """
    rng = np.random.default_rng([seed, 2])
    arrival = rng.normal(size=6) * np.hypot(errors.arm.repeatability, errors.arm.drift)
    values, axes = np.linalg.eigh(errors.target_cov_ct)
    return AtTarget(arrival, target_ct + axes @ (rng.normal(size=3) * np.sqrt(np.maximum(values, 0.0))))


def nominal_tip(model: UrModel, tip_mm: float, q: Floats) -> Floats:
    """Where the controller says that the tip is, shape (3,), mm, at encoders (6,), rad."""
    T = flange_pose(model, q)
    return np.asarray(T[:3, 3] + tip_mm * T[:3, 2])
