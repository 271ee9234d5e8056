"""The needle's direction V in its flange frame, from the directions seen in the image or from the image plane alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.findings import Finding, Severity
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import (
    direction_residuals,
    directions_end2,
    directions_image,
    needle_in_image,
)

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
"""Cosine between the needle's axis and the way from its flange to its tip from which on that way says where the tip
is: a straight needle on a flange has .9 and more, one that a holder turns aside by 60 deg has this."""

FEW = 0.1
"""Share of the directions that may be set aside without a warning: single ones are, in one true recording in twenty."""

REVERSED = "v points from the tip to the hub"

ALLOWED = "v: the needle's direction from hub to tip, in the image's axes u and v"

SLIPS: Mapping[str, Floats] = MappingProxyType(
    {
        "v is turned by a right angle": np.array([[0.0, -1.0], [1.0, 0.0]]),
        "one axis of v has the other sign": np.diag([1.0, -1.0]),
        "v_x and v_y are exchanged": np.array([[0.0, 1.0], [1.0, 0.0]]),
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
    """Root mean square angle inside the image between what was measured and what V gives."""
    lean_rad: float
    """The same across the image."""
    reversed: Bools
    """Shape (n,): the measured direction points from the tip to the hub."""
    sign_known: bool
    """Whether the way from flange to tip says which end of the needle the tip is."""


def needle_direction(estimate: Estimate, recording: Recording, kept: NDArray[np.bool_]) -> SeenDirection:
    """V, from the directions that agree, or from the image plane alone.

    Args:
        estimate: R_X, R_Y and t_Q.
        recording: The poses.
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
        what = f"{_counted(recording.names, backward, REVERSED)}: by it the tip would lie behind the flange"
        raise InputError(what, where="recording", allowed=ALLOWED, code="directions_reversed")
    agrees = (angles <= max(FAR * middle / HALF_NORMAL, LEAST_ANGLE)) & ~backward
    total = (agrees & kept) @ seen
    V = np.asarray(total / np.linalg.norm(total))
    found = direction_residuals(estimate._replace(V=V), recording, directions_image(recording, estimate))
    inside, across = np.sqrt(np.mean(found[agrees & kept] ** 2, axis=0))
    inside, across = max(float(inside), LEAST_SPREAD), max(float(across), LEAST_SPREAD)
    return SeenDirection(V, agrees, inside, across, backward, known)


def _common_axis(seen: Floats, kept: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """The axis (3,) nearest to most of the directions (n, 3), whatever their sign, and each one's angle to it (n,)."""
    longest = np.linalg.eigh(seen[kept].T @ seen[kept])[1][:, -1]
    middle = np.median((seen * np.where(seen @ longest < 0.0, -1.0, 1.0)[:, None])[kept], axis=0)
    axis = middle / np.linalg.norm(middle)
    return np.asarray(axis), np.arccos(np.clip(np.abs(seen @ axis), 0.0, 1.0))


def _refuse_scattered(estimate: Estimate, recording: Recording, kept: NDArray[np.bool_], middle: float) -> None:
    """Say that the directions have no common axis, and by which slip they would have one."""
    assert recording.v is not None
    said = f"the directions have no common axis in the needle's flange: they scatter by {np.degrees(middle):.0f} deg"
    for slip, undo in SLIPS.items():
        v = np.array(recording.v)
        v[:, :2] = v[:, :2] @ undo.T
        other = float(np.median(_common_axis(directions_end2(estimate, replace(recording, v=v)), kept)[1][kept]))
        if other < min(BETTER * middle, SCATTERED_RAD):
            said += f"; they would agree ({np.degrees(other):.1f} deg) if {slip}"
    raise InputError(said, where="recording", allowed=ALLOWED, code="directions_scattered")


def direction_findings(names: tuple[str, ...], aside: Bools, seen: SeenDirection) -> tuple[Finding, ...]:
    """Which directions were set aside (n,), which of them are reversed, and whether their sign is anyone's word.

    Args:
        names: Of the poses.
        aside: Shape (n,): the tip was used and the direction was not.
        seen: The needle's direction.
    """
    found = []
    for code, rows, said, most in (
        ("directions_reversed", seen.reversed, REVERSED, 0.0),
        ("directions_aside", aside & ~seen.reversed, "v disagrees with the other poses", FEW),
    ):
        if rows.any():
            severity = Severity.WARNING if rows.mean() > most else Severity.NOTE
            text = f"{_counted(names, rows, said)}; these directions were set aside"
            found.append(Finding(code, severity, text, {"count": float(rows.sum())}))
    if not seen.sign_known:
        text = (
            "the tip does not lie along the needle's axis as it was measured: that the needle points the way that most "
            "directions say could not be checked"
        )
        found.append(Finding("direction_sign", Severity.WARNING, text))
    return tuple(found)


def _counted(names: tuple[str, ...], rows: Bools, said: str) -> str:
    which = "" if rows.all() else f": {', '.join(np.array(names)[rows].tolist())}"
    return f"{said} in {int(rows.sum())} of {len(names)} poses{which}"


def direction_from_plane(estimate: Estimate, recording: Recording) -> Floats:
    """V from nothing but the fact that the needle lies in the image: z.M_i V = 0 for every pose. Its sign is not known.

    Needs poses between which the needle turned about itself; otherwise V is not unique.
    """
    across_image = needle_in_image(estimate, recording)[:, 2, :]
    return np.asarray(np.linalg.svd(across_image)[2][-1])
