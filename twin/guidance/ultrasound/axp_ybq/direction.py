"""The needle's direction V in its flange frame, and the residuals of tip and direction with their Jacobians.

`needle_direction` takes V from the directions seen in the image, or from the image plane alone.

F = R_Y (R_B t_Q + t_B) + t_Y - R_A (R_X S p + t_X) - t_A (mm, base1), S = diag(scale).
With R <- R exp([w]x) its derivatives by w_X, t_X, w_Y, t_Y, t_Q, scale are
R_A R_X [S p]x, -R_A, -R_Y [R_B t_Q + t_B]x, I, R_Y R_B, -R_A R_X[:, :2] diag(u, v).
(Spec 3, section 2. The patent prints the first and third without their signs; its G is -J.)

m = M V with the rotation M = (R_A R_X)^T R_Y R_B from end2 to image. Two residuals: how far m points away from the
measured v inside the image, and across it: e1.m and e2.m, e1 = z x v made unit and e2 = v x e1.
dm = [m]x w_X - (R_A R_X)^T R_Y [R_B V]x w_Y + M dV.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.geometry.rigid import skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import (
    DIRECTION,
    N_PARAMETERS,
    SCALE,
    T_Q,
    T_X,
    T_Y,
    W_X,
    W_Y,
    Estimate,
    tangent_basis,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

HALF_NORMAL = 0.6745
"""Median of |x| for a standard normal x."""
FAR = 5.0
"""A direction this many standard deviations from the median one does not agree with it."""
LEAST_ANGLE = 1e-6
"""Rad: closer than this all directions agree; it is rounding."""
LEAST_SPREAD = 1e-9
"""Rad: no spread is taken to be less."""

SCATTERED_RAD = float(np.radians(15.0))
"""Directions whose median is farther from a common axis show none: 5 mm of a shaft read to .5 mm leave 8 deg; turned by
a right angle, mirrored or exchanged ones leave 40 deg and more."""

BETTER = 1 / 3
"""Another reading whose median angle is below this part of the given one's is the right one."""

ALONG = 0.5
"""Cosine between the needle's axis and the direction from flange to tip from which on the latter says where the tip
is: a straight needle on a flange has .9 and more, one that a holder turns aside by 60 deg has this."""

FEW = 0.1
"""Fraction of the directions that may be set aside without a warning: single ones are, in one true recording of 20."""

REVERSED = "v points from the tip to the hub"

ALLOWED = "v: the needle's direction from hub to tip, in the image's axes u and v"

SLIPS: Mapping[str, Floats] = MappingProxyType(
    {
        "v is rotated by a right angle": np.array([[0.0, -1.0], [1.0, 0.0]]),
        "one axis of v has the other sign": np.diag([1.0, -1.0]),
        "v_x and v_y are swapped": np.array([[0.0, 1.0], [1.0, 0.0]]),
    }
)
"""What people write instead, and how it is undone, but for the sign of the whole."""


class SeenDirection(NamedTuple):
    """The needle's direction as the poses agree on it."""

    V: Floats
    """Shape (3,), unit, frame end2."""
    agrees: NDArray[np.bool_]
    """Shape (n,)."""
    spread_rad: float
    """Root mean square angle inside the image between measured directions and those that V gives."""
    lean_rad: float
    """Root mean square angle across the image, out of its plane."""
    reversed: Bools
    """Shape (n,): the measured direction points from the tip to the hub."""
    sign_known: bool
    """Whether the direction from flange to tip determines which end of the needle is the tip."""


def needle_direction(estimate: Estimate, recording: Recording, kept: NDArray[np.bool_]) -> SeenDirection:
    """V, from the directions that agree, or from the image plane alone.

    Args:
        estimate: R_X, R_Y and t_Q.
        kept: Shape (n,): poses whose tip is trusted.
    """
    if recording.v is not None:
        return agreed_direction(estimate, recording, kept)
    V = direction_from_plane(estimate, recording.subset(kept))
    V = V if V @ estimate.t_Q > 0 else -V  # the tip lies ahead of the flange
    seen = np.ones(len(recording), dtype=bool)
    return SeenDirection(V, seen, 1.0, 1.0, ~seen, True)


def mean_direction(estimate: Estimate, recording: Recording) -> Floats:
    """V = normalise(sum M_i^T v_i), shape (3,), frame end2.

    Every M_i is a rotation from end2 to image, so that M_i^T v_i is the direction itself, seen by pose i.

    Args:
        estimate: R_X and R_Y.
        recording: With directions.
    """
    total = directions_end2(estimate, recording).sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def agreed_direction(estimate: Estimate, recording: Recording, kept: NDArray[np.bool_]) -> SeenDirection:
    """V from the poses that agree on it: the mean without those far from the median axis, toward the tip.

    An axis alone does not say which way it points. The tip lies ahead of the flange, and where it lies along the
    needle that says it; else most of the directions do.

    Args:
        estimate: R_X, R_Y and t_Q.
        recording: With directions.
        kept: Shape (n,): poses whose tip is trusted; only these make the mean.

    Raises:
        InputError: The directions have no common axis, or most of them point from the tip to the hub.
    """
    seen = directions_end2(estimate, recording)
    axis, angles = _common_axis(seen, kept)
    middle = float(np.median(angles[kept]))
    if middle > SCATTERED_RAD:
        _refuse_scattered(estimate, recording, kept, middle)
    along = float(axis @ estimate.t_Q / np.linalg.norm(estimate.t_Q))
    known = abs(along) >= ALONG
    axis = axis * np.sign(along if known else np.median(seen[kept] @ axis) or 1.0)
    backward = np.asarray(seen @ axis < 0.0)
    if backward[kept].sum() > 0.5 * kept.sum():
        what = f"{_counted(recording.names, backward, REVERSED)}: the tip would then be behind the flange"
        refuse(what, "recording", ALLOWED, "directions_reversed")
    agrees = (angles <= max(FAR * middle / HALF_NORMAL, LEAST_ANGLE)) & ~backward
    total = (agrees & kept) @ seen
    V = np.asarray(total / np.linalg.norm(total))
    found = direction_residuals(estimate._replace(V=V), recording, directions_image(recording, estimate))
    inside, across = np.sqrt(np.mean(found[agrees & kept] ** 2, axis=0))
    inside, across = max(float(inside), LEAST_SPREAD), max(float(across), LEAST_SPREAD)
    return SeenDirection(V, agrees, inside, across, backward, known)


def _common_axis(seen: Floats, kept: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """The axis (3,) nearest to most of the directions (n, 3), whatever their sign, and each one's angle to it (n,)."""
    longest = np.linalg.eigh(seen[kept].T @ seen[kept])[1][:, -1]  # signs do not matter to it
    middle = np.median((seen * np.where(seen @ longest < 0.0, -1.0, 1.0)[:, None])[kept], axis=0)
    axis = middle / np.linalg.norm(middle)
    return np.asarray(axis), np.arccos(np.clip(np.abs(seen @ axis), 0.0, 1.0))


def _refuse_scattered(estimate: Estimate, recording: Recording, kept: NDArray[np.bool_], middle: float) -> None:
    """Refuse directions without a common axis, naming the slip with which they would have one."""
    assert recording.v is not None
    what = f"the directions have no common axis in the needle's flange: they scatter by {np.degrees(middle):.0f} deg"
    for slip, undo in SLIPS.items():
        v = np.array(recording.v)
        v[:, :2] = v[:, :2] @ undo.T
        other = float(np.median(_common_axis(directions_end2(estimate, replace(recording, v=v)), kept)[1][kept]))
        if other < min(BETTER * middle, SCATTERED_RAD):
            what += f"; they would agree ({np.degrees(other):.1f} deg) if {slip}"
    refuse(what, "recording", ALLOWED, "directions_scattered")


def direction_findings(names: tuple[str, ...], aside: Bools, seen: SeenDirection) -> tuple[Finding, ...]:
    """Directions set aside (n,), those of them that are reversed, and whether their sign is known.

    Args:
        names: Of the poses.
        aside: Shape (n,): the tip was used and the direction was not.
    """
    found = []
    for code, rows, problem, most in (
        ("directions_reversed", seen.reversed, REVERSED, 0.0),
        ("directions_aside", aside & ~seen.reversed, "v contradicts the other poses", FEW),
    ):
        if rows.any():
            severity = Severity.WARNING if rows.mean() > most else Severity.NOTE
            text = f"{_counted(names, rows, problem)}; these directions were set aside"
            found.append(Finding(code, severity, text, {"count": float(rows.sum())}))
    if not seen.sign_known:
        text = (
            "the tip is not on the measured axis of the needle: its sense, taken from most directions, could not be "
            "checked"
        )
        found.append(Finding("direction_sign", Severity.WARNING, text))
    return tuple(found)


def _counted(names: tuple[str, ...], rows: Bools, problem: str) -> str:
    which = "" if rows.all() else f": {', '.join(np.array(names)[rows].tolist())}"
    return f"{problem} in {int(rows.sum())} of {len(names)} poses{which}"


def direction_from_plane(estimate: Estimate, recording: Recording) -> Floats:
    """V from nothing but the fact that the needle lies in the image: z.M_i V = 0 for every pose. Its sign is not known.

    Needs poses between which the needle rotated about itself; otherwise V is not unique.
    """
    across_image = needle_in_image(estimate, recording)[:, 2, :]
    return np.asarray(np.linalg.svd(across_image)[2][-1])  # null vector: z.M_i V = 0


class Linearised(NamedTuple):
    """Residuals and their derivatives."""

    residuals: Floats
    """Shape (n, k)."""
    jacobian: Floats
    """Shape (n, k, 19), by the parameters of ``parameters.PARAMETERS``."""


def linearised_tip(estimate: Estimate, recording: Recording) -> Linearised:
    """The tip's residuals with their Jacobian."""
    n, r = len(recording), tip_residuals(estimate, recording)
    R_A, R_AX = recording.A[:, :3, :3], recording.A[:, :3, :3] @ estimate.R_X
    p = recording.points_image(estimate.scale)
    _, in_base2 = tip_points(estimate, recording)
    J = np.zeros((n, 3, N_PARAMETERS))
    J[:, :, W_X] = R_AX @ skew(p)
    J[:, :, T_X] = -R_A
    J[:, :, W_Y] = -estimate.R_Y @ skew(in_base2)
    J[:, :, T_Y] = np.eye(3)
    J[:, :, T_Q] = estimate.R_Y @ recording.B[:, :3, :3]
    J[:, :, SCALE] = -R_AX[:, :, :2] * recording.P[:, None, :2]
    return Linearised(r, J)


def tip_residuals(estimate: Estimate, recording: Recording) -> Floats:
    """F = Y B Q - A X P, shape (n, 3), mm, base1."""
    in_end1, in_base2 = tip_points(estimate, recording)
    by_probe = (recording.A[:, :3, :3] @ in_end1[:, :, None])[:, :, 0] + recording.A[:, :3, 3]
    return np.asarray(in_base2 @ estimate.R_Y.T + estimate.t_Y - by_probe)


def tip_points(estimate: Estimate, recording: Recording) -> tuple[Floats, Floats]:
    """The tip in end1, by the image, and in base2, by the needle's arm; both (n, 3), mm."""
    in_end1 = recording.points_image(estimate.scale) @ estimate.R_X.T + estimate.t_X
    in_base2 = recording.B[:, :3, :3] @ estimate.t_Q + recording.B[:, :3, 3]
    return in_end1, in_base2


def linearised_direction(estimate: Estimate, recording: Recording, v_image: Floats) -> Linearised:
    """The direction's residuals (n, 2), rad for small ones, with their Jacobian.

    Args:
        estimate: Where to linearise.
        v_image: The measured directions, unit, shape (n, 3).
    """
    M = needle_in_image(estimate, recording)
    m = M @ estimate.V
    rows = across(v_image)
    R_AXY = (recording.A[:, :3, :3] @ estimate.R_X).transpose(0, 2, 1) @ estimate.R_Y
    J = np.zeros((len(recording), 2, N_PARAMETERS))
    J[:, :, W_X] = rows @ skew(m)  # dm = [m]x w_X
    J[:, :, W_Y] = -rows @ R_AXY @ skew(recording.B[:, :3, :3] @ estimate.V)
    J[:, :, DIRECTION] = rows @ M @ tangent_basis(estimate.V)
    return Linearised((rows @ m[:, :, None])[:, :, 0], J)


def direction_residuals(estimate: Estimate, recording: Recording, v_image: Floats) -> Floats:
    """The direction's residuals alone, shape (n, 2)."""
    return np.asarray(across(v_image) @ needle_in_image(estimate, recording) @ estimate.V)


def needle_in_image(estimate: Estimate, recording: Recording) -> Floats:
    """M = (R_A R_X)^T R_Y R_B, the rotation from end2 to image, shape (n, 3, 3)."""
    R_AX = recording.A[:, :3, :3] @ estimate.R_X
    return np.asarray(R_AX.transpose(0, 2, 1) @ estimate.R_Y @ recording.B[:, :3, :3])


def directions_image(recording: Recording, estimate: Estimate) -> Floats:
    """The measured directions in mm, as unit vectors (n, 3); one that was measured in the image only has z = 0.

    Raises:
        ValueError: The recording holds no directions.
    """
    if recording.v is None:
        raise ValueError("the recording has no directions")
    v = np.zeros((len(recording), 3))
    v[:, : recording.v.shape[1]] = recording.v
    v[:, :2] *= estimate.scale
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def directions_end2(estimate: Estimate, recording: Recording) -> Floats:
    """The measured directions as every pose has them in end2, M^T v: shape (n, 3), unit."""
    back = needle_in_image(estimate, recording).transpose(0, 2, 1)
    return np.asarray(np.einsum("nij,nj->ni", back, directions_image(recording, estimate)))


def across(v: Floats) -> Floats:
    """e1 (inside the image, across v) and e2 (across the image) of unit vectors (n, 3), as rows: shape (n, 2, 3)."""
    rows = np.zeros((len(v), 2, 3))
    a, b, c = v.T
    flat = np.hypot(a, b)
    rows[:, 0, 0], rows[:, 0, 1] = -b / flat, a / flat
    rows[:, 1, 0], rows[:, 1, 1], rows[:, 1, 2] = -a * c / flat, -b * c / flat, flat
    return rows


def facing(estimate: Estimate, recording: Recording) -> Bools:
    """Whether a pose's measured direction points along V at all, shape (n,): a reversed one has no residual."""
    m = needle_in_image(estimate, recording) @ estimate.V
    return np.asarray(np.einsum("ni,ni->n", m, directions_image(recording, estimate)) > 0)
