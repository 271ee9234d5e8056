"""What a set of poses cannot show (spec 3, section 3): the motions of the unknowns that hardly change any residual.

Columns are counted in rad and 100 mm, and base 2 turns about the middle of all tips rather than about its own origin:
wherever that origin lies, the same poses show the same. A recording is refused where the least singular value of the
Jacobian over the largest falls below ``LEAST_RATIO``. The weak motion is then named: each of four families of motions
has a known cause, and a family (or a line or plane of it) is weak when the Jacobian, restricted to it, is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import nearest_rotation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import (
    LENGTH_MM,
    T_Q,
    T_X,
    T_Y,
    W_X,
    W_Y,
    Estimate,
    parameter_units,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import linearised_tip, needle_in_image, tip_points

LEAST_RATIO = 9e-3
"""Below it the calibration is refused: constant insertion angle 1e-16, with noise 4e-4; 45 +- 1 deg 3.4e-3 to 4.4e-3,
45 +- 2 deg up to 8.8e-3; usual poses 3.6e-2 and more."""

IN_PLANE = 0.9
"""Fraction of a weak direction that must lie in the image (or across it) to be called so."""

NAMED_WITHIN = 1.5
"""A family whose own ratio is up to this much larger than the limit still is the name of a weak motion."""


class WeakMotion(NamedTuple):
    """One motion that the poses do not show."""

    cause: str
    """Short key, such as ``probe_orientation``, ``tip_position``, ``insertion_angle`` or ``needle_roll``."""
    dimensions: int
    """In how many independent ways."""
    text: str
    """What is wrong with the poses, and what can slide."""


class Observability(NamedTuple):
    """How well the poses show the unknowns."""

    ratio: float
    """Least over largest singular value."""
    dimensions: int
    """How many singular values are below the limit."""
    weak: tuple[WeakMotion, ...]
    """Named; empty where the ratio is large enough."""


def scaled_jacobian(
    estimate: Estimate, recording: Recording, active: NDArray[np.int_], centre_base2: Floats | None = None
) -> Floats:
    """The tip's Jacobian (3n, p) in units of 1 rad and 100 mm on both sides.

    Base 2 turns about a point c: w_Y leaves Y c where it is, so that t_Y gains R_Y [c]x w_Y.

    Args:
        estimate: Where the Jacobian is taken.
        recording: The poses.
        active: The free parameters.
        centre_base2: c, shape (3,), mm; None for the middle of the recording's tips.
    """
    centre = tips_centre(estimate, recording) if centre_base2 is None else centre_base2
    J = linearised_tip(estimate, recording).jacobian
    J[:, :, W_Y] += J[:, :, T_Y] @ estimate.R_Y @ skew(centre)
    J = J[:, :, active]
    return np.asarray((J * parameter_units(active, estimate.scale) / LENGTH_MM).reshape(-1, len(active)))


def tips_centre(estimate: Estimate, recording: Recording) -> Floats:
    """The middle of all tips as the needle's arm says, shape (3,), mm, base2."""
    return np.asarray(tip_points(estimate, recording)[1].mean(axis=0))


def observe(estimate: Estimate, recording: Recording, active: NDArray[np.int_]) -> Observability:
    """Say what the poses show, and what not.

    Args:
        estimate: Where the Jacobian is taken; any solution will do, also one of many.
        recording: The poses that were used.
        active: The free parameters.
    """
    active = active[active < 17]
    J = scaled_jacobian(estimate, recording, active)
    values = np.linalg.svd(J, compute_uv=False)
    ratio, limit = float(values[-1] / values[0]), LEAST_RATIO * float(values[0])
    if ratio >= LEAST_RATIO:
        return Observability(ratio, 0, ())
    found = [*_orientation(estimate, recording, J, active, limit), *_tip(estimate, recording, J, active, limit)]
    found += _relative(estimate, recording, J, active, limit)
    text = "the poses leave a combination of the unknowns free that has no simple name: vary everything more"
    return Observability(ratio, int((values < limit).sum()), tuple(found) or (WeakMotion("unnamed", 1, text),))


class _Family(NamedTuple):
    """The weak part of a three-dimensional family of motions."""

    weak: int
    """How many of its three directions are weak."""
    weakest: Floats
    """Unit vector (3,) in the family's own coordinates."""


def _weak_part(J: Floats, active: NDArray[np.int_], motions: Floats, limit: float) -> _Family:
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
) -> list[WeakMotion]:
    """t_X += k, t_Y += R_A k; and t_Q += k, t_Y -= R_Y R_B k."""
    probe, needle = np.zeros((2, 17, 3))
    probe[T_X], probe[T_Y] = np.eye(3), nearest_rotation(recording.A[:, :3, :3].mean(axis=0))
    needle[T_Q], needle[T_Y] = np.eye(3), -estimate.R_Y @ nearest_rotation(recording.B[:, :3, :3].mean(axis=0))
    found = []
    for arm, family, slides in (
        ("probe", probe, "the image's place on the probe and the distance between the bases"),
        ("needle", needle, "the tip's place on the needle and the distance between the bases"),
    ):
        weak, _ = _weak_part(J, active, family, limit)
        if weak == 3:
            found.append(WeakMotion(f"{arm}_orientation", 3, f"the {arm} hardly turns: {slides} can slide together"))
        elif weak:
            text = f"the {arm} turns about one axis only: {slides} can slide together along it"
            found.append(WeakMotion(f"{arm}_axis", weak, text))
    return found


def _tip(
    estimate: Estimate, recording: Recording, J: Floats, active: NDArray[np.int_], limit: float
) -> list[WeakMotion]:
    """w_X = k with t_X so that the mean tip stays: the image turns about the tip, or about the line of all tips."""
    family = np.zeros((17, 3))
    p = np.append((recording.P * estimate.scale).mean(axis=0), 0.0) / LENGTH_MM
    family[W_X], family[T_X] = np.eye(3), estimate.R_X @ skew(p)
    weak, _ = _weak_part(J, active, family, limit)
    if weak == 3:
        text = "the tip hardly moves in the image: the image can turn about it on the probe"
        return [WeakMotion("tip_position", 3, text)]
    if weak:
        text = "the tip moves along one line of the image only: the image can turn about that line on the probe"
        return [WeakMotion("tip_line", weak, text)]
    return []


def _relative(
    estimate: Estimate, recording: Recording, J: Floats, active: NDArray[np.int_], limit: float
) -> list[WeakMotion]:
    """t_X += R_X a, t_Q += b with M_i b = a for every pose: what does not turn between needle and image."""
    family = np.zeros((17, 3))
    family[T_X], family[T_Q] = estimate.R_X, nearest_rotation(needle_in_image(estimate, recording).mean(axis=0)).T
    weak, a = _weak_part(J, active, family, limit)
    if weak == 0:
        return []
    if weak == 3:
        text = "needle and image hardly turn against each other: image and tip can slide together in any direction"
        return [WeakMotion("needle_in_image", 3, text)]
    if weak == 1 and np.linalg.norm(a[:2]) >= IN_PLANE:
        text = "the insertion angle in the image hardly varies: the tip can slide along the needle"
        return [WeakMotion("insertion_angle", 1, text)]
    if weak == 1 and abs(a[2]) >= IN_PLANE:
        text = "the needle hardly turns about itself: image and tip can slide together across the image"
        return [WeakMotion("needle_roll", 1, text)]
    text = "the needle turns against the image about one axis only: image and tip can slide together along it"
    return [WeakMotion("needle_in_image_axis", weak, text)]
