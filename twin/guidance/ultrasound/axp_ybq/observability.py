"""Observability: motions of the unknowns that a set of poses hardly shows (spec 3, section 3), and poses to add.

Columns are counted in rad and 100 mm, and base 2 rotates about the middle of all tips rather than about its own origin:
wherever that origin lies, the same poses show the same. A recording is refused where the least singular value of the
Jacobian over the largest falls below ``LEAST_RATIO``. The ill-conditioned motion is then named: each of four families
of motions has a known cause, and a family (or a line or plane of it) is ill-conditioned when the Jacobian, restricted
to it, is.

`propose` suggests further poses: simple changes of one recorded pose are tried by computation (the probe rotated about
an axis of the image through the tip, the tip brought elsewhere in the image, the insertion angle changed, the needle
rotated about itself). Those that add most information where there is least are proposed, until the recording would be
accepted with a margin.
"""

from collections import Counter
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import exp_rotation, log_rotation, nearest_rotation, pose, skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import (
    LENGTH_MM,
    T_Q,
    T_X,
    T_Y,
    W_X,
    W_Y,
    Estimate,
    linearised_tip,
    needle_in_image,
    parameter_units,
    tip_points,
    tips_image,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

LEAST_RATIO = 9e-3
"""Below it the calibration is refused: constant insertion angle 1e-16, with noise 4e-4; 45 +- 1 deg 3.4e-3 to 4.4e-3,
45 +- 2 deg up to 8.8e-3; usual poses 3.6e-2 and more."""
IN_PLANE = 0.9
"""Fraction of an ill-conditioned direction that must lie in the image (or across it) to be called so."""
NAMED_WITHIN = 1.5
"""A family whose own ratio is up to this much larger than the limit still names an ill-conditioned motion."""


class IllConditionedMotion(NamedTuple):
    """One ill-conditioned motion of the unknowns: its short key, in how many independent ways, and in words."""

    cause: str
    dimensions: int
    text: str


class Observability(NamedTuple):
    """Conditioning of the unknowns: least over largest singular value, how many are below the limit, and why."""

    ratio: float
    dimensions: int
    ill_conditioned: tuple[IllConditionedMotion, ...]


def scaled_jacobian(
    estimate: Estimate, recording: Recording, active: Ints, centre_base2: Floats | None = None
) -> Floats:
    """The tip's Jacobian (3n, p) in units of 1 rad and 100 mm on both sides.

    Base 2 turns about a point c (3,), mm, the middle of the recording's tips: w_Y leaves Y c where it is, so that t_Y
    gains R_Y [c]x w_Y.
    """
    centre = tips_centre(estimate, recording) if centre_base2 is None else centre_base2
    J = linearised_tip(estimate, recording).jacobian
    J[:, :, W_Y] += J[:, :, T_Y] @ estimate.R_Y @ skew(centre)
    J = J[:, :, active]
    return np.asarray((J * parameter_units(active, estimate.scale) / LENGTH_MM).reshape(-1, len(active)))


def tips_centre(estimate: Estimate, recording: Recording) -> Floats:
    """The middle of all tips by the needle's arm, shape (3,), mm, base2."""
    return np.asarray(tip_points(estimate, recording)[1].mean(axis=0))


def observe(estimate: Estimate, recording: Recording, active: Ints) -> Observability:
    """The conditioning of a set of poses at any solution, also one of many, with its ill-conditioned motions named."""
    active = active[active < 17]
    J = scaled_jacobian(estimate, recording, active)
    values = np.linalg.svd(J, compute_uv=False)
    ratio, limit = float(values[-1] / values[0]), LEAST_RATIO * float(values[0])
    if ratio >= LEAST_RATIO:
        return Observability(ratio, 0, ())
    text = "the poses do not determine one combination of the unknowns, which has no simple name: vary everything more"
    unnamed = (IllConditionedMotion("unnamed", 1, text),)
    named = tuple(_named(estimate, recording, J, active, limit))
    return Observability(ratio, int((values < limit).sum()), named or unnamed)


def _named(
    estimate: Estimate, recording: Recording, J: Floats, active: Ints, limit: float
) -> Iterator[IllConditionedMotion]:
    probe, needle, tip, relative = np.zeros((4, 17, 3))
    probe[T_X], probe[T_Y] = np.eye(3), nearest_rotation(recording.A[:, :3, :3].mean(axis=0))  # t_X += k, t_Y += R_A k
    needle[T_Q], needle[T_Y] = np.eye(3), -estimate.R_Y @ nearest_rotation(recording.B[:, :3, :3].mean(axis=0))
    for arm, family, what in (("probe", probe, "image on the probe"), ("needle", needle, "tip on the needle")):
        count, _ = _ill_conditioned_part(J, active, family, limit)
        slides = f"the position of the {what} and the distance between the bases can shift together"
        if count == 3:
            yield IllConditionedMotion(f"{arm}_orientation", 3, f"the {arm} hardly rotates: {slides}")
        elif count:
            text = f"the {arm} rotates about one axis only: {slides} along it"
            yield IllConditionedMotion(f"{arm}_axis", count, text)
    # w_X = k with t_X so that the mean tip stays: the image turns about the tip, or about the line of all tips
    mean_tip = tips_image(recording, estimate.scale).mean(axis=0) / LENGTH_MM
    tip[W_X], tip[T_X] = np.eye(3), estimate.R_X @ skew(mean_tip)
    count, _ = _ill_conditioned_part(J, active, tip, limit)
    if count == 3:
        text = "the tip hardly moves in the image: the image can rotate about it on the probe"
        yield IllConditionedMotion("tip_position", 3, text)
    elif count:
        text = "the tip moves along one line of the image only: the image can rotate about that line on the probe"
        yield IllConditionedMotion("tip_line", count, text)
    # t_X += R_X a, t_Q += b with M_i b = a for every pose: a shift that does not rotate between needle and image
    relative[T_X], relative[T_Q] = estimate.R_X, nearest_rotation(needle_in_image(estimate, recording).mean(axis=0)).T
    count, a = _ill_conditioned_part(J, active, relative, limit)
    if count == 3:
        text = "needle and image hardly rotate against each other: image and tip can shift together in any direction"
        yield IllConditionedMotion("needle_in_image", 3, text)
    elif count == 1 and np.linalg.norm(a[:2]) >= IN_PLANE:
        text = "the insertion angle in the image hardly varies: the tip can shift along the needle"
        yield IllConditionedMotion("insertion_angle", 1, text)
    elif count == 1 and abs(a[2]) >= IN_PLANE:
        text = "the needle hardly rotates about its axis: image and tip can shift together across the image"
        yield IllConditionedMotion("needle_roll", 1, text)
    elif count:
        text = "the needle rotates against the image about one axis only: image and tip can shift together along it"
        yield IllConditionedMotion("needle_in_image_axis", count, text)


def _ill_conditioned_part(J: Floats, active: Ints, motions: Floats, limit: float) -> tuple[int, Floats]:
    """Number of ill-conditioned motions of three (17, 3), and the weakest of their span, a unit vector (3,)."""
    q, triangle = np.linalg.qr(motions[active])
    _, values, Vt = np.linalg.svd(J @ q, full_matrices=False)
    weakest = np.linalg.solve(triangle, Vt[-1])
    return int((values < NAMED_WITHIN * limit).sum()), weakest / np.linalg.norm(weakest)


TURN_RAD = float(np.radians(25.0))
"""How far the probe is rotated, and the insertion angle changed."""
ROLL_RAD = float(np.radians(90.0))
"""How far the needle is rotated about itself."""
SHIFT_MM = 20.0
"""How far the tip is brought away in the image."""
NONE = (0.0, 0.0, 0.0)
TURNS = (NONE, *map(tuple, np.concatenate([TURN_RAD * np.eye(3), -TURN_RAD * np.eye(3)]).tolist()))
SHIFTS = ((0.0, 0.0), (SHIFT_MM, 0.0), (-SHIFT_MM, 0.0), (0.0, SHIFT_MM), (0.0, -SHIFT_MM))
ANGLES, ROLLS = (0.0, TURN_RAD, -TURN_RAD), (0.0, ROLL_RAD, -ROLL_RAD)
SLACK = 1.5
"""The proposal reaches this many times the limit."""
IMAGE_AXES = ("image's u axis", "image's v axis", "normal of the image")
"""As a person calls them."""
MIN_POSES = 4
"""Fewer would rest on single measurements."""
MAX_POSES = 12
"""No longer list is proposed: whoever needs more should record anew."""


class PoseChange(NamedTuple):
    """One proposed pose, as a change of a recorded one."""

    reference: str
    probe_turn_image: Floats  # shape (3,), rad: rotation vector of the probe about the tip, axes of the image
    tip_shift_mm: Floats  # shape (2,): where the tip goes in the image
    insertion_change: float  # rad, of the needle's angle in the image
    needle_roll: float  # rad, about itself
    A: Floats  # T_base1_end1, shape (4, 4), mm, as far as the refused calibration can say
    B: Floats  # T_base2_end2, likewise: go slowly, look for the needle


class SuggestedPoses(NamedTuple):
    """Suggested poses, the singular value ratio with them added, by the present estimate, and both in words."""

    poses: tuple[PoseChange, ...]
    ratio_after: float
    text: str


class Degenerate(InputError):  # noqa: N818 - the field's word for such poses
    """Refusal: the poses cannot show every unknown; its motions say what can move without any residual showing it."""

    def __init__(self, observability: Observability, suggestion: SuggestedPoses) -> None:
        self.motions: tuple[IllConditionedMotion, ...] = observability.ill_conditioned
        self.ratio = observability.ratio
        self.suggestion = suggestion
        what = "; ".join(motion.text for motion in self.motions) + f" (singular value ratio {self.ratio:.1e})"
        super().__init__(what, where="recording", allowed=suggestion.text, code="poses_too_alike")


def require_observable(estimate: Estimate, recording: Recording, active: Ints) -> Observability:
    """The conditioning of the poses, or a refusal with poses that would mend it; the arguments are those of `observe`.

    Raises:
        Degenerate: They do not.
    """
    observability = observe(estimate, recording, active)
    if observability.ill_conditioned:
        raise Degenerate(observability, propose(estimate, recording, active))
    return observability


def propose(estimate: Estimate, recording: Recording, active: Ints) -> SuggestedPoses:
    """Suggested poses that would make a recording observable, by a solution, unique or not."""
    active = active[active < 17]
    # the pose whose tip lies nearest to the middle of all, among those whose probe is rotated about as usual
    turns = log_rotation(recording.A[0, :3, :3].T @ recording.A[:, :3, :3])
    sides = [recording.P - np.median(recording.P, axis=0), (turns - np.median(turns, axis=0)) * 100.0]
    reference = int(np.argmin(np.linalg.norm(np.column_stack(sides), axis=1)))
    every = [_Move(*row) for row in product(TURNS, SHIFTS, ANGLES, ROLLS)]
    single = [_Move(turn=turn) for turn in TURNS[1:]] + [_Move(shift=shift) for shift in SHIFTS[1:]]
    single += [_Move(insertion=angle) for angle in ANGLES[1:]] + [_Move(roll=roll) for roll in ROLLS[1:]]
    suggestions = []
    for moves in (single, every):
        changes = [_changed(estimate, recording, reference, move) for move in moves]
        suggestions.append(_greedy(estimate, recording, active, changes))
        if suggestions[-1].ratio_after >= SLACK * LEAST_RATIO:
            break
    return max(suggestions, key=lambda suggestion: suggestion.ratio_after)


class _Move(NamedTuple):
    turn: tuple[float, ...] = NONE
    shift: tuple[float, float] = (0.0, 0.0)
    insertion: float = 0.0
    roll: float = 0.0


def _changed(estimate: Estimate, recording: Recording, row: int, move: _Move) -> PoseChange:
    A, p = recording.A[row], tips_image(recording, estimate.scale)[row]
    M, tip_end1 = needle_in_image(estimate, recording)[row], estimate.R_X @ p + estimate.t_X
    rotated = A[:3, :3] @ estimate.R_X @ exp_rotation(np.array(move.turn))  # about the tip
    R_A = rotated @ estimate.R_X.T
    new_A = pose(R_A, A[:3, :3] @ tip_end1 + A[:3, 3] - R_A @ tip_end1)
    new_tip = rotated @ (p + np.append(move.shift, 0.0)) + new_A[:3, :3] @ estimate.t_X + new_A[:3, 3]
    new_M = exp_rotation(np.array([0.0, 0.0, move.insertion])) @ M @ exp_rotation(move.roll * estimate.V)
    R_B = estimate.R_Y.T @ rotated @ new_M
    new_B = pose(R_B, estimate.R_Y.T @ (new_tip - estimate.t_Y) - R_B @ estimate.t_Q)
    turn, shift = np.array(move.turn), np.array(move.shift)
    return PoseChange(recording.names[row], turn, shift, move.insertion, move.roll, new_A, new_B)


def _greedy(estimate: Estimate, recording: Recording, active: Ints, changes: list[PoseChange]) -> SuggestedPoses:
    """Add the change that helps the least-known combinations most (D-optimal), until the ratio is reached."""
    start = dict(zip(recording.names, recording.P, strict=True))
    P = np.array([start[change.reference] for change in changes])
    P[:, :2] += np.array([change.tip_shift_mm for change in changes]) / estimate.scale
    offered = Recording(np.array([c.A for c in changes]), np.array([c.B for c in changes]), P)
    J, centre = scaled_jacobian(estimate, recording, active), tips_centre(estimate, recording)
    pieces = scaled_jacobian(estimate, offered, active, centre).reshape(len(changes), 3, -1)
    gains = pieces.transpose(0, 2, 1) @ pieces
    H, chosen = J.T @ J, list[int]()
    floor = 1e-9 * np.trace(H) * np.eye(len(H))
    while len(chosen) < MIN_POSES or (len(chosen) < MAX_POSES and _ratio(H) < SLACK * LEAST_RATIO):
        chosen.append(int(np.argmax(np.linalg.slogdet(H + gains + floor)[1])))
        H = H + gains[chosen[-1]]
    picked = tuple(changes[i] for i in chosen)
    counted = Counter(_in_words(pose) for pose in picked)
    changes_text = [f"{text} ({count} poses)" if count > 1 else text for text, count in counted.items()]
    text = f"add {len(picked)} poses, each from pose {picked[0].reference}: " + "; ".join(changes_text)
    return SuggestedPoses(picked, _ratio(H), text)


def _ratio(H: Floats) -> float:
    values = np.linalg.eigvalsh(H)
    return float(np.sqrt(max(values[0], 0.0) / values[-1]))


def _in_words(pose: PoseChange) -> str:
    changes = []
    for axis, angle in zip(IMAGE_AXES, pose.probe_turn_image, strict=True):
        if angle:
            changes.append(f"rotate the probe by {np.degrees(angle):+.0f} deg about the {axis} through the tip")
    if pose.tip_shift_mm.any():
        u, v = pose.tip_shift_mm
        changes.append(f"bring the tip to another point of the image, u {u:+.0f} mm, v {v:+.0f} mm")
    if pose.insertion_change:
        changes.append(f"change the insertion angle in the image by {np.degrees(pose.insertion_change):+.0f} deg")
    if pose.needle_roll:
        changes.append(f"rotate the needle about its axis by {np.degrees(pose.needle_roll):+.0f} deg")
    return " and ".join(changes)
