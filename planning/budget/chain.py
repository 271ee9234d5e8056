"""The chain from scan to needle as numbers that can be changed: errors, markers, touches, breath, and one insertion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.case.settings import SAME_MM
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.needle.deflection import GAUGES, Bending, Shaft
from puncture_twin.planning.reach.standoff import case_paths
from puncture_twin.planning.registration.fits import Aim, fit_triad, fit_uncertainty
from puncture_twin.planning.registration.marker_noise import reading_noise, touches
from puncture_twin.planning.registration.placement import aimed_uncertainty, default_method
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.bending import insertion_along
from puncture_twin.planning.uncertainty.pose_error import Bend, PoseError


@dataclass(frozen=True, eq=False)
class BentPath:
    """A needle that bends, and the tissues of its path, of ``path_length`` from target to skin, mm."""

    case: Case
    anatomy: Anatomy
    outward_ct: Floats  # from the target along the needle
    path_length: float
    bending: Bending

    @cached_property
    def bend(self) -> Bend:
        """The deflection, if the bevel never rotates."""
        insertion = insertion_along(self.bending, self.anatomy, self.case.target_ct, self.outward_ct, self.path_length)
        return Bend(insertion.tip_mm, self.bending.shaft.length_mm)


def bent_path(case: Case, anatomy: Anatomy, outward_ct: Floats) -> BentPath | None:
    """The path of one direction (3,), unit; None where the needle is straight, or the direction enters no skin."""
    if case.bending is None:
        return None
    paths = case_paths(case, anatomy.skin, outward_ct[None])
    length = float(paths.path_length[0])
    return BentPath(case, anatomy, outward_ct, length, case.bending) if np.isfinite(length) else None


def other_gauges(shaft: Shaft) -> dict[int, Shaft]:
    """Numbers of the next finer gauge and the two next thicker ones: tubes for a tube, rods for a rod."""
    by_width = sorted(GAUGES, key=lambda number: GAUGES[number].outer_mm)
    finer = [number for number in by_width if GAUGES[number].outer_mm < shaft.outer_mm - SAME_MM]
    thicker = [number for number in by_width if GAUGES[number].outer_mm > shaft.outer_mm + SAME_MM]
    solid = shaft.inner_mm == 0.0
    return {
        number: replace(shaft, outer_mm=GAUGES[number].outer_mm, inner_mm=0.0 if solid else GAUGES[number].inner_mm)
        for number in (*finer[-1:], *thicker[:2])
    }


GATES = (None, 0.5, 0.25, 0.1)
"""Position s of the breath that the needle waits for; None waits for none."""


@dataclass(frozen=True, eq=False)
class Chain:
    """The chain from a target in the CT to a needle's tip: registration, arm, errors."""

    model: UrModel
    tip_mm: float  # flange to tip
    method: str
    errors: ErrorModel  # as declared, times ``scale``
    scale: float  # by which the markers' residuals multiply every declared error: 1 where they agree
    points_ct: Floats  # shape (N, 3), the markers
    q_touch: Floats  # shape (N, 6), how the arm touches them
    T_base_ct: Floats  # shape (4, 4), mm
    target_ct: Floats  # shape (3,), mm
    q_insertion: Floats  # shape (6,), the tip on the target
    path: BentPath | None = None  # of a needle that bends; None for a straight one
    breathing: Breathing | None = None
    motion_base: Floats | None = None
    """Shape (3, 3), mm^2, of the target since the scan, base axes; None where it is not declared."""
    aim: Aim | None = None  # the insertion that a joint registration is corrected for

    def pose_error(self) -> PoseError:
        """The pose error of this chain, its errors taken as declared."""
        noise = reading_noise(self.errors, self.model, self.tip_mm, self.q_touch, known=True)
        points_base = apply(self.T_base_ct, self.points_ct)
        fit = fit_uncertainty(self.method, fit_triad, self.T_base_ct, self.points_ct, points_base, noise, found=False)
        target = apply(self.T_base_ct, self.target_ct)
        if self.aim is not None:
            fit = aimed_uncertainty(fit, self.points_ct, self.T_base_ct, target, self.aim)
        bend = None if self.path is None else self.path.bend
        return PoseError(self.model, self.tip_mm, target, self.errors, fit, bend)

    def tip_mean_square(self) -> Floats:
        """Mean square of the tip about the intended point, shape (3, 3), mm^2, base axes."""
        still = self.pose_error().tip_covariance(self.q_insertion[None])[0]
        return np.asarray(sum(self.body_mean_squares().values(), still))

    def body_mean_squares(self) -> dict[str, Floats]:
        """What the body adds, by source: shape (3, 3) each, mm^2, base axes."""
        by_source = {}
        if self.breathing is not None:  # of the target against where the CT shows it
            spread_base = self.T_base_ct[:3, :3] @ self.breathing.spread_ct
            by_source["breathing"] = spread_base @ spread_base.T
        return by_source if self.motion_base is None else {**by_source, "motion": self.motion_base}

    def expected_mm(self) -> float:
        """Expected (rms) distance of the tip from the intended point, mm."""
        return float(np.sqrt(np.trace(self.tip_mean_square())))

    def with_errors(self, errors: ErrorModel) -> Chain:
        """The chain with other declared errors; fitted again by them, unless the method is a triad, or joint."""
        method = self.method if self.method in {"triad", "joint"} else default_method(errors)
        return replace(self, errors=errors, method=method)


def chain_of(case: Case, registration: Registration, q_insertion: Floats, path: BentPath | None = None) -> Chain:
    """The chain of a case, with its breathing and motion, of an insertion (6,), rad, the tip on the target.

    The registration is by the case's own declaration; its residuals scale the errors. Where the needle bends, its path.
    """
    assert case.errors is not None and registration.uncertainty is not None
    scale, R = registration.uncertainty.test.scale, registration.T_base_ct[:3, :3]
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
        case.breathing,
        None if case.motion is None else R @ case.motion.target_cov_ct @ R.T,
        registration.aim,
    )
