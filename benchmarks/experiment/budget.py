"""Anisotropic propagation against draws, for every marker set of the paper: with and without the lesion's own error."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.fits.least_squares import carried, design, fit_rigid, least_squares_map
from puncture_twin.twin.experiment.chen2019 import AS_STATED, READ, rows_of

SETS = ("ABC", "ABE", "ACD", "ABCE", "ABCDE")
DRAWS = 100_000


def rows() -> Iterator[Row]:
    """Predicted over realised rms at lesion M, of rigid fits under the stated errors."""
    target = READ[rows_of("M")[0]]
    cell = np.array([AS_STATED.slice_mm, AS_STATED.pixel_mm, AS_STATED.pixel_mm]) ** 2 / 12
    for names in SETS:
        points = READ[rows_of(names)]
        realised = _realised(points, target)
        predicted = _predicted(points, target, np.tile(cell + AS_STATED.touch_mm**2, len(points)))
        for what, one, own in (("", realised[0], 0.0), (" and M's own reading", realised[1], cell.sum())):
            ratio = np.sqrt(predicted**2 + own) / one
            yield Row.between(f"{'-'.join(names)}: predicted over realised ({one:.2f} mm){what}", ratio, 0.97, 1.03)


def _predicted(points: Floats, target: Floats, variances: Floats) -> float:
    center = points.mean(axis=0)
    at = (carried(center, target) @ least_squares_map(design(points, center)))[:3]
    return float(np.sqrt(np.sum(at**2 * variances)))


def _realised(points: Floats, target: Floats) -> tuple[float, float]:
    """Rms of rigid fits of drawn readings and touches at the target read without error, and read as the markers are."""
    rng = np.random.default_rng(3)
    everything = AS_STATED.draw_carton(np.vstack([points, target]), DRAWS, rng)  # readings off by as much
    touched = np.broadcast_to(points, (DRAWS, *points.shape)) + rng.normal(
        0, AS_STATED.touch_mm, (DRAWS, *points.shape)
    )
    T = fit_rigid(everything[:, :-1], touched)

    def rms(read: Floats) -> float:
        missed = (T[:, :3, :3] @ read[..., None])[..., 0] + T[:, :3, 3] - target
        return float(np.sqrt(np.mean(np.sum(missed**2, axis=1))))

    return rms(np.broadcast_to(target, (DRAWS, 3))), rms(everything[:, -1])
