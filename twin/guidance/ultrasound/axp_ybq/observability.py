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

from __future__ import annotations

from collections import Counter
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import exp_rotation, log_rotation, nearest_rotation, skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import (
    LENGTH_MM,
    T_Q,
    T_X,
    T_Y,
    W_X,
    W_Y,
    Estimate,
    parameter_units,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import linearised_tip, needle_in_image, tip_points
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

LEAST_RATIO = 9e-3
"""Below it the calibration is refused: constant insertion angle 1e-16, with noise 4e-4; 45 +- 1 deg 3.4e-3 to 4.4e-3,
45 +- 2 deg up to 8.8e-3; usual poses 3.6e-2 and more."""

IN_PLANE = 0.9
"""Fraction of an ill-conditioned direction that must lie in the image (or across it) to be called so."""

NAMED_WITHIN = 1.5
"""A family whose own ratio is up to this much larger than the limit still names an ill-conditioned motion."""


class IllConditionedMotion(NamedTuple):
    """One ill-conditioned motion of the unknowns."""

    cause: str
    """Short key, such as ``probe_orientation``, ``tip_position``, ``insertion_angle`` or ``needle_roll``."""
    dimensions: int
    """In how many independent ways."""
    text: str
    """What is wrong with the poses, and what can slide."""


class Observability(NamedTuple):
    """Conditioning of the unknowns by the poses."""

    ratio: float
    """Least over largest singular value."""
    dimensions: int
    """How many singular values are below the limit."""
    ill_conditioned: tuple[IllConditionedMotion, ...]
    """Named; empty where the ratio is large enough."""


def scaled_jacobian(
    estimate: Estimate, recording: Recording, active: NDArray[np.int_], centre_base2: Floats | None = None
) -> Floats:
    """The tip's Jacobian (3n, p) in units of 1 rad and 100 mm on both sides.

    Base 2 turns about a point c: w_Y leaves Y c where it is, so that t_Y gains R_Y [c]x w_Y.

    Args:
        estimate: Where the Jacobian is taken.
        centre_base2: c, shape (3,), mm; None for the middle of the recording's tips.
    """
    centre = tips_centre(estimate, recording) if centre_base2 is None else centre_base2
    J = linearised_tip(estimate, recording).jacobian
    J[:, :, W_Y] += J[:, :, T_Y] @ estimate.R_Y @ skew(centre)
    J = J[:, :, active]
    return np.asarray((J * parameter_units(active, estimate.scale) / LENGTH_MM).reshape(-1, len(active)))


def tips_centre(estimate: Estimate, recording: Recording) -> Floats:
    """The middle of all tips by the needle's arm, shape (3,), mm, base2."""
    return np.asarray(tip_points(estimate, recording)[1].mean(axis=0))


def observe(estimate: Estimate, recording: Recording, active: NDArray[np.int_]) -> Observability:
    """The conditioning of a set of poses, with its ill-conditioned motions named.

    Args:
        estimate: Where the Jacobian is taken; any solution will do, also one of many.
    """
    active = active[active < 17]
    J = scaled_jacobian(estimate, recording, active)
    values = np.linalg.svd(J, compute_uv=False)
    ratio, limit = float(values[-1] / values[0]), LEAST_RATIO * float(values[0])
    if ratio >= LEAST_RATIO:
        return Observability(ratio, 0, ())
    found = [*_orientation(estimate, recording, J, active, limit), *_tip(estimate, recording, J, active, limit)]
    found += _relative(estimate, recording, J, active, limit)
    text = "the poses do not determine one combination of the unknowns, which has no simple name: vary everything more"
    return Observability(
        ratio, int((values < limit).sum()), tuple(found) or (IllConditionedMotion("unnamed", 1, text),)
    )


class _Family(NamedTuple):
    """The ill-conditioned part of a three-dimensional family of motions."""

    ill_conditioned: int
    """How many of its three directions are ill-conditioned."""
    weakest: Floats
    """Unit vector (3,) in the family's own coordinates."""


def _ill_conditioned_part(J: Floats, active: NDArray[np.int_], motions: Floats, limit: float) -> _Family:
    """Restrict the Jacobian to the span of three motions (17, 3)."""
    if not set(np.flatnonzero(np.abs(motions).max(axis=1) > 0)) <= set(active.tolist()):
        return _Family(0, np.zeros(3))  # a parameter of this motion is known
    motions = motions[active]
    q, triangle = np.linalg.qr(motions)
    _, values, Vt = np.linalg.svd(J @ q, full_matrices=False)
    weakest = np.linalg.solve(triangle, Vt[-1])
    return _Family(int((values < NAMED_WITHIN * limit).sum()), weakest / np.linalg.norm(weakest))


def _orientation(
    estimate: Estimate, recording: Recording, J: Floats, active: NDArray[np.int_], limit: float
) -> list[IllConditionedMotion]:
    """t_X += k, t_Y += R_A k; and t_Q += k, t_Y -= R_Y R_B k."""
    probe, needle = np.zeros((2, 17, 3))
    probe[T_X], probe[T_Y] = np.eye(3), nearest_rotation(recording.A[:, :3, :3].mean(axis=0))
    needle[T_Q], needle[T_Y] = np.eye(3), -estimate.R_Y @ nearest_rotation(recording.B[:, :3, :3].mean(axis=0))
    found = []
    for arm, family, slides in (
        ("probe", probe, "the position of the image on the probe and the distance between the bases"),
        ("needle", needle, "the position of the tip on the needle and the distance between the bases"),
    ):
        ill_conditioned, _ = _ill_conditioned_part(J, active, family, limit)
        if ill_conditioned == 3:
            found.append(
                IllConditionedMotion(f"{arm}_orientation", 3, f"the {arm} hardly rotates: {slides} can shift together")
            )
        elif ill_conditioned:
            text = f"the {arm} rotates about one axis only: {slides} can shift together along it"
            found.append(IllConditionedMotion(f"{arm}_axis", ill_conditioned, text))
    return found


def _tip(
    estimate: Estimate, recording: Recording, J: Floats, active: NDArray[np.int_], limit: float
) -> list[IllConditionedMotion]:
    """w_X = k with t_X so that the mean tip stays: the image turns about the tip, or about the line of all tips."""
    family = np.zeros((17, 3))
    p = recording.points_image(estimate.scale).mean(axis=0) / LENGTH_MM
    family[W_X], family[T_X] = np.eye(3), estimate.R_X @ skew(p)
    ill_conditioned, _ = _ill_conditioned_part(J, active, family, limit)
    if ill_conditioned == 3:
        text = "the tip hardly moves in the image: the image can rotate about it on the probe"
        return [IllConditionedMotion("tip_position", 3, text)]
    if ill_conditioned:
        text = "the tip moves along one line of the image only: the image can rotate about that line on the probe"
        return [IllConditionedMotion("tip_line", ill_conditioned, text)]
    return []


def _relative(
    estimate: Estimate, recording: Recording, J: Floats, active: NDArray[np.int_], limit: float
) -> list[IllConditionedMotion]:
    """t_X += R_X a, t_Q += b with M_i b = a for every pose: a shift that does not rotate between needle and image."""
    family = np.zeros((17, 3))
    family[T_X], family[T_Q] = estimate.R_X, nearest_rotation(needle_in_image(estimate, recording).mean(axis=0)).T
    ill_conditioned, a = _ill_conditioned_part(J, active, family, limit)
    if ill_conditioned == 0:
        return []
    if ill_conditioned == 3:
        text = "needle and image hardly rotate against each other: image and tip can shift together in any direction"
        return [IllConditionedMotion("needle_in_image", 3, text)]
    if ill_conditioned == 1 and np.linalg.norm(a[:2]) >= IN_PLANE:
        text = "the insertion angle in the image hardly varies: the tip can shift along the needle"
        return [IllConditionedMotion("insertion_angle", 1, text)]
    if ill_conditioned == 1 and abs(a[2]) >= IN_PLANE:
        text = "the needle hardly rotates about its axis: image and tip can shift together across the image"
        return [IllConditionedMotion("needle_roll", 1, text)]
    text = "the needle rotates against the image about one axis only: image and tip can shift together along it"
    return [IllConditionedMotion("needle_in_image_axis", ill_conditioned, text)]


TURN_RAD = float(np.radians(25.0))
"""How far the probe is rotated, and the insertion angle changed."""
ROLL_RAD = float(np.radians(90.0))
"""How far the needle is rotated about itself."""
SHIFT_MM = 20.0
"""How far the tip is brought away in the image."""
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
    """Name of the recorded pose."""
    probe_turn_image: Floats
    """Shape (3,), rad: rotation vector of the probe about the tip, axes of the image."""
    tip_shift_mm: Floats
    """Shape (2,): where the tip goes in the image."""
    insertion_change: float
    """Rad: how much the needle's angle in the image grows."""
    needle_roll: float
    """Rad: how far the needle turns about itself."""
    A: Floats
    """T_base1_end1, shape (4, 4), mm."""
    B: Floats
    """T_base2_end2, shape (4, 4), mm, as far as the refused calibration can say: go slowly, look for the needle."""


class SuggestedPoses(NamedTuple):
    """Suggested poses, and the conditioning with them."""

    poses: tuple[PoseChange, ...]
    ratio_after: float
    """Singular value ratio with these poses added, by the present estimate."""
    text: str


class Degenerate(InputError):  # noqa: N818 - the field's word for such poses
    """Refusal: the poses cannot show every unknown.

    Attributes:
        motions: What can move without any residual showing it, in words and with its cause.
    """

    def __init__(self, observability: Observability, suggestion: SuggestedPoses) -> None:
        self.motions: tuple[IllConditionedMotion, ...] = observability.ill_conditioned
        self.ratio = observability.ratio
        self.suggestion = suggestion
        what = "; ".join(motion.text for motion in self.motions) + f" (singular value ratio {self.ratio:.1e})"
        super().__init__(what, where="recording", allowed=suggestion.text, code="poses_too_alike")


def require_observable(estimate: Estimate, recording: Recording, active: NDArray[np.int_]) -> Observability:
    """The conditioning of the poses, or a refusal with suggested ones; the arguments are those of `observe`.

    Raises:
        Degenerate: They do not; with poses that would mend it.
    """
    found = observe(estimate, recording, active)
    if found.ill_conditioned:
        raise Degenerate(found, propose(estimate, recording, active))
    return found


def propose(estimate: Estimate, recording: Recording, active: NDArray[np.int_]) -> SuggestedPoses:
    """Suggested poses that would make a recording observable.

    Args:
        estimate: A solution, unique or not.
    """
    active = active[active < 17]
    reference = _central(recording)
    suggestions = []
    for moves in (_single_moves(), _all_moves()):
        changes = [_changed(estimate, recording, reference, move) for move in moves]
        suggestions.append(_greedy(estimate, recording, active, changes))
        if suggestions[-1].ratio_after >= SLACK * LEAST_RATIO:
            break
    return max(suggestions, key=lambda suggestion: suggestion.ratio_after)


class _Move(NamedTuple):
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float] = (0.0, 0.0)
    insertion: float = 0.0
    roll: float = 0.0


def _turns() -> list[tuple[float, float, float]]:
    return [tuple(row) for row in np.concatenate([TURN_RAD * np.eye(3), -TURN_RAD * np.eye(3)]).tolist()]


def _shifts() -> list[tuple[float, float]]:
    return [(SHIFT_MM, 0.0), (-SHIFT_MM, 0.0), (0.0, SHIFT_MM), (0.0, -SHIFT_MM)]


def _single_moves() -> list[_Move]:
    """Moves that change one thing at a time."""
    moves = [_Move(turn=turn) for turn in _turns()] + [_Move(shift=shift) for shift in _shifts()]
    moves += [_Move(insertion=sign * TURN_RAD) for sign in (1, -1)]
    return moves + [_Move(roll=sign * ROLL_RAD) for sign in (1, -1)]


def _all_moves() -> list[_Move]:
    """Moves that combine every change with every other."""
    none = (0.0, 0.0, 0.0)
    angles, rolls = (0.0, TURN_RAD, -TURN_RAD), (0.0, ROLL_RAD, -ROLL_RAD)
    return [_Move(*row) for row in product([none, *_turns()], [(0.0, 0.0), *_shifts()], angles, rolls)]


def _central(recording: Recording) -> int:
    """The pose whose tip lies nearest to the middle of all, among those whose probe is rotated about as usual."""
    turns = log_rotation(recording.A[0, :3, :3].T @ recording.A[:, :3, :3])
    sides = [recording.P - np.median(recording.P, axis=0), (turns - np.median(turns, axis=0)) * 100.0]
    return int(np.argmin(np.linalg.norm(np.column_stack(sides), axis=1)))


def _changed(estimate: Estimate, recording: Recording, row: int, move: _Move) -> PoseChange:
    """The pose after the move, by the present estimate."""
    A, p = recording.A[row], recording.points_image(estimate.scale)[row]
    R_AX, M = A[:3, :3] @ estimate.R_X, needle_in_image(estimate, recording)[row]
    tip_base1 = A[:3, :3] @ (estimate.R_X @ p + estimate.t_X) + A[:3, 3]
    rotated = R_AX @ exp_rotation(np.array(move.turn))
    new_A, new_B = np.eye(4), np.eye(4)
    new_A[:3, :3] = rotated @ estimate.R_X.T
    shifted = p + np.append(move.shift, 0.0)
    new_A[:3, 3] = tip_base1 - new_A[:3, :3] @ (estimate.R_X @ p + estimate.t_X)
    new_tip = rotated @ shifted + new_A[:3, :3] @ estimate.t_X + new_A[:3, 3]
    new_M = exp_rotation(np.array([0.0, 0.0, move.insertion])) @ M @ exp_rotation(move.roll * estimate.V)
    new_B[:3, :3] = estimate.R_Y.T @ rotated @ new_M
    new_B[:3, 3] = estimate.R_Y.T @ (new_tip - estimate.t_Y) - new_B[:3, :3] @ estimate.t_Q
    return PoseChange(
        recording.names[row], np.array(move.turn), np.array(move.shift), move.insertion, move.roll, new_A, new_B
    )


def _as_recording(estimate: Estimate, recording: Recording, changes: list[PoseChange]) -> Recording:
    start = dict(zip(recording.names, recording.P, strict=True))
    P = np.array([start[change.reference] for change in changes])
    P[:, :2] += np.array([change.tip_shift_mm for change in changes]) / estimate.scale
    return Recording(np.array([c.A for c in changes]), np.array([c.B for c in changes]), P)


def _greedy(
    estimate: Estimate, recording: Recording, active: NDArray[np.int_], changes: list[PoseChange]
) -> SuggestedPoses:
    """Add the change that helps the least-known combinations most (D-optimal), until the ratio is reached."""
    J = scaled_jacobian(estimate, recording, active)
    centre = tips_centre(estimate, recording)
    offered = scaled_jacobian(estimate, _as_recording(estimate, recording, changes), active, centre)
    pieces = offered.reshape(len(changes), 3, -1)
    gains = pieces.transpose(0, 2, 1) @ pieces
    H, chosen = J.T @ J, list[int]()
    floor = 1e-9 * np.trace(H) * np.eye(len(H))
    while len(chosen) < MIN_POSES or (len(chosen) < MAX_POSES and _ratio(H) < SLACK * LEAST_RATIO):
        chosen.append(int(np.argmax(np.linalg.slogdet(H + gains + floor)[1])))
        H = H + gains[chosen[-1]]
    picked = tuple(changes[i] for i in chosen)
    return SuggestedPoses(picked, _ratio(H), _text(picked))


def _ratio(H: Floats) -> float:
    values = np.linalg.eigvalsh(H)
    return float(np.sqrt(max(values[0], 0.0) / values[-1]))


def _text(poses: tuple[PoseChange, ...]) -> str:
    counted = Counter(_one(pose) for pose in poses)
    changes = [f"{text} ({count} poses)" if count > 1 else text for text, count in counted.items()]
    return f"add {len(poses)} poses, each from pose {poses[0].reference}: " + "; ".join(changes)


def _one(pose: PoseChange) -> str:
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
