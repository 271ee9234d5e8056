"""The ground truth of needles and touches: the place of each, for many erring arms at once, and the tissue's force."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import FREE_D, N_PARAMETERS, PARAMETERS, dh_step, error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.geometry.rigid import apply, exp_rotation
from puncture_twin.planning.registration.marker_noise import parameter_variances
from puncture_twin.planning.search.bending import Insertion
from puncture_twin.planning.touch.tour_motions import Touch
from puncture_twin.twin.world.client import to_m, to_mm
from puncture_twin.twin.world.control import Push, Tip

NEWTON_STEPS = 4
"""Newton steps of a tip moved onto a point: errors of an arm are millimetres, and each step squares what is left of
them."""


class TrueNeedle(NamedTuple):
    """A needle: its tip, shape (..., 3), mm, and its axes as columns, shape (..., 3, 3); z points to the tip."""

    tip_base: Floats
    R_base_needle: Floats


def true_needle(model: UrModel, q_true: Floats, eta: Floats, tip_mm: float) -> TrueNeedle:
    """The needle of arms whose parameters err by (..., 28), mm and rad, columns as of `error_jacobian`."""
    eta = np.broadcast_to(eta, (*q_true.shape[:-1], N_PARAMETERS))
    a = np.array(model.a) + eta[..., 0:6]
    d = np.broadcast_to(np.array(model.d), a.shape).copy()
    d[..., list(FREE_D)] += eta[..., 6:11]
    alpha = np.array(model.alpha) + eta[..., PARAMETERS["twist"]]
    q = q_true + eta[..., PARAMETERS["joint"]]
    T = np.eye(4)
    for joint in range(6):
        T = T @ dh_step(q[..., joint], d[..., joint], a[..., joint], alpha[..., joint])
    R = T[..., :3, :3]
    offset = eta[..., PARAMETERS["tip_offset"]] + np.array([0.0, 0.0, tip_mm])
    lean = np.concatenate([eta[..., PARAMETERS["needle_direction"]], np.zeros((*eta.shape[:-1], 1))], axis=-1)
    return TrueNeedle(T[..., :3, 3] + (R @ offset[..., None])[..., 0], R @ exp_rotation(lean))


def joints_at_points(model: UrModel, points_base: Floats, q_start: Floats, eta: Floats, tip_mm: float) -> Floats:
    """True joints (..., 6), rad, nearest to a start, that put each true tip on its point (..., 3), mm."""
    q = np.array(np.broadcast_to(q_start, (*points_base.shape[:-1], 6)))
    Jq = error_jacobian(model, q_start, tip_mm)[..., :3, PARAMETERS["joint"]]  # Newton's with the nominal arm's slope
    back = np.linalg.pinv(Jq)  # of the 6 joints the smallest change
    for _ in range(NEWTON_STEPS):
        missing = points_base - true_needle(model, q, eta, tip_mm).tip_base
        q += (back @ missing[..., None])[..., 0]
    return q


SHIFT_MM = 0.1
"""mm by which friction gives way elastically before it slides: the samples of the force are as far apart."""


class TrueTissue:
    """Tissue that presses on a needle: keeps how deep the tip has been, and where friction holds it.

    Along the shaft: capsules, cutting and friction over depth (`planning.needle.insertion_force`). Friction and
    cutting work against the motion; at rest friction resists the pull: Dahl's solid friction, elastic up to a shift
    (Dahl 1968, "A solid friction model"). Across it: the beam in its foundation (`planning.needle.deflection`) loads
    its holder with a force and a moment; on the rigid needle both act as two forces, at the tip and where the shaft is
    clamped. The bevel points to `side` about the needle's z, rad.
    """

    def __init__(
        self, insertion: Insertion, entry_base: Floats, into_base: Floats, side: float, shaft_mm: float
    ) -> None:
        self._force, self._bent, self._entry_base, self._into = insertion.force, insertion.path, entry_base, into_base
        self._side, self._shaft_mm = np.array([np.cos(side), np.sin(side), 0.0]), shaft_mm
        self._deepest, self._held = 0.0, 0.0
        self.greatest = TissueForce(0.0, 0.0)  # so far

    def __call__(self, tip: Tip) -> tuple[Push, ...]:
        """Forces of the tissue on the needle now."""
        R, at_m = tip.R_base_tip[0], tip.position_m[0]
        depth = float((to_mm(at_m) - self._entry_base) @ self._into)
        along, (at_tip, at_holder) = self._along(depth), self._across(depth)
        across = abs(at_tip + at_holder)
        self.greatest = TissueForce(max(self.greatest.along_n, along), max(self.greatest.across_n, across))
        holder_m, side = at_m - to_m(self._shaft_mm) * R[:, 2], R @ self._side
        return Push(at_tip * side - along * self._into, at_m), Push(at_holder * side, holder_m)

    def _along(self, depth: float) -> float:
        if depth <= 0.0:
            self._held = 0.0
            return 0.0
        self._deepest = max(self._deepest, depth)
        stretch = float(np.clip(depth - self._held, -SHIFT_MM, SHIFT_MM))
        self._held = depth - stretch
        force = self._force
        terms = force.capsule_n, force.cutting_n, force.friction_n
        capsule, cutting, friction = (float(np.interp(self._deepest, force.depth_mm, term)) for term in terms)
        return capsule + friction * stretch / SHIFT_MM + cutting * max(stretch, 0.0) / SHIFT_MM

    def _across(self, depth: float) -> tuple[float, float]:
        """Forces to the bevel's side at tip and holder, N: together the force and the moment of the beam."""
        inside, bent = max(depth, 0.0), self._bent
        force, moment = (float(np.interp(inside, bent.depth_mm, term)) for term in (bent.holder_n, bent.holder_n_mm))
        at_tip = moment / self._shaft_mm
        return at_tip, force - at_tip


class TissueForce(NamedTuple):
    """The greatest forces of one insertion, N: along the needle, and across it as its holder bears them."""

    along_n: float
    across_n: float

    @property
    def text(self) -> str:
        """The forces in words."""
        if self.along_n == self.across_n == 0.0:
            return "no force of tissue: the needle reached none"
        return f"tissue force up to {self.along_n:.2f} N along the needle, {self.across_n:.2f} N across it"


NO_TISSUE_FORCE = "no force of tissue: the case declares no [tissue]"
"""Text for an insertion without declared tissue."""


@dataclass(frozen=True, eq=False)
class TouchTruth:
    """Ground truth of touches, one draw of the declared errors."""

    seed: int
    T_base_ct: Floats  # shape (4, 4), mm: true pose of the patient
    eta: Floats  # shape (28,), of the arm's parameters, mm and rad
    aim_ct: dict[str, Floats]  # marker to shape (3,), mm: where the tip comes to on it, its touch noise included
    arrival: dict[str, Floats]  # marker to shape (6,), rad: true joints minus what the encoders say there

    def q_contact(self, model: UrModel, tip_mm: float, touch: Touch) -> Floats:
        """Encoder angles, shape (6,), rad, when the true tip is on the marker, the needle as planned."""
        there = apply(self.T_base_ct, self.aim_ct[touch.name])
        q_true = joints_at_points(model, there[None], touch.q_touch[None], self.eta[None], tip_mm)[0]
        return np.asarray(q_true - self.arrival[touch.name])


def draw_touch_truth(
    T_base_ct: Floats, names: tuple[str, ...], points_ct: Floats, errors: ErrorModel, seed: int
) -> TouchTruth:
    """Draw the ground truth of touches of N markers (N, 3), mm, as read, of a patient at T_base_ct (4, 4), mm."""
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
    """Draw the errors of an arm that sets its tip onto one place (3,), mm, n times; patient at T_base_ct (4, 4)."""
    rng = np.random.default_rng(seed)
    eta = rng.normal(size=28) * np.sqrt(parameter_variances(errors.arm))
    aim_base = place_base + rng.normal(0.0, errors.touch_mm, (len(names), 3))
    aim = apply(np.linalg.inv(T_base_ct), aim_base)
    arrival = rng.normal(size=(len(names), 6)) * errors.arm.repeatability
    return TouchTruth(seed, T_base_ct, eta, dict(zip(names, aim, strict=True)), dict(zip(names, arrival, strict=True)))


class AtTarget(NamedTuple):
    """Truth at the needle's arrival: joints minus encoders, (6,), rad; and the target, (3,), mm."""

    arrival: Floats
    target_ct: Floats


def draw_at_target(target_ct: Floats, errors: ErrorModel, seed: int) -> AtTarget:
    """Draw the arrival: joints drifted since the touches with an error of their own; the target, read at (3,), mm."""
    rng = np.random.default_rng([seed, 2])
    arrival = rng.normal(size=6) * np.hypot(errors.arm.arriving, errors.arm.drift)
    values, axes = np.linalg.eigh(errors.target_cov_ct)
    return AtTarget(arrival, target_ct + axes @ (rng.normal(size=3) * np.sqrt(np.maximum(values, 0.0))))
