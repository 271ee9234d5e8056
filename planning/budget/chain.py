"""The chain from scan to needle as numbers that can be changed: errors, markers, touches, breath, and one insertion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.breathing.lujan import mean_square_within
from puncture_twin.planning.budget.bent_path import BentPath
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.aim import Aim
from puncture_twin.planning.registration.aim_correction import aimed_uncertainty
from puncture_twin.planning.registration.fit_uncertainty import fit_uncertainty
from puncture_twin.planning.registration.fits.least_squares import fit_triad
from puncture_twin.planning.registration.marker_noise import touches
from puncture_twin.planning.registration.placement import default_method
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.registration.touch_noise import reading_noise
from puncture_twin.planning.uncertainty.pose_error import PoseError

GATES = (None, 0.5, 0.25, 0.1)
"""Of the needle that waits, by s; None waits for nothing."""


@dataclass(frozen=True, eq=False)
class Breath:
    """The breathing of a case, in its base frame.

    Attributes:
        breathing: As declared.
        R_base_ct: Shape (3, 3).
    """

    breathing: Breathing
    R_base_ct: Floats

    def mean_square_base(self) -> Floats:
        """Shape (3, 3), mm^2, of the target against where the CT shows it, base axes."""
        one = self.breathing
        moved = self.R_base_ct @ (one.amplitude_mm * one.direction_ct)
        gate = 1.0 if one.gate is None else one.gate
        return np.asarray(mean_square_within(gate, one.exponent, one.scanned_at) * np.outer(moved, moved))


@dataclass(frozen=True, eq=False)
class Chain:
    """What ties a target in the CT to a needle's tip.

    Attributes:
        model: The arm.
        tip_mm: Flange to tip.
        method: Of the registration: triad, rigid, weighted or joint.
        errors: As declared, times ``scale``.
        scale: By which the markers' residuals multiply every declared error: 1 where they agree.
        points_ct: Shape (N, 3), mm, the markers.
        q_touch: Shape (N, 6), rad, how the arm touches them.
        T_base_ct: Shape (4, 4), mm.
        target_ct: Shape (3,), mm.
        q_insertion: Shape (6,), rad, the tip on the target.
        path: Of a needle that bends; None for a straight one.
        breath: None where nobody declares it.
        aim: The insertion that a joint registration is corrected for.
    """

    model: UrModel
    tip_mm: float
    method: str
    errors: ErrorModel
    scale: float
    points_ct: Floats
    q_touch: Floats
    T_base_ct: Floats
    target_ct: Floats
    q_insertion: Floats
    path: BentPath | None = None
    breath: Breath | None = None
    aim: Aim | None = None

    def pose_error(self) -> PoseError:
        """Of this chain, its errors taken for declared."""
        noise = reading_noise(self.errors, self.model, self.tip_mm, self.q_touch, known=True)
        points_base = apply(self.T_base_ct, self.points_ct)
        fit = fit_uncertainty(self.method, fit_triad, self.T_base_ct, self.points_ct, points_base, noise, found=False)
        target = apply(self.T_base_ct, self.target_ct)
        if self.aim is not None:
            fit = aimed_uncertainty(fit, self.points_ct, self.T_base_ct, target, self.aim)
        bend = None if self.path is None else self.path.bend
        return PoseError(self.model, self.tip_mm, target, self.errors, fit, bend)

    def tip_mean_square(self) -> Floats:
        """Of the tip against the point that was meant, shape (3, 3), mm^2, base axes."""
        still = self.pose_error().tip_covariance(self.q_insertion[None])[0]
        return still if self.breath is None else still + self.breath.mean_square_base()

    def expected_mm(self) -> float:
        """Tip against the point that was meant, rms."""
        return float(np.sqrt(np.trace(self.tip_mean_square())))

    def with_errors(self, errors: ErrorModel) -> Chain:
        """With other errors; weighted again as they ask for, unless the method is a triad, or joint with the arm."""
        method = self.method if self.method in {"triad", "joint"} else default_method(errors)
        return replace(self, errors=errors, method=method)


def chain_of(case: Case, registration: Registration, q_insertion: Floats, path: BentPath | None = None) -> Chain:
    """The chain of a case, with its breathing.

    Args:
        case: With declared errors.
        registration: Of its markers, with the case's own declaration, to whose residuals the errors are scaled.
        q_insertion: Shape (6,), rad, the tip on the target.
        path: Of the needle there, where it bends.
    """
    assert case.errors is not None and registration.uncertainty is not None
    scale = registration.uncertainty.test.scale
    return Chain(
        case.robot.model,
        case.needle.length_mm,
        registration.method,
        case.errors.scaled(scale),
        scale,
        registration.markers.points_ct,
        touches(case, registration.markers),
        registration.T_base_ct,
        case.target_ct,
        q_insertion,
        path,
        None if case.breathing is None else Breath(case.breathing, registration.T_base_ct[:3, :3]),
        registration.aim,
    )
