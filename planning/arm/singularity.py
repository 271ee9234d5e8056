"""How far a configuration of a UR arm is from its three singularities: of shoulder, elbow and wrist."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import allocation_free

MIN_SINGULARITY = 0.05
"""Each term of :class:`Singularity` must exceed this over the whole insertion. For the wrist
that is 2.9 deg; joint speeds there are up to 20 times those of the best pose, and worse below."""

TIE_DIGITS = 9
"""Distances from singular that agree to so many digits are equal: mirrored branches and rolls are, but for rounding."""

ELBOW = 2
"""The row of `link_poses` whose origin is the elbow: where the upper arm ends."""

ELBOW_DIGITS = 6
"""The same of its place, mm: it does not move with the roll."""


class Singularity(NamedTuple):
    """How far a configuration is from the three singularities of a UR arm; each 0 (singular) to 1. Shapes (...)."""

    shoulder: Floats
    """In-plane distance of the wrist centre from axis 1, over the longest possible."""
    elbow: Floats
    """|sin q3|."""
    wrist: Floats
    """|sin q5|."""

    def least(self) -> Floats:
        """The smallest of the three, shape (...)."""
        return np.minimum(np.minimum(self.shoulder, self.elbow), self.wrist)

    @property
    def nearest(self) -> str:
        """Name of the nearest one, for a single configuration."""
        return min(self._fields, key=lambda name: float(getattr(self, name)))


def singularity(model: UrModel, q: Floats) -> Singularity:
    """Distance from the three singularities.

    The Jacobian's determinant is, up to sign and constant lengths, the product of sin q3, sin q5 and the shoulder
    term a2 cos q2 + a3 cos q23 + d5 sin q234 (tests hold this).

    Args:
        model: The arm.
        q: Shape (..., 6), rad.
    """
    rows = np.array(q, dtype=np.float64, order="C").reshape(-1, 6)  # a copy: read-only ones would be compiled for too
    terms = np.empty((3, len(rows)))
    _singularities(model.lengths, rows, terms)
    return Singularity(*terms.reshape(3, *np.shape(q)[:-1]))


def away_from_singularities(model: UrModel, q: Floats) -> NDArray[np.bool_]:
    """Whether configurations (..., 6) keep their distance from every singularity; NaN does not. Shape (...)."""
    return np.asarray(singularity(model, q).least() > MIN_SINGULARITY)


def farthest_from_singular(model: UrModel, q: Floats, elbow_towards: Floats) -> Floats:
    """Of configurations the one farthest from singular; of equals the one whose elbow lies farthest along a direction.

    A branch and its mirror image, and all rolls about the flange's axis, are equally far but for rounding: a choice
    among them by the last bit differs between machines.

    Args:
        model: The arm.
        q: Shape (n, 6), rad; rows may be NaN, not all of them.
        elbow_towards: Shape (3,), base frame: where there is room for the elbow.

    Returns:
        Shape (6,), rad.
    """
    least = np.round(singularity(model, q).least(), TIE_DIGITS)
    equal = q[least == np.nanmax(least)]
    elbow = link_poses(model, equal)[:, ELBOW, :3, 3] @ elbow_towards
    return np.asarray(equal[int(np.argmax(np.round(elbow, ELBOW_DIGITS)))])


@allocation_free()
def _singularities(lengths, q, terms):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``terms`` (3, n) from ``q`` (n, 6)."""
    for row in range(len(q)):
        shoulder, elbow, wrist = _singular_terms(lengths, q[row, 1], q[row, 2], q[row, 3], q[row, 4])
        terms[0, row], terms[1, row], terms[2, row] = shoulder, elbow, wrist


@allocation_free()
def _singular_terms(lengths, q2, q3, q4, q5):  # type: ignore[no-untyped-def]  # numba infers
    """Shoulder, elbow and wrist term, each 0 (singular) to 1."""
    a2, a3, d5 = lengths[1], lengths[2], lengths[4]
    in_plane = a2 * math.cos(q2) + a3 * math.cos(q2 + q3) + d5 * math.sin(q2 + q3 + q4)
    return abs(in_plane) / (abs(a2) + abs(a3) + d5), abs(math.sin(q3)), abs(math.sin(q5))


@allocation_free()
def least_term(lengths, q):  # type: ignore[no-untyped-def]  # numba infers
    """The least of the three terms of one configuration (6,); NaN where there is none."""
    shoulder, elbow, wrist = _singular_terms(lengths, q[1], q[2], q[3], q[4])
    return min(shoulder, elbow, wrist) if not math.isnan(shoulder) else math.nan
