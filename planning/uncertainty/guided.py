"""The needle's error under each kind of guidance: one linear model of all devices, and the best linear estimate in it.

Everything that errs is a source, normal with deviation 1: x. Everything of which nothing is known beforehand is flat:
u, the patient's pose and the cameras' frame. Needle (shift and rotation at the tip), anatomy, target and each reading
are linear in both:

    needle_k = J_k (eta + drift + arrival_k)             eta 28 parameters of arm and tool, k a look or the end;
                                                         an arrival with the jitter of its moment
    anatomy  = pose + motion + breath + push_k           of the target and what surrounds it, since the scan; push:
                                                         by the needle at its depth there, known as the breath's mean
    target   = anatomy + reading of the target in the CT
    touch_i  = A_i pose - J_i eta - R r_i + w breath' + n       marker i: r its reading in the CT, w the skin's weight
    cameras  = A_i (pose + frame) - R r_i + w breath + n        markers, A_i = [I, -[p_i - f]x],
               [I, -[b]x] needle_k + A_b frame + n              and balls b behind the tip
    picture  = target + calibration + n                  ultrasound: the target,
               needle_k + calibration + n                and the tip
    scan     = motion + breath + reading in the CT + n   a control scan, in the CT's frame: the target,
               needle_k - A_t pose + n                   and the tip

All readings stacked are z = H x + F u. A way uses some of them. What it estimates is t = tip - target = a x + b u;
the tip is moved by -K z, with the weights K of the least error among those that no flat part enters:

    min |a - K H|^2  with  K F = b:      K = K0 + M N',   K0 F = b,   N' F = 0,   M by least squares

The breath at the touches (breath') and later have their mean in common; about it each has a deviation of its own.

The flat parts are eliminated, not given a large variance. ct is the registration as it is, K = -X L. The needle keeps
the direction that the registration gave it: in every way

    e = needle - anatomy + G z,   G = [-K; (X L)_rotation],   Sigma6 = (E + G H)(E + G H)'.

After the last look the arm arrives anew. Errors in reading an ultrasound picture last as long as its plane: looking
again does not average them. So lasts what takes another point of a control scan for the target. Cameras err anew with
each picture, and so does a tip that is read in a control scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import PARAMETERS, error_jacobian, flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.strict_json import or_null
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.case.settings import Stereo, Ultrasound
from puncture_twin.planning.case.tables import ControlScanSection
from puncture_twin.planning.registration.fits import design
from puncture_twin.planning.uncertainty.pose_error import PoseError

WAYS: Mapping[str, frozenset[str]] = {
    "ct": frozenset({"touch"}),
    "stereo": frozenset({"cameras"}),
    "us": frozenset({"target"}),
    "us+tip": frozenset({"target", "tip"}),
    "ct+stereo": frozenset({"touch", "cameras"}),
    "ct+us": frozenset({"touch", "target"}),
    "ct+us+tip": frozenset({"touch", "target", "tip"}),
    "all": frozenset({"touch", "cameras", "target", "tip"}),
}
"""Ways of guidance, by the devices whose readings each uses; ultrasound reads a target and a tip."""
SCANS = "ct+scans"

READS: Mapping[str, frozenset[str]] = {**WAYS, SCANS: frozenset({"touch", "scan"})}
"""The ways, and the one that needs a number of steps: after each, a control scan reads tip and target."""
LEVER_MM = 100.0
"""Flat rotations are counted in mm at this distance, so that the columns of F are of one size."""
RANK = 1e-9
"""Relative size below which a singular value of F is 0."""
ALIKE_MM = 1e-6
"""Two readings that differ by less say the same."""
FREE = 0.01
"""mm that the tip's estimate may follow per mm of a flat part that no reading shows: more, and it is open. Cameras do
not see a roll about the needle; where the registered target is .1 mm beside its line, that is .001."""
STOP_DRAWS = 20_000
"""Draws of the estimates after all looks together: a chance to be stopped is known to .004."""
CAMERAS = "cameras"

SCANNED_TIP, SCANNED_TARGET = "scanned tip", "scanned target"

FLAT = ("pose", "frame")
"""The patient's pose and the cameras' frame: shift and rotation at the target, of which nothing is known beforehand."""
Rows = dict[str, Floats]
"""Values that are linear in the sources: by source the columns, shape (m, k)."""


def _sum(*parts: Rows) -> Rows:
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: np.sum([part[name] for part in parts if name in part], axis=0) for name in names}


def _times(M: Floats, rows: Rows) -> Rows:
    return {name: M @ part for name, part in rows.items()}


def _root(cov: Floats) -> Floats:
    """The symmetric S with S S = cov, of covariances (..., k, k) that may be singular; no machine has another."""
    values, axes = np.linalg.eigh(cov)
    return np.asarray(axes * np.sqrt(np.maximum(values, 0.0))[..., None, :] @ np.swapaxes(axes, -1, -2))


def picture_root(sd_mm: tuple[float, float], across: Floats) -> Floats:
    """S with S S' the covariance of a point read in a picture, shape (3, 3), in the axes of the plane's normal (3,)."""
    return sd_mm[0] * np.eye(3) + (sd_mm[1] - sd_mm[0]) * np.outer(across, across)


TIP_MM, TIP_ACROSS = 0.07, 0.045
"""Deviation of a straight needle's tip that `twin/guidance/ct` reads in a control scan: in the plane, mm per axis, and
across it, mm by the square of a slice in mm; the largest of 30 virtual scans each of 1, 2, 3 and 5 mm."""


def scan_roots(scan: ControlScanSection, errors: ErrorModel) -> tuple[Floats, Floats]:
    """S with S S' the covariance of tip and target read in a control scan, shape (3, 3) each, CT axes.

    The target is read as in the CT, but across the slices no better than anything is that may lie anywhere in one.
    """
    tip = np.diag([TIP_MM, TIP_MM, max(TIP_MM, TIP_ACROSS * scan.slice_mm**2)])
    cov = errors.target_cov_ct.copy()
    cov[2, 2] = max(cov[2, 2], scan.slice_mm**2 / 12.0)
    return tip, _root(cov)


class Look(NamedTuple):
    """One look of the devices during the insertion."""

    q: Floats  # shape (6,), rad: the arm as it is planned there
    out_mm: float  # tip to target
    inserted: float  # fraction of the way: 1 at the target, 0 at the skin, below 0 before it
    hidden: Mapping[str, str] = MappingProxyType({})
    """What is out of sight, by the names of `Reading`, and why; `CAMERAS` is all of theirs."""

    def hides(self, reading: Reading) -> bool:
        """Whether a reading of this look is out of sight."""
        return reading.name in self.hidden or (reading.device == CAMERAS and CAMERAS in self.hidden)


class Follows(NamedTuple):
    """By how much of the target's motion since the scan, of its breath, and of its push, something moves."""

    motion: float
    breath: float
    push: float = 1.0


WHOLLY = Follows(1.0, 1.0)


class Reading(NamedTuple):
    """Some rows of z."""

    device: str  # touch, cameras, target, tip or scan
    name: str
    """touch, ``marker <name>``, ``ball <mm behind the tip> mm``, target, tip, ``scanned target`` or ``scanned tip``."""
    look: int  # -1 for the touches, which precede all looks
    rows: Rows


@dataclass(frozen=True, eq=False)
class GuidedModel:
    """Linear model of one insertion, of its devices' readings and their errors; base axes."""

    error: PoseError  # of the needle by its registration, the touches known or assumed
    markers: tuple[str, ...]
    points_base: Floats  # shape (N, 3), mm, by the registration
    q_insertion: Floats  # shape (6,), rad, the tip on the target
    looks: Sequence[Look]
    motion: Floats
    """Shape (3, 3), mm^2: covariance of the motion of the target and its surroundings since the scan."""
    breath: Floats
    """Shape (3, 2), mm: mean and deviation of the target's displacement by the breath; 0 without breathing."""
    skin_weight: float = 0.0  # by how much of it the markers move
    stereo: Stereo | None = None
    ultrasound: Ultrasound | None = None
    across: Floats | None = None  # shape (3,), unit: the normal of its picture
    scan: ControlScanSection | None = None
    push: Floats | None = None
    """Shape (looks + 1, 3), mm: by how much the needle pushes the target at each look, and at the end."""

    def _at(self, points_base: Floats) -> Floats:
        """A, shape (3 m, 6): how a shift and rotation at the target move points (m, 3)."""
        return design(points_base, self.error.target_base)

    def needle(self, q: Floats, arrival: str) -> Rows:
        """Deviation of the straight needle from where the nominal arm puts it, 6 rows."""
        arm, scale = self.error.errors.arm, self.error.fit.test.scale
        J = scale * error_jacobian(self.error.model, q, self.error.tip_mm)
        Jq = J[:, PARAMETERS["joint"]]
        own = J * np.sqrt(self.error.fit.noise.eta_variances)
        return {
            "arm": own,
            "drift": arm.drift * Jq,
            arrival: arm.repeatability * Jq,
            f"jitter {arrival}": arm.jitter * Jq,
        }

    def _bent(self, q: Floats, inserted: float) -> Rows:
        """Deviation that the needle's bend adds, 6 rows: the deeper, the more."""
        bend = self.error.bend
        return {} if bend is None else {"bend": max(inserted, 0.0) ** 2 * bend.sides(self.error.model, q)}

    def anatomy(self, follows: Follows = WHOLLY, look: int = -1) -> Rows:
        """Deviation of anatomy at the target from where the registration puts it at a look, or the end, 6 rows."""
        motion, breath = follows.motion * _root(self.motion), follows.breath * self.breath
        if self.push is not None:
            breath = breath + follows.push * np.outer(self.push[look], [1.0, 0.0])
        still = np.zeros((3, 3))
        return {"pose": np.eye(6), "motion": np.vstack([motion, still]), "breath": np.vstack([breath, still[:, :2]])}

    @cached_property
    def target(self) -> Rows:
        """Deviation of the true target at the end, 3 rows."""
        return self._target_at(-1)

    def _target_at(self, look: int) -> Rows:
        anatomy = _times(np.eye(6)[:3], self.anatomy(look=look))
        return _sum(anatomy, {"target": _root(self.error.target_covariance)})

    @cached_property
    def readings(self) -> tuple[Reading, ...]:
        """All readings, less what the registration expects of them: the touches, then look by look."""
        readings = [Reading("touch", "touch", -1, self._touches())]
        for number, look in enumerate(self.looks):
            needle = self.needle(look.q, f"arrival {number}")
            readings += self._seen_by_cameras(look, number, needle)
            tip = _times(np.eye(6)[:3], _sum(needle, self._bent(look.q, look.inserted)))
            readings += self._in_pictures(number, tip)
            readings += self._in_scan(look, number, tip)
        return tuple(one for one in readings if one.look < 0 or not self.looks[one.look].hides(one))

    def _touches(self) -> Rows:
        noise, scale, count = self.error.fit.noise, self.error.fit.test.scale, len(self.points_base)
        touch = np.zeros((count, 3, count, 3))
        touch[np.arange(count), :, np.arange(count)] = scale * _root(noise.cov_base)
        own = {
            "arm": -scale * noise.arm_jacobian * np.sqrt(noise.eta_variances),
            "touch": touch.reshape(3 * count, 3 * count),
            "breath at touch": np.tile(self.skin_weight * self.breath[:, 1], count)[:, None],
            "breath": np.tile(self.skin_weight * self.breath * [1.0, 0.0], (count, 1)),
        }
        return _sum(self._markers, own)

    @cached_property
    def _markers(self) -> Rows:
        """Deviation of the markers from where their readings in the CT put them, 3 N rows, at no breath."""
        R, count = self.error.fit.R_base_ct, len(self.points_base)
        read = self.error.fit.test.scale * R @ _root(self.error.fit.noise.cov_ct)
        return {"pose": self._at(self.points_base), "markers": np.asarray(-np.kron(np.eye(count), read))}

    def _seen_by_cameras(self, look: Look, number: int, needle: Rows) -> list[Reading]:
        if self.stereo is None:
            return []
        T, seen = flange_pose(self.error.model, look.q), dict[str, Rows]()
        tip, outward = T[:3, 3] + self.error.tip_mm * T[:3, 2], -T[:3, 2]
        breathing = {"breath": self.skin_weight * self.breath}
        for row, (name, point) in enumerate(zip(self.markers, self.points_base, strict=True)):
            own = {source: part[3 * row : 3 * row + 3] for source, part in self._markers.items()}
            seen[marker_name(name)] = _sum(own, breathing, {"frame": self._at(point[None])})
        for behind in self.stereo.balls_mm:
            ball = behind * outward[None]
            seen[ball_name(behind)] = _sum(_times(design(ball, np.zeros(3)), needle), {"frame": self._at(tip + ball)})
        noise = self.stereo.sd_mm * np.eye(3)
        return [
            Reading("cameras", name, number, {**rows, f"seen {name} {number}": noise}) for name, rows in seen.items()
        ]

    def _in_pictures(self, number: int, tip: Rows) -> list[Reading]:
        if self.ultrasound is None or self.across is None:
            return []
        one, readings = self.ultrasound, []
        for name, rows, sd_mm in (("target", self._target_at(number), one.target_sd_mm), ("tip", tip, one.tip_sd_mm)):
            own = {
                "calibration": one.calibration_sd_mm * np.eye(3),
                f"pictured {name}": picture_root(sd_mm, self.across),
            }
            readings.append(Reading(name, name, number, _sum(rows, own)))
        return readings

    def _in_scan(self, look: Look, number: int, tip: Rows) -> list[Reading]:
        """Couch and patient are where they were at the CT, but for the motion: what it shows is in the CT's frame."""
        if self.scan is None:
            return []
        T, R = flange_pose(self.error.model, look.q), self.error.fit.R_base_ct
        there = T[:3, 3] + self.error.tip_mm * T[:3, 2]
        tip_root, target_root = (R @ root for root in scan_roots(self.scan, self.error.errors))
        own = {"pose": -self._at(there[None]), f"{SCANNED_TIP} {number}": tip_root}
        readings = [Reading("scan", SCANNED_TIP, number, _sum(tip, own))]
        if self.scan.target_seen:
            rows = _sum(self._target_at(number), {"pose": -np.eye(6)[:3], SCANNED_TARGET: target_root})
            readings.append(Reading("scan", SCANNED_TARGET, number, rows))
        return readings

    def corrects(self, way: str) -> bool:
        """Whether a way reads anything but touches; those alone give the registration, and nothing to correct."""
        return {one.device for one in self.readings if one.device in READS[way]} != {"touch"}

    def looks_of(self, way: str) -> dict[str, int]:
        """How often a way reads each kind of device: touches, camera pairs, ultrasound pictures, and control scans."""
        taken = {
            (one.device if one.device in ("touch", CAMERAS, "scan") else "picture", one.look)
            for one in self.readings
            if one.device in READS[way]
        }  # target and tip are read in one picture
        kinds = [kind for kind, _ in taken]
        return {"touches": len(self.markers) * kinds.count("touch"), "camera_pairs": kinds.count(CAMERAS),
                "pictures": kinds.count("picture"), "scans": kinds.count("scan")}  # fmt: skip

    @cached_property
    def end(self) -> Rows:
        """The needle after the last correction, 6 rows."""
        return _sum(self.needle(self.q_insertion, "arrival"), self._bent(self.q_insertion, 1.0))

    @cached_property
    def _widths(self) -> dict[str, int]:
        every = [self.end, self.anatomy(), self.target, *(one.rows for one in self.readings)]
        return {name: part.shape[1] for rows in every for name, part in rows.items() if name not in FLAT}

    def matrices(self, rows: Rows) -> tuple[Floats, Floats]:
        """H, shape (m, n), and F, shape (m, 12), of m rows."""
        count = len(next(iter(rows.values())))
        H = [rows.get(name, np.zeros((count, width))) for name, width in self._widths.items()]
        F = [rows.get(name, np.zeros((count, 6))) * np.repeat([1.0, 1.0 / LEVER_MM], 3) for name in FLAT]
        return np.hstack(H), np.hstack(F)

    @cached_property
    def _stacked(self) -> tuple[Floats, Floats, list[tuple[Reading, int]]]:
        """H and F of all readings, and the reading of each row."""
        parts = [self.matrices(one.rows) for one in self.readings]
        rows = [(one, row) for one, (H, _) in zip(self.readings, parts, strict=True) for row in range(len(H))]
        return np.vstack([H for H, _ in parts]), np.vstack([F for _, F in parts]), rows

    def guided(self, way: str, last: int | None = None) -> Guided | None:
        """The estimate of a way after a look, by default the last; None where its readings do not determine the tip."""
        H, F, rows = self._stacked
        a, b = self.matrices(_sum(_times(np.eye(6)[:3], self.end), _times(-np.eye(3), self.target)))
        last = len(self.looks) - 1 if last is None else last
        used = np.flatnonzero([one.device in READS[way] and one.look <= last for one, _ in rows])
        gain = np.zeros((6, len(rows)))
        gain[:, [one.device == "touch" for one, _ in rows]] = self.error.fit.map_at(self.error.target_base)
        if self.corrects(way):
            K = _weights(H[used], F[used], a, b)
            if K is None:
                return None
            gain[:3] = 0.0
            gain[:3, used] = -K
        tip = a + gain[:3] @ H
        return Guided(gain, *self.left(gain), tip @ tip.T, self._parts(tip), gain[:3] + self._aside(way, last))

    def _aside(self, way: str, last: int) -> Floats:
        """The weights, shape (3, m), that estimate the needle's shift from its plan in the body at rest, uncorrected.

        By the touches, whichever way it is, and by what the way reads up to a look.
        """
        H, F, rows = self._stacked
        resting = _times(-np.eye(3), {"pose": np.eye(6)[:3]})
        a, b = self.matrices(_sum(_times(np.eye(6)[:3], self.end), resting))
        used = [one.look < 0 or (one.device in READS[way] and one.look <= last) for one, _ in rows]
        weights = np.zeros((3, len(rows)))
        K = _weights(H[used], F[used], a, b)
        assert K is not None  # touches determine a pose
        weights[:, used] = K
        return weights

    def left(self, gain: Floats, follows: Follows = WHOLLY) -> tuple[Floats, Floats]:
        """`Guided.cov` and `Guided.breath` of the needle against anatomy that follows the target so, under a gain."""
        E, _ = self.matrices(_sum(self.end, _times(-np.eye(6), self.anatomy(follows))))
        rows = E + gain @ self._stacked[0]
        return rows @ rows.T, self._breath_of(rows)

    def _breath_of(self, rows: Floats) -> Floats:
        """Of values linear in the sources, shape (m, n), what the breath's mean and one deviation give: (m, 2)."""
        names = list(self._widths)
        at = sum(self._widths[name] for name in names[: names.index("breath")])
        return rows[:, at : at + 2]

    def stop_chance(self, way: str, corridor_mm: float) -> float:
        """The chance that, after any of its looks, a way estimates its needle farther from the plan than a corridor.

        No flat part enters those estimates. What corrects nothing, as ct, is never stopped.
        """
        if not self.corrects(way):
            return 0.0
        looked = [estimate for last in range(len(self.looks)) if (estimate := self.guided(way, last)) is not None]
        aside = np.concatenate([one.aside @ self._stacked[0] for one in looked])
        mean = self._breath_of(aside)[:, 0]
        root = _root(aside @ aside.T - np.outer(mean, mean))
        drawn = mean + np.random.default_rng(0).normal(size=(STOP_DRAWS, len(mean))) @ root.T
        far = np.linalg.norm(drawn.reshape(STOP_DRAWS, -1, 3), axis=2).max(axis=1)
        return float(np.mean(far > corridor_mm))

    def _parts(self, tip: Floats) -> dict[str, float]:
        """Mean square of the tip's error by source, mm^2, named as in `SOURCES`."""
        squares, parts = np.sum(tip**2, axis=0), dict[str, float]()
        start = 0
        for name, width in self._widths.items():
            cut = {name: squares[start : start + width]}
            if name == "arm":
                cut = {kind: squares[start : start + width][part] for kind, part in PARAMETERS.items()}
            for one, own in cut.items():
                source = _SOURCE_OF.get(one.split(" ")[0], one)
                parts[source] = parts.get(source, 0.0) + float(own.sum())
            start += width
        return {source: part for source, part in parts.items() if part > 0.0}


_SOURCE_OF = {
    "arrival": "repeatability",
    "jitter": "jitter",
    "markers": "markers_ct",
    "breath": "motion",
    "seen": "cameras",
    "pictured": "pictures",
    "calibration": "pictures",
    "scanned": "scans",
}
"""Sources by the first word of a row's: those of all looks together."""


def device_of(name: str) -> str:
    """The device that gives a look's reading of a name."""
    if name in (SCANNED_TIP, SCANNED_TARGET):
        return "scan"
    return name if name in ("target", "tip") else CAMERAS


def ball_name(behind_mm: float) -> str:
    """Name of a ball's reading."""
    return f"ball {behind_mm:g} mm"


def marker_name(name: str) -> str:
    """Name of a marker's reading by the cameras."""
    return f"marker {name}"


def _weights(H: Floats, F: Floats, a: Floats, b: Floats) -> Floats | None:
    """K, shape (3, m), of the least error without a flat part; None where there is none."""
    if not len(H):
        return None
    U, sizes, Vt = np.linalg.svd(F)
    rank = int(np.sum(sizes > RANK * sizes[0]))
    anyhow = (b @ Vt[:rank].T / sizes[:rank]) @ U[:, :rank].T
    if np.abs(anyhow @ F - b).max() > FREE:
        return None
    N = U[:, rank:]
    free, left = (N.T @ H).T, (a - anyhow @ H).T
    eye = ALIKE_MM * np.eye(N.shape[1])  # rows of readings that say the same twice are zero
    M = np.linalg.lstsq(np.vstack([free, eye]), np.vstack([left, np.zeros((len(eye), 3))]))[0].T
    return np.asarray(anyhow + M @ N.T)


class Guided(NamedTuple):
    """The estimate of one way, and the errors that it leaves; base axes."""

    gain: Floats
    """G, shape (6, m): how the command follows all readings; 0 for those that the way does not use."""
    cov: Floats
    """Sigma6, shape (6, 6), of the needle against the CT's anatomy about the target, what is known of it included."""
    breath: Floats
    """Shape (6, 2): what the breath's mean and one deviation add to it; no correction of the way takes them out."""
    tip_cov: Floats  # shape (3, 3), mm^2, of the tip about the true target
    parts: Mapping[str, float]  # mean square of the tip by source, mm^2
    aside: Floats
    """Shape (3, m): estimates from all readings how far the corrected needle is from its plan in the body at rest."""


class WayChance(NamedTuple):
    """Expected error and chances of one insertion under one kind of guidance."""

    way: str
    expected_error_mm: float
    """Rms of the tip about the target; NaN where the way does not see enough."""
    p_hit: float  # that it is not stopped, and hits
    p_stop: float
    """That a correction would lead out of the corridor: it is not executed, and the needle is stopped."""
    lost_sight: str  # what is not seen, and why; empty where all is

    def document(self) -> dict[str, Any]:
        """Plain values for JSON; null where there is no number."""
        numbers = {name: or_null(getattr(self, name)) for name in ("expected_error_mm", "p_hit", "p_stop")}
        return {"way": self.way, **numbers, "lost_sight": self.lost_sight}


@dataclass(frozen=True, eq=False)
class GuidedError(PoseError):
    """The pose error of one direction's needle under one way of guidance, for whatever asks a `PoseError`."""

    guided: Guided | None = None
    """What the way leaves; ``cov`` is of the anatomy that is asked about."""

    @property
    def known(self) -> Guided:
        """The estimate of an error that is not blank."""
        assert self.guided is not None
        return self.guided

    def covariance(self, q: Floats) -> Floats:
        """Sigma6 after the last correction, the same for each of the configurations (n, 6)."""
        return np.broadcast_to(self.known.cov, (len(q), 6, 6))

    @property
    def target_covariance_ct(self) -> Floats:
        """What the true target adds, CT axes: less than nothing where a picture of it led the needle."""
        R = self.fit.R_base_ct
        return np.asarray(R.T @ (self.known.tip_cov - self.known.cov[:3, :3]) @ R)

    def about_breath(self, deviations: float | None = None) -> tuple[GuidedError, Floats]:
        """The error about what is known of the breath, and where the tip ends by that: shape (3,), mm, CT axes.

        The breath is so many deviations off its mean; None where its mean alone is known, which is no chance.
        """
        one = self.known
        known = one.breath[:, :1] if deviations is None else one.breath
        cov, shift = known @ known.T, known[:3] @ np.array([1.0, deviations or 0.0])[: known.shape[1]]
        about_mean = one._replace(cov=one.cov - cov, tip_cov=one.tip_cov - cov[:3, :3], breath=np.zeros((6, 2)))
        return replace(self, guided=about_mean), self.fit.R_base_ct.T @ shift

    def mean_squares(self, q: Floats) -> dict[str, float]:
        """Mean square of the tip by source, devices and motion included; mm^2."""
        return dict(self.known.parts)
