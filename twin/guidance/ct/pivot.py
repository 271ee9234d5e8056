"""Pivot calibration: the tip's place on the flange, from poses of the arm with the tip in one place.

With T_base_flange = (R_i, p_i) of pose i, the tip x in the flange frame and the place c in the base frame:

    R_i x + p_i = c      for all i: linear least squares in (x, c), 3 n equations for 6 unknowns

With independent noise s per axis at each touch the residuals' mean square is s^2 (3 n - 6) / n. Where the arm errs too,
with C the covariance of what all n touches miss by and M the projection off A's columns, it is trace(M C M) / n, and
the found tip's covariance is that of A^+ C A^+'.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from puncture_twin.planning.arm.kinematics import PARAMETERS
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.registration.marker_noise import reading_noise

MOST_OFF_MM = 50.0
"""mm by which a stated tip may be wrong: more is another needle."""
SLACK_MM = 5.0
"""mm by which an uncalibrated arm may miss one place."""
LEAST_POSES = 3
"""Two leave the tip free along a line."""
LARGE = 2.0
"""Residuals so many times the expected ones are not the declared noise: the arm's own errors, or a tip that slipped."""
WORST_FACTOR = 30.0
"""Magnification of the noise in the worst direction of the tip: poses that turn too little magnify it so."""


def check_one_place(names: Sequence[str], tips_base: Floats, axes_base: Floats, *, where: str) -> None:
    """Refuse touches that no tip near the stated one brings to one place.

    A tip that is wrong by d parts two touches of one place by 2 sin(angle / 2) d at most, with the angle between the
    two needles, and by twice d where the flange turns about them. The stated tip was at ``tips_base`` (n, 3), mm, the
    flange's axes are the columns of ``axes_base`` (n, 3, 3).

    Raises:
        InputError: Two of them are farther apart.
    """
    worst, two = 0.0, (0, 0)
    for i, j in combinations(range(len(names)), 2):
        cosine = (np.trace(axes_base[i].T @ axes_base[j]) - 1) / 2
        chord = float(np.sqrt(max(2 - 2 * min(cosine, 1.0), 0.0)))  # 2 sin(angle / 2)
        beyond = float(np.linalg.norm(tips_base[i] - tips_base[j])) - chord * MOST_OFF_MM - SLACK_MM
        if beyond > worst:
            worst, two = beyond, (i, j)
    if worst > 0:
        i, j = two
        apart = np.linalg.norm(tips_base[i] - tips_base[j])
        why = f"are {apart:.0f} mm apart; a tip offset of {MOST_OFF_MM:g} mm cannot explain that"
        what = f"touches of different points: {names[i]} and {names[j]} {why}"
        refuse(what, where, "touches of one point, with the needle tilted to several sides", "touches_apart")


@dataclass(frozen=True, eq=False)
class Pivot:
    """A calibrated tip, flange frame, and its place, base frame; mm."""

    tip_flange: Floats  # shape (3,), mm, in the flange frame
    place_base: Floats  # shape (3,), mm: where it stood
    cov_tip: Floats  # shape (3, 3), mm^2, from all that is declared
    misses_mm: Floats  # shape (n,): the distance of each tip from their place
    expected_mm: float
    """Rms of the misses as declared touch noise leaves it; `expected_whole_mm` with the arm's errors too."""
    expected_whole_mm: float

    @property
    def residual_mm(self) -> float:
        """Root mean square distance of the n tips from their place."""
        return rms(self.misses_mm)

    @property
    def large(self) -> bool:
        """Whether the residual contradicts what was declared."""
        return self.residual_mm > LARGE * self.expected_whole_mm


def pivot_calibration(
    T_base_flange: Floats, noise_mm: float, *, arm_cov: Floats | None = None, where: str = "pivot"
) -> Pivot:
    """The tip from poses (n, 4, 4), mm, that share its place; three or more, that are rotated enough, or it is refused.

    ``arm_cov`` (3 n, 3 n), mm^2, is of what the arm misses the place by, besides that noise; None for nothing.
    """
    count = len(T_base_flange)
    if count < LEAST_POSES:
        refuse(f"{count} poses", where, f"{LEAST_POSES} or more, rotated against each other", "too_few_poses")
    A = np.concatenate([T_base_flange[:, :3, :3], np.broadcast_to(-np.eye(3), (count, 3, 3))], axis=2).reshape(-1, 6)
    factors = np.linalg.svd(A, compute_uv=False)
    if not factors[-1] * WORST_FACTOR > 1.0:
        allowed = "tilts of 20 degrees or more to several sides"
        refuse("the poses rotate too little against each other to find the tip", where, allowed, "poses_too_alike")
    solution, *_ = np.linalg.lstsq(A, -T_base_flange[:, :3, 3].reshape(-1), rcond=None)
    left = (A @ solution + T_base_flange[:, :3, 3].reshape(-1)).reshape(-1, 3)
    whole = noise_mm**2 * np.eye(3 * count) + (0.0 if arm_cov is None else arm_cov)
    back = np.linalg.pinv(A)
    off = np.eye(3 * count) - A @ back
    expected = noise_mm * float(np.sqrt((3 * count - 6) / count))
    expected_whole = float(np.sqrt(np.trace(off @ whole @ off) / count))
    cov = (back @ whole @ back.T)[:3, :3]
    return Pivot(solution[:3], solution[3:], cov, np.linalg.norm(left, axis=1), expected, expected_whole)


def arm_covariance(errors: ErrorModel, model: UrModel, tip_mm: float, q: Floats) -> Floats:
    """Covariance (3 n, 3 n), mm^2, of touches of one place at joints (n, 6), rad, by all but tip and touch noise."""
    noise = reading_noise(errors, model, tip_mm, q, known=True)
    variances = noise.eta_variances.copy()
    variances[PARAMETERS["tip_offset"]] = variances[PARAMETERS["needle_direction"]] = 0.0
    anew = noise.cov_base - errors.touch_mm**2 * np.eye(3)
    covariance = (noise.arm_jacobian * variances) @ noise.arm_jacobian.T
    for row, block in enumerate(anew):
        covariance[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] += block
    return np.asarray(covariance)
