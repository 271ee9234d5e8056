"""A needle fitted to a CT: the blurred rod whose image is nearest to the voxels about it, with covariance.

Free are its tip, its direction, the blur's size, the metal's density, and how it bends:

    b, d = 0, or ~ N(0, as needles bend), with even odds

Straight and bent fits are weighed by their evidence; the covariance is that of both, so that a bend which the image
neither shows nor excludes is in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter
from scipy.optimize import OptimizeResult, least_squares
from scipy.special import expit

from puncture_twin.planning.anatomy.metal import BLUR_MM, SOLID_HU, Metal, full_part, metal_parts, spacing_mm
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
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
TIP_PLACES = 3
"""So many places behind a tip, and all beyond it, are those about the tip: metal ahead of a needle is not its tip."""
WIDER = 1.4
"""More than so much of what a needle's end has for its image is of something wider."""
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
EDGE_PIXELS = 0.06
"""Standard deviation of where a needle ends, in pixels along it: no blur is an exact Gaussian, and its tails move an
edge, which has one side, though not an axis, which has two. Tips err by so much without noise and streaks."""
ASLANT = np.sqrt(2.0)
"""A tip that ends in the next slice shows as far beside its metal as metal blurs, and one slice away."""
SHARED_MM = 15.0
"""Along a needle, in which the voxels of a slice err together: streaks begin at its metal."""
UNKNOWN_PART = 1e-7
"""Of what an image says of the number that it knows best: what it says less of than that, it says nothing of."""
ROUNDED = 1.0 / SOLID_HU / np.sqrt(12.0)
"""No image has less noise than its whole Hounsfield units."""
LEAST_OWN = 0.01
"""What a piece of a slice leaves to others of a number that it alone decides."""
FEW_SLICES = 4.0
"""A needle through fewer slices may lie in several ways across them."""
SPREAD, STEPS = 0.75, 9
"""Of a slice's thickness: so far each end of such a needle is moved to either side; and in how many steps."""
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
    """A needle in a CT, LPS mm."""

    tip_ct: Floats  # shape (3,)
    forward_ct: Floats  # shape (3,), unit, the direction in which it ends
    width_mm: float  # root mean square distance of its metal from the axis
    path_ct: Floats  # shape (m, 3), from the tip to where it is seen last
    covs_ct: Floats
    """Shape (m, 6, 6), of each point of the path (mm) and of the direction there as a rotation (rad); none about the
    axis."""
    sagitta_mm: float = 0.0  # largest distance of its middle from the chord; 0 where it is not plainly bent
    leaves: bool = False  # whether the end that should be the tip is where the image ends
    unclear: bool = False  # whether it is long, thin metal that enters the body, but shows no image of a needle

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
        """The needle in another frame, by T_b_ct (4, 4).

        ``cov_T`` (6, 6) is of that motion at the moved tip, shift (mm) and rotation (rad), axes of b.
        """
        R = np.kron(np.eye(2), T_b_ct[:3, :3])
        path = apply(T_b_ct, self.path_ct)
        covs = R @ self.covs_ct @ R.T + (0.0 if cov_T is None else carried_along(path, cov_T))
        return self._replace(tip_ct=path[0], forward_ct=T_b_ct[:3, :3] @ self.forward_ct, covs_ct=covs, path_ct=path)


def toward(line: Line, point_ct: Floats) -> Line:
    """The line, directed to where a point (3,) lies."""
    return line if (point_ct - line.middle) @ line.forward > 0 else line._replace(forward=-line.forward)


class _Seen(NamedTuple):
    """The voxels about a straight needle that are compared with its image."""

    curve: CurveImage
    axes: Floats  # shape (3, 3), rows: the needle's direction, and two across it
    local: Floats  # shape (n, 3), mm, in these axes from where the needle begins
    parts: Floats  # shape (n,), of metal
    slices: Ints  # shape (n,), in which slice each lies
    thick: Floats  # shape (3,), from one slice to the next, in these axes
    bends: Floats  # shape (4, 2), the curve through what is seen, as `_about` has it
    length: float  # of the needle, mm

    @property
    def bright(self) -> Bools:
        """Voxels that a needle would make bright, shape (n,): bone is far below."""
        image = self.curve.parts(np.zeros(NUMBERS), self.local)
        return np.asarray(image > LEAST_METAL * image.max(initial=0.0))

    @property
    def few(self) -> bool:
        """Whether the needle runs through few slices."""
        return bool(self.length * abs(self.thick[0]) < FEW_SLICES * (self.thick @ self.thick))

    def left(self, x: Floats) -> Floats:
        """Residuals of the image of a curve's numbers, shape (n,)."""
        return self.curve.parts(x, self.local) - self.parts

    @property
    def pieces(self) -> Ints:
        """Number of the piece of a slice of each, shape (n,): the error of a slice is shared along `SHARED_MM`."""
        along = np.floor(self.local[:, 0] / SHARED_MM).astype(np.int64)
        return np.unique(np.stack([self.slices, along]), axis=1, return_inverse=True)[1].ravel()


class _Around(NamedTuple):
    """Surroundings of a piece of metal: places (n, 3), slices (n,), parts of metal (n,), and which no other hides."""

    places: Floats
    slices: Ints
    parts: Floats
    shown: Bools
    typical: float

    @classmethod
    def of(cls, volume: Volume, metal: Metal, hidden: Bools) -> _Around:
        reach_mm = ASLANT * np.maximum(BLUR_MM, [0.0, 0.0, spacing_mm(volume)[2]])  # neighbours share a slice's metal
        parts = np.minimum(metal_parts(volume, metal, reach_mm=reach_mm, least=-np.inf), full_part(volume)).ravel()
        index = np.argwhere(np.ones(metal.voxels.shape, dtype=bool)) + [axis.start for axis in metal.box]
        places, typical = apply(volume.T_ct_index, index.astype(float)), float(parts[metal.voxels.ravel()].mean())
        return cls(places, index[:, 2], parts, ~hidden[tuple(index.T)], typical)

    def about(self, volume: Volume, line: Line, start: Floats, length: float, diameter_mm: float) -> _Seen:
        """Those about a line (3,), (3,)."""
        axes = np.concatenate([line.forward[None], np.linalg.svd(line.forward[None])[2][1:]])
        local, thick = (self.places - start) @ axes.T, axes @ volume.T_ct_index[:3, 2]
        about, bends = _about(local, np.where(self.shown, self.parts, 0.0), length, thick[1:], line.width_mm)
        some, curve = about & self.shown, CurveImage.of(volume, axes, diameter_mm)
        return _Seen(curve, axes, local[some], self.parts[some], self.slices[some], thick, bends, length)


def fit_needle(volume: Volume, metal: Metal, line: Line, diameter_mm: float, hidden: Bools) -> FoundNeedle | None:
    """The thin rod whose image is nearest to the voxels about it; None if they are dark, unclear if not its image."""
    around = _Around.of(volume, metal, hidden)
    heavy = (around.places - line.middle)[metal.voxels.ravel() & (around.parts > around.typical / 2)]
    if not len(heavy):
        return None
    along = heavy @ line.forward
    start, start_values = line.middle + float(along.max()) * line.forward, np.zeros(7)
    length = min(FITTED_MM, float(np.ptp(along)) - TAIL_MM)
    for again in range(STRAIGHTENED):
        seen = around.about(volume, line, start, length, diameter_mm)
        if not seen.bright.any():
            return None
        usual = float(seen.curve.parts(np.zeros(NUMBERS), seen.local)[seen.bright].mean())
        if around.typical < GAINS[0] / 2 * usual:
            return None
        straight = _straight(seen, start_values)
        if again + 1 < STRAIGHTENED:  # once more about the line that was found
            start = start + straight.x[1:3] @ seen.axes[1:]  # not along it, where a bent needle leaves a straight rod
            forward = np.concatenate([[1.0], straight.x[3:5]]) @ seen.axes
            line = line._replace(forward=forward / np.linalg.norm(forward))
            start_values = straight.x * [1, 0, 0, 0, 0, 1, 1]
            length = min(length, _slim(seen, np.concatenate([straight.x, np.zeros(4)])))
    weighed = _weighed(seen, straight) if straight.jac.any() else None  # no slope: its image has left the metal
    if weighed is None or not _alike(seen, weighed[0], full_part(volume)):
        return unclear(line, start) if around.typical > AS_BRIGHT * usual else None
    return _found(volume, seen, *weighed, start, line.width_mm)


def _alike(seen: _Seen, x: Floats, full: float) -> bool:
    """Whether what is seen is the image of a needle, as dense, as blurred, and as long as that of numbers (11,)."""
    (blur, gain), blurs, gains = x[5:7], np.log(BLURS), np.log(GAINS)
    metal = seen.parts > 0.5 * min(full, float(seen.parts.max()))
    ahead = float(seen.local[metal, 0].max(initial=-np.inf) - x[0])
    farthest = FARTHEST_MM + WIDE_MM + WIDEST_SLICE * float(np.linalg.norm(seen.thick[1:]))
    dense, blurred = gains[0] < gain < gains[1], blurs[0] < blur < blurs[1]
    return bool(_unlike(seen, x) <= UNLIKE and abs(ahead) <= farthest and dense and blurred)


def _unlike(seen: _Seen, x: Floats) -> float:
    """Fraction of squares that numbers (11,) leave: of all voxels, or about the tip, of a place behind; the larger."""
    place = np.floor((seen.local[:, 0] - x[0]) / PLACE_MM).astype(int)
    tip = max(-place.min() - TIP_PLACES, 1)
    squares = ((one**2).astype(np.float64) for one in (seen.left(x), seen.curve.parts(x, seen.local)))
    left, image = (np.bincount(place - place.min(), one, tip + 1) for one in squares)
    usual, whole = float(np.median(image[:tip])), float(seen.parts @ seen.parts)
    return float(max(left.sum() / max(whole, 1e-9), left[tip:].max() / max(usual, 1e-9)))


def _slim(seen: _Seen, x: Floats) -> float:
    """So far behind its tip, mm, a needle of numbers (11,) is as wide as there: a guide about it is wider.

    By its metal in all voxels about it, wherever a bend leads it; a last piece alone is bone or a hub.
    """
    place = np.floor((x[0] - seen.local[:, 0]) / PIECE_MM).astype(int)
    behind = place >= 0
    metal, image = (np.bincount(place[behind], one[behind], 2) for one in (seen.parts, seen.curve.parts(x, seen.local)))
    slim = np.flatnonzero(metal <= WIDER * metal[:2].sum() / max(float(image[:2].sum()), 1e-9) * image)
    count = max(int(slim.max(initial=0)) + 1, 2)
    return PIECE_MM * count if count + 2 <= len(metal) else np.inf


def _found(
    volume: Volume, seen: _Seen, x: Floats, cov: Floats, bent: bool, start: Floats, width_mm: float
) -> FoundNeedle:
    """The needle of numbers (11,), with their covariance; its end's place along it is known to the edge's."""
    s = -np.linspace(0.0, seen.length, 1 + int(np.ceil(seen.length / PIECE_MM)))
    path = start + (np.column_stack([s, seen.curve.off(x, s)]) + x[:3]) @ seen.axes
    cov[0, 0] += float(np.sum((EDGE_PIXELS * seen.axes[0] @ volume.T_ct_index[:3, :2]) ** 2))
    covs, forward = _covariances(x, cov, seen.axes, s)
    sagitta = float(np.linalg.norm(np.cross(path - path[0], (path[-1] - path[0]) / seen.length), axis=1).max())
    return FoundNeedle(path[0], forward, width_mm, path, covs, sagitta if bent and sagitta > BENT_MM else 0.0)


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

    It is (4, 2), factors of u³ to 1 with u from the tip in `LEVER_MM`, across the needle, mm.
    """
    across = beside(local[:, 1:], thick)
    near = (across <= WIDE_MM + 2 * width_mm) & (local[:, 0] > -length) & (local[:, 0] < AHEAD_MM)
    heavy, terms = seen[near, None], np.vander(np.minimum(local[near, 0], 0.0) / LEVER_MM, 4)
    bends = np.linalg.lstsq(heavy * terms, heavy * local[near, 1:], rcond=None)[0]
    about = near & (across <= WIDE_MM)
    about[near] |= beside(local[near, 1:] - terms @ bends, thick) <= WIDE_MM
    return about, np.asarray(bends, dtype=np.float64)


def _straight(seen: _Seen, start: Floats) -> OptimizeResult:
    """The straight rod nearest to what is seen; of one in few slices the best of those that begin elsewhere in them."""
    fit = _settled(seen, start)
    if not seen.few:
        return fit
    moves = _moves(seen)
    costs = _costs(seen, np.concatenate([fit.x, np.zeros(4)]), moves).reshape(STEPS, STEPS)
    valleys = moves[(costs <= minimum_filter(costs, 3, mode="nearest")).ravel()]
    return min([fit, *(_settled(seen, fit.x + move[:7]) for move in valleys)], key=lambda one: float(one.cost))


def _moves(seen: _Seen) -> Floats:
    """Changes (m, 11) of a needle's numbers that move its ends across the slices."""
    steps = np.linspace(-SPREAD, SPREAD, STEPS)
    tip, tail = (one.ravel()[:, None] * seen.thick[1:] for one in np.meshgrid(steps, steps))
    return np.concatenate([np.zeros((len(tip), 1)), tip, (tip - tail) / seen.length, np.zeros((len(tip), 6))], axis=1)


def _costs(seen: _Seen, x: Floats, moves: Floats) -> Floats:
    """Half the squares that numbers (11,) leave after each change (m, 11), shape (m,)."""
    return np.array([left @ left / 2 for left in (seen.left(x + move) for move in moves)])


def _unsettled(seen: _Seen, x: Floats, noise: float) -> tuple[Floats, Floats]:
    """By how much (11,) and mean square (11, 11) a needle in few slices lies otherwise in them than numbers (11,) say.

    What lies wholly in a slice has one image wherever it lies in it: no slope at the best fit tells how far.
    """
    moves = _moves(seen)
    costs = _costs(seen, x, moves)
    odds = np.exp((costs.min() - costs) / noise**2)
    odds /= odds.sum()
    mean = odds @ moves
    return mean, np.asarray((moves - mean).T @ (odds[:, None] * (moves - mean)))


def _settled(seen: _Seen, start: Floats, weights: Floats | float = 1.0, noise: float = 0.0) -> OptimizeResult:
    """The numbers from a start (7,) or (11,) that bring the image nearest to what is seen."""
    count, weights = len(start), np.broadcast_to(weights, len(seen.parts))
    # of 11 the bends are held to `BEND_SD`, which weighs as much as a voxel of so much noise
    held = noise * np.eye(NUMBERS)[7:count] / BEND_SD[: count - 7, None]

    def whole(x: Floats) -> Floats:
        return np.concatenate([x, np.zeros(NUMBERS - count)])

    def misfit(x: Floats) -> Floats:
        return np.concatenate([weights * seen.left(whole(x)), held @ whole(x)])

    def slopes(x: Floats) -> Floats:
        return np.concatenate([weights[:, None] * seen.curve.slopes(whole(x), seen.local), held])[:, :count]

    return least_squares(misfit, start, slopes, x_scale=SCALES[:count], method="lm", max_nfev=MOST_CALLS,
                         ftol=SETTLED, xtol=SETTLED)  # fmt: skip


def _weights(seen: _Seen, x: Floats) -> Floats:
    """Of voxels (n,): by what a fit leaves of those about the same place along the needle.

    Skin, bone and streaks, which no image of a needle explains, are local.
    """
    image = seen.curve.parts(x, seen.local)
    shown = image > LEAST_METAL * image.max()
    place = ((seen.local[:, 0] - seen.local[:, 0].min()) / PLACE_MM).astype(int)
    squares = np.bincount(place, shown * (image - seen.parts) ** 2)
    counts = np.bincount(place, shown.astype(np.float64))
    squares, counts = (gaussian_filter1d(one, 2.0, mode="constant") for one in (squares, counts))
    typical = squares.sum() / max(counts.sum(), 1.0) + ROUNDED**2
    return np.asarray(np.sqrt(typical / ((squares + typical) / (counts + 1.0)))[place])


def _scatter(seen: _Seen, fit: OptimizeResult, noise: float = 0.0) -> tuple[Floats, float]:
    """Covariance of a fit's numbers by how far they move when each piece of a slice is left out, and the noise.

        cov = A (sum_k t_k t_k') A,   t_k = (1 - J_k' J_k A)^-1 J_k' r_k,   A = (J'J)^-1

    the jackknife (Bell and McCaffrey 2002, their equation 3): no assumption on how voxels of a piece err together.
    What holds the bends counts as one more observation each. The noise is the standard deviation of voxels that err on
    their own and scatter the numbers as much.
    """
    pieces = seen.pieces
    count = len(pieces)
    scales = SCALES[: fit.jac.shape[1]]
    known, axes = np.linalg.eigh((fit.jac * scales).T @ (fit.jac * scales))
    root = scales[:, None] * axes / np.sqrt(np.maximum(known, max(UNKNOWN_PART * known[-1], 1e-9)))
    order = np.argsort(pieces, kind="stable")
    first = np.flatnonzero(np.diff(pieces[order], prepend=-1))
    rows = (fit.jac[:count] @ root)[order]
    pulls = np.add.reduceat(rows * fit.fun[:count][order, None], first)
    own, turns = np.linalg.eigh(np.eye(len(root)) - np.add.reduceat(rows[:, :, None] * rows[:, None, :], first))
    turned = np.einsum("kji,kj->ki", turns, pulls) / np.maximum(own, LEAST_OWN)
    moved, held = np.einsum("kij,kj->ki", turns, turned), noise * fit.jac[count:] @ root
    whole = moved.T @ moved + held.T @ held
    return root @ whole @ root.T, float(np.sqrt(max(np.trace(whole) / len(root), ROUNDED**2)))


def _bent(seen: _Seen, straight: OptimizeResult) -> tuple[OptimizeResult, OptimizeResult, float]:
    """The straight and the bent fit under the same weights, and the noise by which the bends were held."""
    bends = seen.bends
    seen_bend = np.concatenate([[0.0], bends[3], bends[2] / LEVER_MM, straight.x[5:7], bends[1], bends[0]])
    starts, weights = [np.concatenate([straight.x, np.zeros(4)]), seen_bend], np.ones(len(seen.parts))
    noise = _scatter(seen, straight)[1]
    for _ in range(BENT_AGAIN):  # a bend that is not yet fitted looks like noise
        fits = (_settled(seen, one, weights, noise) for one in starts)
        fit = min(fits, key=lambda one: float(one.cost))
        starts, weights = [fit.x], _weights(seen, fit.x)
        noise = _scatter(seen, fit, noise)[1]
    return _settled(seen, straight.x, weights), _settled(seen, fit.x, weights, noise), noise


def _weighed(seen: _Seen, first: OptimizeResult) -> tuple[Floats, Floats, bool]:
    """The likelier of a straight and a bent fit (11,), the covariance of both (11, 11), and whether it is the bent one.

    Evidence of a fit by Laplace: exp(-chi^2 / 2), of the bent one times the root of det S / det S_0 of its bends.
    """
    straight, fit, noise = _bent(seen, first)
    plain, cov = np.concatenate([straight.x, np.zeros(4)]), np.zeros((NUMBERS, NUMBERS))
    cov[:7, :7], noise_straight = _scatter(seen, straight)
    cov_bent, noise_bent = _scatter(seen, fit, noise)
    bends = noise_bent**2 * np.linalg.pinv(fit.jac.T @ fit.jac)[7:, 7:] / np.outer(BEND_SD, BEND_SD)
    odds = (float(straight.cost) - float(fit.cost)) / noise_bent**2 + np.linalg.slogdet(bends)[1] / 2  # logarithm
    bent, chance, gap = bool(odds > 0), float(expit(odds)), fit.x - plain
    x, noise = (fit.x, noise_bent) if bent else (plain, noise_straight)
    both = (1 - chance) * cov + chance * cov_bent
    both += np.outer(gap, gap) * (1 - chance if bent else chance)
    if seen.few:
        moved, spread = _unsettled(seen, x, noise)
        x, both = x + moved, both + spread
    return x, both, bent


def _covariances(x: Floats, cov: Floats, axes: Floats, s: Floats) -> tuple[Floats, Floats]:
    """Sigma6 of places s (m,) of the curve and of its direction there, (m, 6, 6), LPS; and the tip's direction (3,)."""
    moves = [0, 1, 2, 3, 4, 7, 8, 9, 10]
    cov, two = cov[np.ix_(moves, moves)], np.eye(2)
    covs, forward = np.empty((len(s), 6, 6)), axes[0]
    for row in range(len(s) - 1, -1, -1):
        u = s[row] / LEVER_MM
        slopes = np.kron([1.0, 2 * u / LEVER_MM, 3 * u**2 / LEVER_MM], two)
        forward = np.concatenate([[1.0], slopes @ x[moves[3:]]]) @ axes
        forward /= np.linalg.norm(forward)
        to_6 = np.zeros((6, 9))
        to_6[:3, :3], to_6[:3, 3:] = axes.T, axes[1:].T @ np.kron([s[row], u**2, u**3], two)
        to_6[3:, 3:] = skew(forward) @ axes[1:].T @ slopes  # a slope turns about what is across both
        covs[row] = to_6 @ cov @ to_6.T
    return covs, forward
