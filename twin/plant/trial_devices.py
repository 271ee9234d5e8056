"""Devices of many trials at once, at the level of positions: cameras, a probe on its arm, a CT."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.case.settings import Stereo, Ultrasound
from puncture_twin.planning.case.tables import ControlScanSection
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, inverse, pose
from puncture_twin.planning.uncertainty.guided import picture_root, scan_roots

FAR_MM = 1500.0
"""Of the cameras from the arm's base, per axis: their frame is of their own, and nobody knows it."""


@dataclass(frozen=True, eq=False)
class TrialCameras:
    """Two cameras, calibrated to each other, anywhere in each of n trials."""

    device: Stereo
    T_cameras_base: Floats  # shape (n, 4, 4), mm
    rng: np.random.Generator

    @classmethod
    def placed(cls, device: Stereo, count: int, rng: np.random.Generator) -> TrialCameras:
        """Cameras of so many trials."""
        return cls(device, pose(exp_rotation(rng.normal(size=(count, 3))), FAR_MM * rng.normal(size=(count, 3))), rng)

    def read(self, points_base: Floats) -> Floats:
        """Points (n, m, 3), or (m, 3) in all trials, as the cameras give them in their own frame: (n, m, 3), mm."""
        R, t = self.T_cameras_base[:, :3, :3], self.T_cameras_base[:, None, :3, 3]
        seen = points_base @ np.swapaxes(R, 1, 2) + t
        return np.asarray(seen + self.rng.normal(size=seen.shape) * self.device.sd_mm)


@dataclass(frozen=True, eq=False)
class TrialProbe:
    """A probe in each of n trials; `target_off` and `tip_off` (n, 3), mm, base axes, last all the way in."""

    target_off: Floats
    tip_off: Floats

    @classmethod
    def placed(cls, device: Ultrasound, across: Floats, count: int, rng: np.random.Generator) -> TrialProbe:
        """Probes of so many trials, whose pictures have this normal (3,), base axes."""
        calibration, target, tip = rng.normal(size=(3, count, 3))
        shift = device.calibration_sd_mm * calibration
        target_off = shift + target @ picture_root(device.target_sd_mm, across)
        return cls(target_off, shift + tip @ picture_root(device.tip_sd_mm, across))

    def target(self, points_base: Floats) -> Floats:
        """Targets (n, 3) as the pictures show them, mm, base axes."""
        return points_base + self.target_off

    def tip(self, points_base: Floats) -> Floats:
        """Tips (n, 3) as the pictures show them."""
        return points_base + self.tip_off


@dataclass(frozen=True, eq=False)
class TrialScanner:
    """A CT in each of n trials, its frame that of the first CT; what is taken for the target is so in all its scans."""

    T_ct_base: Floats  # shape (4, 4), mm: where the couch really is
    tip_root: Floats  # shape (3, 3), mm, CT axes: S with S S' the covariance of a tip's reading
    target_off: Floats  # shape (n, 3), mm: what target readings are off by
    rng: np.random.Generator

    @classmethod
    def placed(
        cls, device: ControlScanSection, errors: ErrorModel, T_base_ct: Floats, count: int, rng: np.random.Generator
    ) -> TrialScanner:
        """Scanners of so many trials."""
        tip, target = scan_roots(device, errors)
        return cls(inverse(T_base_ct), tip, rng.normal(size=(count, 3)) @ target, rng)

    def tip(self, points_base: Floats) -> Floats:
        """Tips (n, 3) as the scans show them, mm, CT frame."""
        return np.asarray(apply(self.T_ct_base, points_base) + self.rng.normal(size=points_base.shape) @ self.tip_root)

    def target(self, points_ct: Floats) -> Floats:
        """Targets (n, 3), mm, CT frame, as the scans show them."""
        return points_ct + self.target_off
