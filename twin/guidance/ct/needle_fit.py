"""A needle fitted to a CT: the blurred rod whose image is nearest to the voxels about it, with covariance.

Free are its tip, its direction, the blur's size, the metal's density, and how it bends:

    b, d = 0, or ~ N(0, as needles bend), with even odds

Straight and bent fits are weighed by their evidence; the covariance is that of both, so that a bend which the image
neither shows nor excludes is in it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import OptimizeResult, least_squares
from scipy.special import expit

from puncture_twin.planning.anatomy.metal import BLUR_MM, Metal, full_part, metal_parts, spacing_mm
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply, skew
from puncture_twin.planning.registration.fits import carried_along
from puncture_twin.twin.guidance.ct.needle_image import LEVER_MM, NUMBERS, CurveImage

AHEAD_MM, FITTED_MM, TAIL_MM = 12.0, 120.0, 4.0
"""Beyond the foremost voxel of metal, and behind the tip, so much of a needle is fitted; not its other end."""
WIDE_MM = 2.5
"""About the axis of a needle, so far."""
WIDEST_SLICE = 0.6
"""Fraction of a slice's thickness: one slice at least is so near to the axis."""
UNLIKE = 0.35
"""Of the squares of a needle's voxels, what its image may leave: vessels, ribs and wires leave more."""
GAINS, BLURS = (0.4, 4.0), (0.5, 1.8)
"""Density of the metal over the assumed one, titanium to tungsten, where contrast in a vessel is far below; and blur
over the assumed one, where a rib is far above."""
LEAST_METAL = 0.3
"""Of a needle's brightest voxel: those above show its middle."""
MOST_CALLS = 30
"""Steps of a fit; one that has not settled by then is of no rod."""
SETTLED = 1e-6
"""A step that changes cost and numbers by a smaller fraction is the last."""
STRAIGHTENED, BENT_AGAIN = 2, 2
"""Times that a straight rod is fitted, as the first line through metal may hold something beside it; and a bent one."""
SCALES = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.3, 0.3, 1.0, 1.0, 1.0, 1.0])
"""Of what is fitted."""
PLACE_MM = 2.0
"""Of a needle's length, in which what a fit leaves is counted."""
BENT_MM = 0.3
"""A smaller sagitta is not called a bend."""
BEND_SD = np.array([2.0, 2.0, 0.5, 0.5])
"""How far needles bend at the lever, mm, square and cube, each across two axes; ours: a sagitta of 2 mm over 95 mm."""
PIECE_MM = 10.0
"""A needle's path is given in pieces no longer than this."""
LEAST_VOXEL, LEAST_DEG = 0.03, 0.02
"""Standard deviations that no fit undercuts: of the tip along each voxel axis, in voxels, and of the direction. What
blurs a scan is no exact Gaussian."""
FEW_SLICES = 4.0
"""A needle through fewer slices is not known to less than these across them."""
THIN_MM = 1.2
"""Through slices up to this a needle has one optimum."""
CORRELATED, CORRELATED_BENT = 4.0, 16.0
"""By which factor residuals of neighbouring voxels, which streaks and kernel share, widen the fit's variances: those of
a straight line, and those of a curve, which follows them further."""
MISLED = 6.0
"""By which factor the evidence of a bend counts less: stairs of slices look like one, as no Gaussian blurs them."""
AS_BRIGHT = 0.5
"""Of a needle's brightness: long, thin metal below it that is not a needle's image is bone."""
FARTHEST_MM = 3.0
"""The tip of a rod that was fitted lies so near to where its metal ends: else it is not its image."""
UNKNOWN = np.full((2, 6, 6), np.nan)
"""Covariance of both ends of what was not fitted."""


class Line(NamedTuple):
    """Middle (3,) and direction (3,), unit, of an axis, LPS mm; and how far the metal lies from it (rms)."""

    middle: Floats
    forward: Floats
    width_mm: float


class FoundNeedle(NamedTuple):
    """A needle in a CT, LPS mm.

    Attributes:
        tip_ct: Shape (3,).
        forward_ct: Shape (3,), unit, the direction in which it ends.
        width_mm: Root mean square distance of its metal from the axis.
        path_ct: Shape (m, 3), from the tip to where it is seen last.
        covs_ct: Shape (m, 6, 6), of each point of the path (mm) and of the direction there as a rotation (rad); none
            about the axis.
        sagitta_mm: Largest distance of its middle from the chord; 0 where it is not plainly bent.
        leaves: Whether the end that should be the tip is where the image ends.
        unclear: Whether it is long, thin metal that enters the body, but shows no image of a needle.
    """

    tip_ct: Floats
    forward_ct: Floats
    width_mm: float
    path_ct: Floats
    covs_ct: Floats
    sagitta_mm: float = 0.0
    leaves: bool = False
    unclear: bool = False

    @property
    def cov_ct(self) -> Floats:
        """Sigma6 of the tip and the direction in which it ends, shape (6, 6)."""
        return np.asarray(self.covs_ct[0])

    @property
    def tip_sd_mm(self) -> float:
        """Standard deviation of the tip in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.cov_ct[:3, :3])[-1]))

    @property
    def axis_sd(self) -> float:
        """Standard deviation of the direction in its worst plane, rad."""
        return float(np.sqrt(np.linalg.eigvalsh(self.cov_ct[3:, 3:])[-1]))

    def moved(self, T_b_ct: Floats, cov_T: Floats | None = None) -> FoundNeedle:
        """The needle in another frame.

        Args:
            T_b_ct: Shape (4, 4).
            cov_T: Shape (6, 6), of that motion at the moved tip, shift (mm) and rotation (rad), axes of b.
        """
        R = np.kron(np.eye(2), T_b_ct[:3, :3])
        path = apply(T_b_ct, self.path_ct)
        covs = R @ self.covs_ct @ R.T + (0.0 if cov_T is None else carried_along(path, cov_T))
        return self._replace(tip_ct=path[0], forward_ct=T_b_ct[:3, :3] @ self.forward_ct, covs_ct=covs, path_ct=path)


def toward(line: Line, point_ct: Floats) -> Line:
    """The line, directed to where a point (3,) lies."""
    return line if (point_ct - line.middle) @ line.forward > 0 else line._replace(forward=-line.forward)


def fit_needle(volume: Volume, metal: Metal, line: Line, diameter_mm: float, hidden: Bools) -> FoundNeedle | None:
    """The thin rod whose blurred and clipped image is nearest to the voxels about it.

    None where they are too dark for a needle; one that is unclear where they are not its image.
    """
    full = full_part(volume)
    reach_mm = np.maximum(BLUR_MM, [0.0, 0.0, spacing_mm(volume)[2]])  # a slice shares metal with its neighbours
    parts = np.minimum(metal_parts(volume, metal, reach_mm=reach_mm), full).ravel()
    typical = float(parts[metal.voxels.ravel()].mean())
    index = np.argwhere(np.ones(metal.voxels.shape, dtype=bool)) + [axis.start for axis in metal.box]
    places, shown = apply(volume.T_ct_index, index.astype(float)), ~hidden[tuple(index.T)]
    heavy = places[metal.voxels.ravel() & (parts > typical / 2)] - line.middle
    if not len(heavy):
        return None
    along = heavy @ line.forward
    start, begun = line.middle + float(along.max()) * line.forward, np.zeros(7)
    length = min(FITTED_MM, float(np.ptp(along)) - TAIL_MM)
    for again in range(STRAIGHTENED):
        axes = np.concatenate([line.forward[None], np.linalg.svd(line.forward[None])[2][1:]])
        local = (places - start) @ axes.T
        thick = axes[1:] @ volume.T_ct_index[:3, 2]
        about, bends = _about(local, np.where(shown, parts, 0.0), length, thick, line.width_mm)
        local, seen = local[about & shown], parts[about & shown]
        curve = CurveImage.of(volume, axes, diameter_mm)
        image = curve.parts(np.zeros(NUMBERS), local)
        bright = image > LEAST_METAL * image.max(initial=0.0)  # what a needle would show here: bone is far below
        if not bright.any() or typical < GAINS[0] / 2 * float(image[bright].mean()):
            return None
        starts = [begun, *(begun + more for more in _across(volume, axes, local[bright]) if not again)]
        fits = [_settled(curve, one, local, seen) for one in starts]
        straight = min(fits, key=lambda fit: float(fit.cost))
        if not again:
            modes = _modes(fits, straight, axes, len(seen))
        if again + 1 < STRAIGHTENED:  # once more about the line that was found
            start = start + straight.x[1:3] @ axes[1:]  # not along it, where a bent needle leaves a straight rod
            forward = np.concatenate([[1.0], straight.x[3:5]]) @ axes
            line = line._replace(forward=forward / np.linalg.norm(forward))
            begun = straight.x * [1, 0, 0, 0, 0, 1, 1]
    straight, fit, noise = _bent(curve, straight, bends, local, seen)
    x, cov, bent = _weighed(straight, fit, noise, len(seen))
    basis = block_diag(axes, axes[1:])
    cov[:5, :5] += basis @ modes @ basis.T
    left = curve.parts(x, local) - seen
    unlike, (blur, gain) = float(left @ left) / max(float(seen @ seen), 1e-9), np.exp(x[5:7])
    ahead = float(local[seen > 0.5 * min(full, float(seen.max()))][:, 0].max(initial=-np.inf) - x[0])
    if (
        unlike > UNLIKE
        or abs(ahead) > FARTHEST_MM + WIDE_MM + WIDEST_SLICE * float(np.linalg.norm(thick))
        or not (GAINS[0] < gain < GAINS[1] and BLURS[0] < blur < BLURS[1])
    ):
        return unclear(line, start) if typical > AS_BRIGHT * float(image[bright].mean()) else None
    s = -np.linspace(0.0, length, 1 + int(np.ceil(length / PIECE_MM)))
    path = start + (np.column_stack([s, curve.off(x, s)]) + x[:3]) @ axes
    covs, forward = _covariances(volume, x, cov, axes, s)
    sagitta = float(np.linalg.norm(np.cross(path - path[0], (path[-1] - path[0]) / length), axis=1).max())
    return FoundNeedle(path[0], forward, line.width_mm, path, covs, sagitta if bent and sagitta > BENT_MM else 0.0)


def unclear(line: Line, tip_ct: Floats) -> FoundNeedle:
    """Long, thin and dense metal that is not the image of a needle."""
    path = np.stack([tip_ct, 2 * line.middle - tip_ct])
    return FoundNeedle(tip_ct, toward(line, tip_ct).forward, line.width_mm, path, UNKNOWN, unclear=True)


def beside(across: Floats, thick: Floats) -> Floats:
    """Distance of points (n, 2) from what a slice's thickness (2,) makes of a needle's axis, across it, mm."""
    share = np.clip(across @ thick / max(float(thick @ thick), 1e-9), -WIDEST_SLICE, WIDEST_SLICE)
    return np.asarray(np.linalg.norm(across - share[:, None] * thick, axis=1))


def _about(local: Floats, seen: Floats, length: float, thick: Floats, width_mm: float) -> tuple[Bools, Floats]:
    """Which points (n, 3) lie about a straight needle, or about the curve through what is seen (n,), and that curve.

    Returns:
        Shape (n,); and shape (4, 2), factors of u³ to 1 with u from the tip in `LEVER_MM`, across the needle, mm.
    """
    across = beside(local[:, 1:], thick)
    near = (across <= WIDE_MM + 2 * width_mm) & (local[:, 0] > -length) & (local[:, 0] < AHEAD_MM)
    heavy, terms = seen[near, None], np.vander(np.minimum(local[near, 0], 0.0) / LEVER_MM, 4)
    bends = np.linalg.lstsq(heavy * terms, heavy * local[near, 1:], rcond=None)[0]
    about = near & (across <= WIDE_MM)
    about[near] |= beside(local[near, 1:] - terms @ bends, thick) <= WIDE_MM
    return about, np.asarray(bends, dtype=np.float64)


def _across(volume: Volume, axes: Floats, bright: Floats) -> Iterator[Floats]:
    """Changes (7,) of a start for a needle that lies in few slices: its place across them has several optima."""
    spacing, length = float(spacing_mm(volume)[2]), float(-bright[:, 0].min(initial=-AHEAD_MM))
    aside = axes @ volume.T_ct_index[:3, 2]
    if length * abs(float(aside[0])) < FEW_SLICES * spacing**2 and spacing > THIN_MM:
        for place, lean in itertools.product((-0.35, 0.0, 0.35), repeat=2):
            if place or lean:
                yield np.concatenate([[0.0], place * aside[1:], 2 * lean * aside[1:] / length, [0.0, 0.0]])


def _modes(fits: Sequence[OptimizeResult], best: OptimizeResult, axes: Floats, count: int) -> Floats:
    """What other lines that explain an image as well differ by: covariance of shift and slope, (6, 6), LPS.

    A needle in two slices may lean to either side of the plane between them: both lines have one image.
    """
    odds = np.exp([(float(best.cost) - float(fit.cost)) / _noise(best, count) ** 2 for fit in fits])
    gaps = np.array([fit.x[:5] - best.x[:5] for fit in fits]) @ block_diag(axes, axes[1:])
    return np.asarray(gaps.T @ (odds[:, None] * gaps) / odds.sum())


def _settled(
    curve: CurveImage, begun: Floats, local: Floats, seen: Floats, weights: Floats | float = 1.0, noise: float = 0.0
) -> OptimizeResult:
    """The numbers from a start (7,) or (11,) that bring the image of points (n, 3) nearest to what is seen (n,).

    Of 11 the bends are held to `BEND_SD`, which weighs as much as a voxel of so much noise.
    """
    count, weights = len(begun), np.broadcast_to(weights, len(seen))
    held = noise * np.eye(NUMBERS)[7:count] / BEND_SD[: count - 7, None]

    def whole(x: Floats) -> Floats:
        return np.concatenate([x, np.zeros(NUMBERS - count)])

    def misfit(x: Floats) -> Floats:
        return np.concatenate([weights * (curve.parts(whole(x), local) - seen), held @ whole(x)])

    def slopes(x: Floats) -> Floats:
        return np.concatenate([weights[:, None] * curve.slopes(whole(x), local), held])[:, :count]

    return least_squares(misfit, begun, slopes, x_scale=SCALES[:count], method="lm", max_nfev=MOST_CALLS,
                         ftol=SETTLED, xtol=SETTLED)  # fmt: skip


def _weights(curve: CurveImage, x: Floats, local: Floats, seen: Floats) -> Floats:
    """Of voxels (n,): by what a fit leaves of those about the same place along the needle.

    Skin, bone and streaks, which no image of a needle explains, are local.
    """
    image = curve.parts(x, local)
    shown = image > LEAST_METAL * image.max()
    place = ((local[:, 0] - local[:, 0].min()) / PLACE_MM).astype(int)
    squares = np.bincount(place, shown * (image - seen) ** 2)
    counts = np.bincount(place, shown.astype(np.float64))
    squares, counts = (gaussian_filter1d(one, 2.0, mode="constant") for one in (squares, counts))
    typical = squares.sum() / counts.sum()
    return np.asarray(np.sqrt(typical / ((squares + typical) / (counts + 1.0)))[place])


def _noise(fit: OptimizeResult, count: int) -> float:
    """Standard deviation of so many voxels' residuals, widened by what neighbours share."""
    left, factor = fit.fun[:count], CORRELATED if len(fit.x) == 7 else CORRELATED_BENT
    return float(np.sqrt(factor * (left @ left) / max(count - len(fit.x), 1)))


def _bent(
    curve: CurveImage, straight: OptimizeResult, bends: Floats, local: Floats, seen: Floats
) -> tuple[OptimizeResult, OptimizeResult, float]:
    """The straight and the bent fit under the same weights, and the noise.

    The bent one begins from the straight one and from the bend of the brightest voxels (4, 2).
    """
    seen_bend = np.concatenate([[0.0], bends[3], bends[2] / LEVER_MM, straight.x[5:7], bends[1], bends[0]])
    starts, weights, noise = (
        [np.concatenate([straight.x, np.zeros(4)]), seen_bend],
        np.ones(len(seen)),
        _noise(straight, len(seen)),
    )
    for _ in range(BENT_AGAIN):  # a bend that is not yet fitted looks like noise
        fit = min(
            (_settled(curve, one, local, seen, weights, noise) for one in starts), key=lambda one: float(one.cost)
        )
        starts, noise, weights = [fit.x], _noise(fit, len(seen)), _weights(curve, fit.x, local, seen)
    straight = _settled(curve, straight.x, local, seen, weights)
    fit = _settled(curve, fit.x, local, seen, weights, noise)
    return straight, fit, _noise(fit, len(seen))


def _weighed(straight: OptimizeResult, fit: OptimizeResult, noise: float, count: int) -> tuple[Floats, Floats, bool]:
    """The likelier of a straight and a bent fit (11,), the covariance of both (11, 11), and whether it is the bent one.

    Evidence of a fit by Laplace: exp(-chi^2 / 2), of the bent one times the root of det S / det S_0 of its bends.
    """
    plain, cov = np.concatenate([straight.x, np.zeros(4)]), np.zeros((11, 11))
    cov[:7, :7] = _noise(straight, count) ** 2 * np.linalg.pinv(straight.jac.T @ straight.jac)
    cov_bent = noise**2 * np.linalg.pinv(fit.jac.T @ fit.jac)
    kept = np.linalg.slogdet(cov_bent[7:, 7:] / np.outer(BEND_SD, BEND_SD))[1]
    odds = (float(straight.cost) - float(fit.cost)) / noise**2 / MISLED + kept / 2  # logarithm
    bent = bool(odds > 0)
    gap = fit.x - plain
    chance = float(expit(odds))
    both = (1 - chance) * cov + chance * cov_bent
    both += np.outer(gap, gap) * (1 - chance if bent else chance)
    return fit.x if bent else plain, both, bent


def _covariances(volume: Volume, x: Floats, cov: Floats, axes: Floats, s: Floats) -> tuple[Floats, Floats]:
    """Sigma6 of places s (m,) of the curve and of its direction there, (m, 6, 6), LPS; and the tip's direction (3,)."""
    moves = [0, 1, 2, 3, 4, 7, 8, 9, 10]
    cov, two = cov[np.ix_(moves, moves)], np.eye(2)
    covs, forward, length = np.empty((len(s), 6, 6)), axes[0], float(-s[-1])
    for row in range(len(s) - 1, -1, -1):
        u = s[row] / LEVER_MM
        slopes = np.kron([1.0, 2 * u / LEVER_MM, 3 * u**2 / LEVER_MM], two)
        forward = np.concatenate([[1.0], slopes @ x[moves[3:]]]) @ axes
        forward /= np.linalg.norm(forward)
        to_6 = np.zeros((6, 9))
        to_6[:3, :3], to_6[:3, 3:] = axes.T, axes[1:].T @ np.kron([s[row], u**2, u**3], two)
        to_6[3:, 3:] = skew(forward) @ axes[1:].T @ slopes  # a slope turns about what is across both
        covs[row] = to_6 @ cov @ to_6.T + _least(volume, forward, length)
    return covs, forward


def _least(volume: Volume, forward: Floats, length: float) -> Floats:
    """What no fit undercuts, shape (6, 6).

    A needle that lies in few slices may lie anywhere across them: what a slice shows says not at which depth.
    """
    edges = LEAST_VOXEL * volume.T_ct_index[:3, :3]
    across = np.eye(3) - np.outer(forward, forward)
    least = np.zeros((6, 6))
    least[:3, :3], least[3:, 3:] = edges @ edges.T, np.radians(LEAST_DEG) ** 2 * across
    spacing = float(spacing_mm(volume)[2])
    normal = volume.T_ct_index[:3, 2] / spacing
    flat = np.clip(1.0 - length * abs(float(forward @ normal)) / (FEW_SLICES * spacing), 0.0, 1.0)
    aside = across @ normal * flat * spacing / np.sqrt(12.0)
    least[:3, :3] += np.outer(aside, aside)
    lean = np.cross(forward, aside) * 2.0 / length
    least[3:, 3:] += np.outer(lean, lean)
    return least
