"""Is one list of markers scaled, stretched or sheared against the other? A rigid fit beside fits of one parameter more.

A unit that is a little off, slices whose step is wrong, a gantry tilt that nobody took back: each deforms what one side
shows, and a rigid motion leaves that to the residuals, where it looks like noise. Seven deformations of the CT's frame
are tried, one at a time: a similarity, a stretch along each axis, a shear in each plane. With z the residuals of the
rigid fit, whitened by what is declared of the readings, A its design and d the column of a deformation:

    F = (SSE_6 - SSE_7) / (SSE_7 / (3 N - 7))   follows F(1, 3 N - 7) where there is none,

and the best one's probability counts seven times (Bonferroni). It is reported and never applied: a marker that was
misread can look the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.gauss_newton import lacking
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits.least_squares import carried, design
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.reading_noise import ReadingNoise

DOUBTED, SURE = 0.05, 0.01
"""True lists look so deformed once in 20 registrations, and once in 100: it is said, and nothing is refused for it.
Where one axis is read five times as badly as the others and nobody declares it, the second is up to one in ten (1,000
draws each, 3 to 12 markers)."""

LEAST_MM = 0.05
"""Rms of what a deformation moves the markers by, below which it does not matter, however sure it is."""

KINDS = ("xyz", "x", "y", "z", "xy", "xz", "yz")
"""A similarity, three stretches, and shears: the first axis runs askew along the second."""


@dataclass(frozen=True)
class Distortion:
    """The deformation that explains most of the residuals.

    Attributes:
        axes: Of ``KINDS``, in the case's CT frame.
        amount: The factor less 1 by which markers_base are longer; of a shear by how much a point moves along the first
            axis per mm along the second.
        probability: Of one so sure in any of the seven, where there is none.
        moved_mm: What it moves the markers by beside a rigid motion, rms.
        reading_mm: The standard deviation per coordinate that it leaves to the readings.
        rms_mm: Expected error at the target by the residuals of the rigid fit.
        rms_without_mm: The same by those of the fit with the deformation.
    """

    axes: str
    amount: float
    probability: float
    moved_mm: float
    reading_mm: float
    rms_mm: float
    rms_without_mm: float

    @property
    def doubted(self) -> bool:
        """Whether true lists would seldom look so deformed, by so much that it matters: then it is reported."""
        return self.probability < DOUBTED and self.moved_mm >= LEAST_MM

    def text(self) -> str:
        """The finding, in one sentence."""
        noise = "not noise, for" if self.probability < SURE else "more than noise, it seems:"
        return (
            f"{self.brief()}: {noise} beside it the readings err by {self.reading_mm:.2g} mm a "
            "coordinate; without it the expected TRE at the target would be about "
            f"{self.rms_without_mm:.1f} mm instead of {self.rms_mm:.1f}; the registration does not use this"
        )

    def brief(self) -> str:
        """What is deformed, by how much, and how sure that is."""
        along = "" if self.axes == "xyz" else f" along the CT's {self.axes}"
        said = f"markers_base look {1 + self.amount:.4f} times as large as markers_ct{along}"
        if len(self.axes) == 2:
            angle = np.degrees(abs(np.arctan(self.amount)))
            said = f"the CT's frame looks {angle:.1f} degrees out of square, {self.axes[0]} against {self.axes[1]}"
        return f"{said} (F test, p {self.probability:.2g})"


def distortion(
    T_base_ct: Floats, markers: MarkerPairs, noise: ReadingNoise | None, target_ct: Floats
) -> Distortion | None:
    """The likeliest deformation of a registration's lists; None where its markers cannot show any.

    Args:
        T_base_ct: Shape (4, 4), near the least-squares fit.
        markers: Three or more.
        noise: What is declared of the readings; None weighs all alike.
        target_ct: Shape (3,), mm, where the error matters.
    """
    fitted = apply(T_base_ct, markers.points_ct)
    cov = np.eye(fitted.size) if noise is None else noise.covariance(T_base_ct[:3, :3]).whole
    root = np.linalg.inv(np.linalg.cholesky(cov))
    gaps, A = (markers.points_base - fitted).ravel(), design(fitted, fitted.mean(axis=0))
    center_ct = markers.points_ct.mean(axis=0)
    found = []
    for axes in KINDS:
        moved = _moved(axes, T_base_ct, markers.points_ct - center_ct).ravel()
        tested = lacking(root @ gaps, root @ A, root @ moved[:, None])
        if tested is not None:
            found.append((tested, axes, moved))
    if not found:
        return None
    best, axes, moved = min(found, key=lambda one: one[0].probability)
    amount, back = float(best.found[0]), np.linalg.pinv(A)
    beside, rigid = (column - A @ (back @ column) for column in (moved, gaps))
    at, at_moved = carried(fitted.mean(axis=0), apply(T_base_ct, target_ct))[:3], target_ct - center_ct
    whole = np.column_stack([A, moved]), np.column_stack([at, _moved(axes, T_base_ct, at_moved[None])[0]])
    return Distortion(
        axes,
        amount,
        min(1.0, len(KINDS) * best.probability),
        abs(amount) * float(np.linalg.norm(beside)) / float(np.sqrt(len(markers))),
        float(np.linalg.norm(rigid - amount * beside)) / float(np.sqrt(best.freedom)),
        _rms(root @ A, at, best.variance_without),
        _rms(root @ whole[0], whole[1], best.variance),
    )


def _moved(axes: str, T_base_ct: Floats, from_center_ct: Floats) -> Floats:
    """How points (n, 3) of the CT, from the markers' centroid, move in base axes per unit of amount, shape (n, 3)."""
    rows = ["xyz".index(axis) for axis in axes]
    M = np.zeros((3, 3))
    if len(axes) == 2:
        M[rows[0], rows[1]] = 1.0
    else:
        M[rows, rows] = 1.0
    return np.asarray(from_center_ct @ M.T @ T_base_ct[:3, :3].T)


def _rms(B: Floats, X: Floats, variance: float) -> float:
    """Expected error (rms, mm) of what X (3, p) carries from a fit of design B (m, p), whitened, to the target."""
    return float(np.sqrt(np.trace(X @ np.linalg.inv(B.T @ B) @ X.T) * variance))
