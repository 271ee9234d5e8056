"""What the image may do to tip and direction that a calibration does not ask for: is it there, and what does it cost?

A tip that is read as p lies at S p, S = [[1 + a, k], [0, 1 + b]]: mm per unit of P that are off, and axes that are not
square. A direction read as v points along S v, turned by w. The residuals' derivatives by (a, b, k, w) stand beside the
Jacobian, and the F-test of all of them together says whether residuals that are only noise would be so well explained:
once in a hundred recordings. The calibration does not use them; what they leave at the tips counts in its error.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.findings import Finding, Severity
from puncture_twin.planning.geometry.gauss_newton import lacking
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import SCALE, Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, linear_model, residual_weights
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import RobustFit, Whitening
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import directions_image, linearised_tip

DOUBTED = 0.01
"""A recording without such errors is said to have them once in a hundred."""
CLEAR = 3.0
"""An error so many standard deviations from zero is named beside the largest one."""

TEXT = ("mm per unit of P along u: {:.3f} times", "along v: {:.3f} times", "skew {:+.2f} deg", "v turned {:+.2f} deg")


class ImageErrors(NamedTuple):
    """The errors of the image that the residuals show."""

    names: tuple[str, ...]
    """Of those that were tested: ``scale_u``, ``scale_v``, ``skew``, ``turn``."""
    found: Floats
    """Shape (k,): a, b, k (per mm) and w (rad)."""
    sd: Floats
    probability: float
    """Of residuals so well explained where there are none: F(k, freedom)."""
    rms_mm: float
    """What they leave at the recorded tips, whatever the calibration does to make up for them."""

    @property
    def doubted(self) -> bool:
        """Whether the image is said to err."""
        return self.probability < DOUBTED

    def finding(self) -> Finding:
        """Which errors, how large, how sure, and what they cost."""
        size = np.abs(self.found / self.sd)
        shown = [
            TEXT[NAMES.index(name)].format(1 + value if name in NAMES[:2] else np.degrees(value))
            for name, value, over in zip(self.names, self.found, size, strict=True)
            if over >= min(CLEAR, size.max())
        ]
        said = (
            f"the residuals are not noise alone: they fit better with {', '.join(shown)} (F test of "
            f"{len(self.names)} errors of the image, p {self.probability:.2g}), which leaves {self.rms_mm:.2f} mm "
            "(rms) at the tips; the calibration does not use this: P_u_px, P_v_px as headers let it find mm per pixel"
        )
        numbers = dict(zip(self.names, self.found.tolist(), strict=True))
        return Finding("image_errs", Severity.WARNING, said, {**numbers, "p": self.probability, "rms_mm": self.rms_mm})


NAMES = ("scale_u", "scale_v", "skew", "turn")


def image_errors(problem: Problem, fit: RobustFit) -> ImageErrors | None:
    """The errors of the image at a fit; None where the poses cannot show them."""
    weights = residual_weights(problem, fit.tip_kept, fit.direction_kept)
    model = linear_model(problem, fit.estimate)
    free = SCALE.start not in problem.active
    wanted = np.array([free, free, True, problem.with_direction])
    columns = _columns(problem.recording, fit.estimate, problem.with_direction)[:, :, wanted]
    whitening = Whitening.of(model.sigma, model.shared, weights)
    A, more = whitening.slopes(model.jacobian), whitening.slopes(columns)
    found = lacking(-whitening.residuals(model.residuals), A, more, count=int(weights.sum()))
    if found is None:
        return None
    pulled = np.linalg.lstsq(A, more @ found.found, rcond=None)[0]
    left = (columns @ found.found - model.jacobian @ pulled)[fit.tip_kept, :3]
    rms = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    return ImageErrors(tuple(np.array(NAMES)[wanted].tolist()), found.found, found.sd, found.probability, rms)


def _columns(recording: Recording, estimate: Estimate, with_direction: bool) -> NDArray[np.float64]:
    """The residuals' derivatives by a, b, k and w, shape (n, 3 or 5, 4)."""
    tip = linearised_tip(estimate, recording).jacobian[:, :, SCALE] * estimate.scale
    skewed = -(recording.A[:, :3, :3] @ estimate.R_X)[:, :, :1] * (recording.P[:, None, 1:] * estimate.scale[1])
    columns = np.concatenate([tip, skewed, np.zeros_like(skewed)], axis=2)
    if not with_direction:
        return columns
    c, s, _ = directions_image(recording, estimate).T
    turned = np.stack([-c * s, c * s, -(s**2), np.ones(len(recording))], axis=1)
    rows = np.stack([-turned, np.zeros_like(turned)], axis=1)
    return np.concatenate([columns, rows], axis=1)
