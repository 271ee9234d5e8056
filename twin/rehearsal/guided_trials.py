"""Trials under guidance: look, correct, go on. The devices are the plant's; the correction knows readings and belief.

The belief is linear (`planning.uncertainty.guided`), the truth is not. After each look the needle is moved parallel to
itself by what all readings so far call for; what would leave the corridor is not executed, and the trial is stopped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.uncertainty.guided import (
    CAMERAS,
    SCANNED_TARGET,
    SCANNED_TIP,
    GuidedModel,
    Look,
    ball_name,
    marker_name,
)
from puncture_twin.twin.plant.trial_devices import TrialCameras, TrialProbe, TrialScanner
from puncture_twin.twin.plant.true_needle import TrueNeedle, true_needle
from puncture_twin.twin.rehearsal.trials import (
    Puncture,
    Trials,
    Truths,
    apply_each,
    bent,
    commanded,
    ended,
    open_loop,
    pushed_by,
    registered,
)

Readings = dict[tuple[str, int], Floats]
"""By name and look, less what the belief expects: shape (n, m)."""


@dataclass(frozen=True, eq=False)
class Way:
    """A way of guidance, as it corrects: by what is believed, a correction stays within the corridor of the plan."""

    name: str
    model: GuidedModel
    corridor_mm: float


class GuidedTrials(NamedTuple):
    """Trials under one way of guidance."""

    trials: Trials
    stopped: Bools  # shape (n,)
    aside_base: Floats  # shape (n, 3), mm, how far from its plan each believes to be
    moved_mm: Floats  # shape (n, corrections), by each correction; NaN where it was not executed


def guided_trials(
    puncture: Puncture, truths: Truths, errors: ErrorModel, way: Way, rng: np.random.Generator
) -> GuidedTrials:
    """Rehearse the puncture in each trial by a way of guidance; ``rng`` draws devices, and arrivals before the last."""
    count, model = len(truths.eta), way.model
    if not model.corrects(way.name):
        none = np.zeros(count, bool), np.zeros((count, 3)), np.empty((count, 0))
        return GuidedTrials(open_loop(puncture, truths), *none)
    T_base_ct = registered(puncture, truths)
    turned = T_base_ct[:, :3, :3] @ model.error.fit.R_base_ct.T  # the gain is of the nominal patient's axes
    devices = _Devices.of(puncture, truths, model, T_base_ct, rng)
    drift = _drift(errors, truths.arrival, rng)
    moved, aside, moves = np.zeros((count, 3)), np.zeros((count, 3)), list[Floats]()
    stopped, reached = np.zeros(count, bool), np.ones(count, bool)
    readings: Readings = {
        ("touch", -1): (truths.touched_base - apply_each(T_base_ct, truths.read_ct)).reshape(count, -1)
    }
    for number, look in enumerate(model.looks):
        q, there = commanded(puncture, T_base_ct, moved, look.out_mm, look.q)
        arrival = rng.normal(size=(count, 6)) * errors.arm.arriving
        needle = true_needle(puncture.model, q + drift + arrival, truths.eta, puncture.tip_mm)
        readings |= devices.look(look, number, q, needle)
        reached &= there
        if (known := model.guided(way.name, number)) is not None:
            z = np.hstack([readings[one.name, one.look] for one in model.readings if one.look <= number])
            z = (z.reshape(count, -1, 3) @ turned).reshape(count, -1)
            rows = known.gain[:3, : z.shape[1]], known.aside[:, : z.shape[1]]
            wanted, off = (np.einsum("nab,nb->na", turned, z @ some.T) for some in rows)
            stopped |= np.linalg.norm(off, axis=1) > way.corridor_mm
            moves.append(np.where(stopped, np.nan, np.linalg.norm(wanted - moved, axis=1)))
            moved, aside = np.where(stopped[:, None], (moved, aside), (wanted, off))
    q, there = commanded(puncture, T_base_ct, moved)
    needle = true_needle(puncture.model, q + truths.arrival, truths.eta, puncture.tip_mm)
    done = ended(puncture, truths, T_base_ct, needle, reached & there)
    return GuidedTrials(done, stopped, aside, np.reshape(moves, (len(moves), count)).T)


def _drift(errors: ErrorModel, last: Floats, rng: np.random.Generator) -> Floats:
    """Drift of the joints since the touches, given drift and last arrival together, shape (n, 6), rad."""
    drift, anew = errors.arm.drift, errors.arm.arriving
    whole = np.hypot(drift, anew)
    if whole == 0.0:
        return np.zeros_like(last)
    return np.asarray(last * (drift / whole) ** 2 + rng.normal(size=last.shape) * drift * anew / whole)


@dataclass(frozen=True, eq=False)
class _Devices:
    puncture: Puncture
    truths: Truths
    model: GuidedModel
    T_base_ct: Floats
    cameras: TrialCameras | None
    probe: TrialProbe | None
    scanner: TrialScanner | None

    @classmethod
    def of(
        cls, puncture: Puncture, truths: Truths, model: GuidedModel, T_base_ct: Floats, rng: np.random.Generator
    ) -> _Devices:
        count, cameras, probe, scanner = len(truths.eta), None, None, None
        if model.stereo is not None:
            cameras = TrialCameras.placed(model.stereo, count, rng)
        if model.ultrasound is not None and model.across is not None:
            probe = TrialProbe.placed(model.ultrasound, model.across, count, rng)
        if model.scan is not None:
            scanner = TrialScanner.placed(model.scan, model.error.errors, puncture.T_base_ct, count, rng)
        return cls(puncture, truths, model, T_base_ct, cameras, probe, scanner)

    def look(self, look: Look, number: int, q: Floats, needle: TrueNeedle) -> Readings:
        """Readings of the true straight needles by the devices, less those expected of q (n, 6)."""
        puncture, truths = self.puncture, self.truths
        nominal = flange_pose(puncture.model, q)
        axis = nominal[:, :3, 2]
        tip = nominal[:, :3, 3] + puncture.tip_mm * axis
        readings = self._by_cameras(look, needle, tip, axis)
        if puncture.bend is not None:
            grown = max(look.inserted, 0.0) ** 2
            needle = bent(needle, puncture.bend._replace(tip_mm=grown * puncture.bend.tip_mm), truths.side)
        moved = truths.motion_ct + truths.breath_ct + pushed_by(puncture, truths, needle)
        target_ct = truths.target_ct + moved
        readings |= self._by_probe(needle, tip, target_ct) | self._by_scanner(needle, tip, target_ct)
        return {(name, number): value for name, value in readings.items() if name not in look.hidden}

    def _by_cameras(self, look: Look, needle: TrueNeedle, tip: Floats, axis: Floats) -> dict[str, Floats]:
        if self.cameras is None or CAMERAS in look.hidden:
            return {}
        names = [marker_name(name) for name in self.model.markers]
        shown = [name not in look.hidden for name in names]
        behind = np.array([mm for mm in self.cameras.device.balls_mm if ball_name(mm) not in look.hidden])[:, None]
        truths = self.truths
        skin_ct = self.model.skin_weight * truths.breath_ct
        markers = self.cameras.read(apply(self.puncture.T_base_ct, self.puncture.points_ct + skin_ct[:, None]))
        balls = self.cameras.read(needle.tip_base[:, None] - behind * needle.R_base_needle[:, None, :, 2])
        expected = apply_each(self.T_base_ct, truths.read_ct)
        T_base_cameras = fit_rigid(markers[:, shown], expected[:, shown])  # where the belief is linear: frame is free
        off = apply_each(T_base_cameras, balls) - (tip[:, None] - behind * axis[:, None])
        seen = {ball_name(mm): off[:, row] for row, mm in enumerate(behind[:, 0].tolist())}
        there = apply_each(T_base_cameras, markers) - expected
        return {**{name: there[:, row] for row, name in enumerate(names)}, **seen}

    def _by_probe(self, needle: TrueNeedle, tip: Floats, target_ct: Floats) -> dict[str, Floats]:
        if self.probe is None:
            return {}
        puncture = self.puncture
        target = apply(puncture.T_base_ct, target_ct)
        expected = self.T_base_ct[:, :3, :3] @ puncture.target_ct + self.T_base_ct[:, :3, 3]
        return {"target": self.probe.target(target) - expected, "tip": self.probe.tip(needle.tip_base) - tip}

    def _by_scanner(self, needle: TrueNeedle, tip: Floats, target_ct: Floats) -> dict[str, Floats]:
        if self.scanner is None:
            return {}
        R, t = self.T_base_ct[:, :3, :3], self.T_base_ct[:, :3, 3]
        there = self.scanner.tip(needle.tip_base)
        readings = {SCANNED_TIP: np.einsum("nab,nb->na", R, there) + t - tip}
        if self.model.scan is not None and self.model.scan.target_seen:
            target = self.scanner.target(target_ct)
            readings[SCANNED_TARGET] = np.einsum("nab,nb->na", R, target - self.puncture.target_ct)
        return readings
