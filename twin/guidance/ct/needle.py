"""Needles found in a CT: axis, tip and bend of the blurred rod whose image is nearest to the voxels, with covariance.

A rod of radius r along a curve c(s), s <= 0 behind its tip, is blurred by a Gaussian, clipped, and compared with every
voxel about it. Free are its tip, its direction, the blur's size, the metal's density, and how it bends:

    c(s) = tip + s f + (b s^2 + d s^3) across f,    b, d = 0, or ~ N(0, as needles bend), with even odds

Straight and bent fits are weighed by their evidence; the covariance is that of both, so that a bend which the image
neither shows nor excludes is in it.

What is long, thin and dense is a needle only if it has the image of such a rod, and comes from outside of the body.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import OptimizeResult, least_squares, minimize_scalar
from scipy.special import expit, ndtr

from puncture_twin.planning.anatomy.metal import (
    AROUND_MM,
    METAL_HU,
    Metal,
    centroid,
    full_part,
    metal_parts,
    metal_pieces,
    metal_weights,
    spacing_mm,
    wide_metal,
)
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import Finding, InputError, Severity, refuse
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply, skew
from puncture_twin.planning.registration.fits import carried_along

SHORTEST_MM = 20.0
"""A shorter piece of metal is no needle."""
SHAFT_MM = 12.0
"""Behind the foremost voxel of metal, and beyond it, so far the needle is looked at."""
WIDE_MM = 2.5
"""About the axis of a needle, so far."""
WIDEST_SLICE = 0.6
"""Fraction of a slice's thickness: one slice at least is so near to the axis."""
SLENDER = 8.0
"""Length over width: a rib is bent, and so wider."""
BLUR_SIGMA_MM = 0.5
"""Assumed of reconstruction and pixel together, in the plane, before it is fitted."""
LEVELS_HU = (METAL_HU, 1000.0, 600.0, 400.0)
"""From what on voxels are taken for metal: thick slices dilute it."""
FITTED_MM = 120.0
"""Behind the tip, so much of a needle is fitted."""
GROWTHS = 4
"""The first line through a short piece is not yet the needle's."""
SEEN_MM = 3.0
"""So far before and beyond a tip the needle's axis is clear of other metal: else the tip is not seen."""
LARGEST_GAP_MM = 6.0
"""Along a needle, between voxels that show it."""
EDGE_VOXELS = 1.5
"""A needle that ends so near to the image's border leaves the image there."""
UNLIKE = 0.35
"""Of the squares of a needle's voxels, what its image may leave: vessels, ribs and wires leave more."""
GAINS, BLURS = (0.4, 4.0), (0.5, 1.8)
"""Density of the metal over the assumed one, titanium to tungsten, where contrast in a vessel is far below; and blur
over the assumed one, where a rib is far above."""
LEAST_METAL = 0.3
"""Of a needle's brightest voxel: those above show its middle."""
MOST_CALLS = 30
"""Steps of a fit; one that has not settled by then is of no rod."""
SAME_MM, SAME_DEG = 4.0, 10.0
"""Two pieces of one needle: so near to its axis, and so parallel."""
OF_PLAN_MM, OF_PLAN_DEG = 15.0, 15.0
"""Of two needles the plan's is the only one whose axis is so near to the planned tip, and so parallel to its line."""
BENT_MM = 0.3
"""A smaller sagitta is not called a bend."""
LEVER_MM = 50.0
"""At which a bend is counted."""
BEND_SD = np.array([2.0, 2.0, 0.5, 0.5])
"""How far needles bend at that, mm, square and cube, each across two axes; ours: a sagitta of 2 mm over 95 mm."""
PIECE_MM = 10.0
"""A needle's path is given in pieces no longer than this."""
LEAST_VOXEL, LEAST_DEG = 0.06, 0.05
"""Standard deviations that no fit undercuts: of the tip along each voxel axis, in voxels, and of the direction. What
blurs a scan is no exact Gaussian."""
FEW_SLICES = 4.0
"""A needle through fewer slices is not known to less than these across them."""
CORRELATED, CORRELATED_BENT = 2.0, 16.0
"""By which factor residuals of neighbouring voxels, which streaks and kernel share, widen the fit's variances: those of
a straight line, and those of a curve, which follows them further."""
MISLED = 6.0
"""By which factor the evidence of a bend counts less: stairs of slices look like one, as no Gaussian blurs them."""
MARKER_MM = 6.0
"""So far about a marker's middle its metal shows."""
UNSURE_MM = 1.5
"""A tip known worse than this is not read: streaks, other metal or thick slices hide where it ends."""
UNKNOWN = np.full((2, 6, 6), np.nan)
"""Covariance of both ends of what was not fitted."""
AS_BRIGHT = 0.5
"""Of a needle's brightness: long, thin metal below it that is not a needle's image is bone."""
FARTHEST_MM = 3.0
"""The tip of a rod that was fitted lies so near to where its metal ends: else it is not its image."""

Inside = Callable[[Floats], Bools]
"""Which of points (n, 3), LPS mm, lie in the body."""


class _Line(NamedTuple):
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


def find_needle(volume: Volume, target_ct: Floats, diameter_mm: float | None = None) -> FoundNeedle:
    """Find the needle, or the wide rod, whose metal is nearest to a point.

    Metal that is wider than the needle (bolts, plates) is not looked at, nor what it blurs into: the axis is that of
    the thin metal next to it. A tip there cannot be distinguished from it and is refused.

    Args:
        volume: The CT.
        target_ct: Shape (3,), LPS mm: its tip is the end nearer to this.
        diameter_mm: Of the needle; None for a rod that is wider than three pixels.

    Raises:
        InputError: No long piece of metal, or a needle that ends at other metal.
    """
    if diameter_mm is not None:
        found = [one for one in _needles(volume, target_ct, diameter_mm, None) if not one[0].unclear]
        if not found:
            _refuse_none(volume, "")
        nearest = min(found, key=lambda one: float(np.linalg.norm(one[0].path_ct - target_ct, axis=1).min()))
        _check_tip(volume, *nearest, target_ct)
        return nearest[0]
    rods = [piece for piece in metal_pieces(volume) if piece.size_mm >= SHORTEST_MM]
    if not rods:
        _refuse_none(volume, "")
    metal = min(rods, key=lambda piece: float(np.linalg.norm(_places(volume, piece) - target_ct, axis=1).min()))
    line = _toward(_axis(volume, metal), target_ct)
    end = _tip(volume, metal, line)
    return FoundNeedle(end, line.forward, line.width_mm, np.stack([end, line.middle]), UNKNOWN)


def read_needle(
    volume: Volume,
    target_ct: Floats,
    diameter_mm: float,
    inside: Inside,
    planned: tuple[Floats, Floats] | None = None,
    markers: Floats | None = None,
) -> tuple[FoundNeedle, tuple[Finding, ...]]:
    """Read the one needle that enters a body; another is reported, and none is guessed.

    Args:
        volume: The CT.
        target_ct: Shape (3,), LPS mm, for what is said of a tip that is not seen.
        diameter_mm: Of the needle.
        inside: Which points lie in the body.
        planned: Tip and unit direction (3,) of the plan, which may tell one needle from another.
        markers: Shape (n, 3), where markers lie: what is seen there is no needle.

    Raises:
        InputError: No needle, two of which none is plainly the plan's, a tip outside of the image, at other metal, or
            lost in streaks.
    """
    found = list(_needles(volume, target_ct, diameter_mm, inside, markers))
    if not found:
        _refuse_none(volume, ", that enters the body")
    findings: list[Finding] = []
    chosen = found[0]
    if len(found) > 1:
        chosen, findings = _chosen(volume, found, planned)
    needle, hidden = chosen
    if planned is not None and len(found) == 1 and not _of_plan(needle, *planned):
        said = f"the needle lies more than {OF_PLAN_MM:g} mm or {OF_PLAN_DEG:g} degrees off the planned line"
        findings = [Finding("far_from_plan", Severity.WARNING, said)]
    if needle.unclear:
        at = "({:.0f}, {:.0f}, {:.0f}) mm".format(*needle.tip_ct)
        what = (
            f"long metal ends in the body at {at} in the scan, but has not the image of a needle of {diameter_mm:g} mm"
        )
        refuse(what, volume.path, "one needle of the case's diameter, apart from other metal", "needle_unclear")
    if needle.leaves:
        refuse(
            "the needle leaves the image; its tip is outside", volume.path, "a scan with its tip", "tip_outside_image"
        )
    _check_tip(volume, needle, hidden, target_ct)
    if needle.tip_sd_mm > UNSURE_MM:
        sd = f"{needle.tip_sd_mm:.1f} mm (standard deviation)"
        what = f"streaks or thick slices hide the needle's tip: it is known to {sd} only"
        refuse(
            what, volume.path, f"a tip known to {UNSURE_MM:g} mm: thinner slices, or another gantry tilt", "tip_hidden"
        )
    return needle, tuple(findings)


def _refuse_none(volume: Volume, how: str) -> None:
    allowed = f"a straight or slightly bent piece of metal of {SHORTEST_MM:g} mm or more{how}"
    raise InputError("no needle in the image", where=volume.path, allowed=allowed, code="needle_not_seen")


def _chosen(
    volume: Volume, found: Sequence[tuple[FoundNeedle, Bools]], planned: tuple[Floats, Floats] | None
) -> tuple[tuple[FoundNeedle, Bools], list[Finding]]:
    """Of several needles the only one near the planned line, and the warning that there are others.

    Raises:
        InputError: None is, or two are.
    """
    alike = [] if planned is None else [one for one in found if _of_plan(one[0], *planned)]
    tips = "; ".join("({:.0f}, {:.0f}, {:.0f})".format(*one[0].tip_ct) for one in found)
    said = f"{len(found)} needles enter the body, with tips at {tips} mm in the scan"
    if len(alike) != 1:
        refuse(said, volume.path, "one needle, or --plan whose line is near to only one", "two_needles")
    said += "; the one near the planned line is read: ({:.0f}, {:.0f}, {:.0f})".format(*alike[0][0].tip_ct)
    return alike[0], [Finding("two_needles", Severity.WARNING, said, {"needles": len(found)})]


def _of_plan(needle: FoundNeedle, tip_ct: Floats, forward_ct: Floats) -> bool:
    away = tip_ct - needle.tip_ct
    aside = float(np.linalg.norm(away - (away @ needle.forward_ct) * needle.forward_ct))
    return aside < OF_PLAN_MM and float(needle.forward_ct @ forward_ct) > np.cos(np.radians(OF_PLAN_DEG))


def _needles(
    volume: Volume, target_ct: Floats, diameter_mm: float, inside: Inside | None, markers: Floats | None = None
) -> Iterator[tuple[FoundNeedle, Bools]]:
    """Every needle of the image, with the voxels that wider metal hides."""
    hidden = wide_metal(volume, diameter_mm)
    for marker in np.zeros((0, 3)) if markers is None else markers:
        _hide(volume, marker, hidden)
    widest = diameter_mm / 2 + 0.5 * float(spacing_mm(volume).max()) + BLUR_SIGMA_MM
    known: list[FoundNeedle] = []
    for level in LEVELS_HU:
        for metal in metal_pieces(volume, level, hidden):
            if metal.size_mm < SHORTEST_MM:
                continue
            places = _places(volume, metal)
            if _width(places) >= min(widest, metal.size_mm / SLENDER) or any(_same(one, places) for one in known):
                continue
            whole, line = _whole(volume, metal, _axis(volume, metal), hidden)
            ends = _tip_end(volume, whole, line, target_ct, inside, hidden)
            if ends is None:
                continue
            found = _fitted(volume, whole, _toward(line, ends[0]), diameter_mm, hidden)
            if found is None and level == METAL_HU:  # never passed over in silence
                found = _unclear(line, ends[0])
            if found is not None and not any(_same(one, found.path_ct) for one in known):
                known.append(found._replace(leaves=ends[1]))
                yield known[-1], hidden


def _hide(volume: Volume, marker: Floats, hidden: Bools) -> None:
    """Hide the voxels about a marker (3,), in place."""
    at, reach = apply(np.linalg.inv(volume.T_ct_index), marker), MARKER_MM / spacing_mm(volume)
    low, high = np.maximum(np.ceil(at - reach), 0).astype(int), np.floor(at + reach).astype(int) + 1
    box = tuple(slice(a, max(a, b)) for a, b in zip(low, np.minimum(high, hidden.shape), strict=True))
    index = np.moveaxis(np.indices(hidden[box].shape), 0, -1) + low
    hidden[box] |= np.linalg.norm((index - at) * spacing_mm(volume), axis=-1) <= MARKER_MM


def _same(needle: FoundNeedle, places: Floats) -> bool:
    """Whether places (n, 3) lie along a needle that is known."""
    away = places - needle.tip_ct
    aside = np.linalg.norm(away - np.outer(away @ needle.forward_ct, needle.forward_ct), axis=1)
    return bool(np.median(aside) < SAME_MM + needle.sagitta_mm)


def _places(volume: Volume, metal: Metal) -> Floats:
    """The voxels of a piece, shape (n, 3), LPS mm."""
    return apply(volume.T_ct_index, (np.argwhere(metal.voxels) + [axis.start for axis in metal.box]).astype(float))


def _width(places: Floats) -> float:
    """Root mean square distance of points (n, 3) from the smooth curve through them, mm."""
    away = places - places.mean(axis=0)
    _, axes = np.linalg.eigh(away.T @ away)  # ascending: the last is along it
    along = away @ axes[:, 2]
    terms = np.vander(along / max(float(np.abs(along).max()), 1.0), 4)
    aside = away @ axes[:, :2]
    return float(np.sqrt(np.mean(np.sum((aside - terms @ np.linalg.lstsq(terms, aside, rcond=None)[0]) ** 2, axis=1))))


def _toward(line: _Line, point_ct: Floats) -> _Line:
    return line if (point_ct - line.middle) @ line.forward > 0 else line._replace(forward=-line.forward)


def _tip_end(
    volume: Volume, metal: Metal, line: _Line, target_ct: Floats, inside: Inside | None, hidden: Bools
) -> tuple[Floats, bool] | None:
    """The end of a piece that is the tip (3,), and whether the image ends there; None for what is no needle.

    A needle comes from outside: its tip is the end in the body, the other one is outside of it or of the image, or
    goes on behind a marker.
    """
    places = _places(volume, metal)
    along = (places - line.middle) @ line.forward
    ends = places[[int(along.argmin()), int(along.argmax())]]
    if inside is None:
        near = int(np.linalg.norm(ends - target_ct, axis=1).argmin())
        return ends[near], False
    at = apply(np.linalg.inv(volume.T_ct_index), ends)
    beyond_at = (at < EDGE_VOXELS) | (at > np.array(volume.values.shape) - 1 - EDGE_VOXELS)
    border = np.asarray(beyond_at.any(axis=1))
    within, step = inside(ends), np.array([[-1.0], [1.0]]) * line.forward
    beyond = np.rint(apply(np.linalg.inv(volume.T_ct_index), ends + SEEN_MM * step)).astype(int)
    beyond = np.clip(beyond, 0, np.array(hidden.shape) - 1)
    out = border | ~within | hidden[tuple(beyond.T)]
    deeper = (target_ct - line.middle) @ line.forward > 0
    for one, other in ((1, 0), (0, 1)) if deeper else ((0, 1), (1, 0)):
        if within[one] and not border[one] and out[other]:
            return ends[one], False
    for one, other in ((0, 1), (1, 0)):
        if within[one] and border[one] and (border[other] or not within[other]):
            return ends[one], True
    return None


def _check_tip(volume: Volume, found: FoundNeedle, hidden: Bools, target_ct: Floats) -> None:
    """Refuse a tip at other metal: there the other metal begins, and the needle's end is not seen.

    Raises:
        InputError: It is.
    """
    beyond = found.tip_ct + np.arange(-SEEN_MM, SEEN_MM + 0.1, 0.25)[:, None] * found.forward_ct
    at = np.rint(apply(np.linalg.inv(volume.T_ct_index), beyond)).astype(int)
    inside = ((at >= 0) & (at < hidden.shape)).all(axis=1)
    if not hidden[tuple(at[inside].T)].any():
        return
    away = target_ct - found.tip_ct
    lateral = float(np.linalg.norm(away - (away @ found.forward_ct) * found.forward_ct))
    what = f"other metal hides the needle's tip; the needle's axis passes the target by {lateral:.1f} mm"
    refuse(what, volume.path, f"a tip at least {SEEN_MM:g} mm away from wider metal and its blur", "tip_hidden")


def _whole(volume: Volume, metal: Metal, line: _Line, hidden: Bools) -> tuple[Metal, _Line]:
    """The whole needle, where thick slices dilute it and show it only in pieces at first."""
    at = np.argwhere((volume.values > LEVELS_HU[-1]) & ~hidden)
    places = apply(volume.T_ct_index, at.astype(float))
    for _ in range(GROWTHS):
        points = places - line.middle
        along = points @ line.forward
        across = np.linalg.norm(points - along[:, None] * line.forward, axis=1)
        near = across <= WIDE_MM + 0.5 + line.width_mm + WIDEST_SLICE * float(spacing_mm(volume).max())
        kept, along = at[near], along[near]
        order = np.argsort(along)
        parts = np.concatenate([[0], np.cumsum(np.diff(along[order]) > LARGEST_GAP_MM)])
        own = parts[np.argmin(np.abs(along[order]))]
        metal = _piece(volume, kept[order[parts == own]])
        line = _axis(volume, metal)
    return metal, line


def _piece(volume: Volume, at: NDArray[np.int64]) -> Metal:
    """Voxels (n, 3) as a piece of metal."""
    spacing = spacing_mm(volume)
    around = np.ceil(AROUND_MM / spacing).astype(int)
    low, high = at.min(axis=0), at.max(axis=0) + 1
    begin, end = np.maximum(low - around, 0), np.minimum(high + around, volume.values.shape)
    voxels = np.zeros(end - begin, dtype=np.bool_)
    voxels[tuple((at - begin).T)] = True
    box = (slice(begin[0], end[0]), slice(begin[1], end[1]), slice(begin[2], end[2]))
    middle = apply(volume.T_ct_index, at.mean(axis=0))
    return Metal(box, voxels, middle, float(((high - low) * spacing).max()))


def _axis(volume: Volume, metal: Metal) -> _Line:
    """Middle and direction of the weighted line of least squares, and how far the metal lies from it."""
    weights = metal_weights(volume, metal)
    weights = weights if (weights > 0).sum() > 3 else metal.voxels.astype(np.float64)  # nothing of it is metal
    at = np.argwhere(weights > 0)
    heavy = weights[tuple(at.T)]
    points = apply(volume.T_ct_index, at + np.array([axis.start for axis in metal.box], dtype=float))
    middle = centroid(weights, metal.box, volume.T_ct_index)
    spread = (points - middle) * np.sqrt(heavy / heavy.sum())[:, None]  # weighted for the SVD
    _, sizes, axes = np.linalg.svd(spread, full_matrices=False)
    return _Line(middle, axes[0], float(np.hypot(sizes[1], sizes[2])))


def _tip(volume: Volume, metal: Metal, line: _Line) -> Floats:
    """The end of the wide rod whose blurred and clipped image is nearest to the voxels about the axis."""
    parts, full = metal_parts(volume, metal), full_part(volume)
    index = np.argwhere(np.ones(parts.shape, dtype=bool))
    points = apply(volume.T_ct_index, index + np.array([axis.start for axis in metal.box], dtype=float)) - line.middle
    along = points @ line.forward
    across = np.linalg.norm(points - along[:, None] * line.forward, axis=1)
    typical = float(np.quantile(parts[metal.voxels], 0.9))  # thick slices dilute it
    end = float(along[parts.ravel() > min(full, typical) / 2].max())
    wide = max(line.width_mm / 2, WIDEST_SLICE * float(spacing_mm(volume).max()))
    near = (across <= wide) & (np.abs(along - end) <= SHAFT_MM)
    seen, points = np.minimum(parts.ravel()[near], full), points[near]
    image = _Rod(line.forward, _blur(volume), None)

    def misfit(tip: float) -> float:
        return float(np.sum((np.minimum(image.parts(points - tip * line.forward), full) - seen) ** 2))

    found = minimize_scalar(misfit, bounds=(end - SHAFT_MM / 2, end + SHAFT_MM / 2), method="bounded")
    return line.middle + float(found.x) * line.forward


class _Curve(NamedTuple):
    """What is fitted: 11 numbers, in axes that have the needle's direction and the two across it as rows (3, 3).

    They are the tip's shift (3), mm; slope (2); logarithms of blur and density (2); bends (2 + 2), mm at `LEVER_MM`.
    A slice is as thick as slices lie apart: it is averaged over layers (m, 3), mm, in these axes.
    """

    axes: Floats
    blur: Floats
    layers: Floats
    diameter_mm: float
    full: float

    def off(self, x: Floats, s: Floats) -> Floats:
        """Distance of the curve from the straight line behind the tip, across it, shape (n, 2)."""
        u = np.minimum(s, 0.0) / LEVER_MM
        square = u * u
        return np.stack([s * x[3 + k] + square * (x[7 + k] + u * x[9 + k]) for k in (0, 1)], axis=1)

    def parts(self, x: Floats, local: Floats) -> Floats:
        """Image at points (n, 3) in its axes: the mean over the slice's layers."""
        turned = self.axes @ (np.exp(2 * x[5]) * self.blur) @ self.axes.T
        rod, image = _Rod(np.array([1.0, 0.0, 0.0]), turned, self.diameter_mm), np.zeros(len(local))
        for layer in self.layers:
            points = local + (layer - x[:3])
            points[:, 1:] -= self.off(x, points[:, 0])
            image += rod.parts(points)
        return np.asarray(np.minimum(np.exp(x[6]) / len(self.layers) * image, self.full))


THIN_MM = 1.2
"""Slices up to this blur as a Gaussian does; of thicker ones a needle shows where it enters and leaves them."""


def _fitted(volume: Volume, metal: Metal, line: _Line, diameter_mm: float, hidden: Bools) -> FoundNeedle | None:
    """The thin rod whose blurred and clipped image is nearest to the voxels about it.

    None where they are too dark for a needle; one that is unclear where they are not its image.
    """
    full = full_part(volume)
    parts = np.minimum(metal_parts(volume, metal), full).ravel()
    typical = float(parts[metal.voxels.ravel()].mean())
    index = np.argwhere(np.ones(metal.voxels.shape, dtype=bool)) + [axis.start for axis in metal.box]
    places, shown = apply(volume.T_ct_index, index.astype(float)), ~hidden[tuple(index.T)]
    heavy = places[metal.voxels.ravel() & (parts > typical / 2)] - line.middle
    start, begun = line.middle + float((heavy @ line.forward).max()) * line.forward, np.zeros(7)
    for again in range(STRAIGHTENED):
        axes = np.concatenate([line.forward[None], np.linalg.svd(line.forward[None])[2][1:]])
        local = (places - start) @ axes.T
        reach = WIDE_MM + WIDEST_SLICE * float(np.linalg.norm(axes[1:] @ volume.T_ct_index[:3, 2]))
        about, bends = _about(local, np.where(shown, parts, 0.0), reach, line.width_mm)
        local, seen = local[about & shown], parts[about & shown]
        curve = _Curve(axes, *_layers(volume, axes), diameter_mm, full)
        image = curve.parts(np.zeros(11), local)
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
    length = min(FITTED_MM, float(-local[seen > full / 4][:, 0].min(initial=-SHORTEST_MM)))
    fit, noise = _bent(curve, straight, bends, local, seen)
    x, cov, bent = _weighed(straight, fit, noise, len(seen))
    basis = block_diag(axes, axes[1:])
    cov[:5, :5] += basis @ modes @ basis.T
    left = curve.parts(x, local) - seen
    unlike, (blur, gain) = float(left @ left) / max(float(seen @ seen), 1e-9), np.exp(x[5:7])
    ahead = float(local[seen > 0.5 * min(full, float(seen.max()))][:, 0].max(initial=-np.inf) - x[0])
    if (
        unlike > UNLIKE
        or abs(ahead) > FARTHEST_MM + reach
        or not (GAINS[0] < gain < GAINS[1] and BLURS[0] < blur < BLURS[1])
    ):
        return _unclear(line, start) if typical > AS_BRIGHT * float(image[bright].mean()) else None
    s = -np.linspace(0.0, length, 1 + int(np.ceil(length / PIECE_MM)))
    path = start + (np.column_stack([s, curve.off(x, s)]) + x[:3]) @ axes
    covs, forward = _covariances(volume, x, cov, axes, s)
    sagitta = float(np.linalg.norm(np.cross(path - path[0], (path[-1] - path[0]) / length), axis=1).max())
    return FoundNeedle(path[0], forward, line.width_mm, path, covs, sagitta if bent and sagitta > BENT_MM else 0.0)


def _unclear(line: _Line, tip_ct: Floats) -> FoundNeedle:
    """Long, thin and dense metal that is not the image of a needle."""
    path = np.stack([tip_ct, 2 * line.middle - tip_ct])
    return FoundNeedle(tip_ct, _toward(line, tip_ct).forward, line.width_mm, path, UNKNOWN, unclear=True)


def _about(local: Floats, seen: Floats, reach: float, width_mm: float) -> tuple[Bools, Floats]:
    """Which points (n, 3) lie about a straight needle, or about the curve through what is seen (n,), and that curve.

    Returns:
        Shape (n,); and shape (4, 2), factors of u³ to 1 with u from the tip in `LEVER_MM`, across the needle, mm.
    """
    across = np.linalg.norm(local[:, 1:], axis=1)
    near = (across <= reach + 2 * width_mm) & (local[:, 0] > -FITTED_MM) & (local[:, 0] < SHAFT_MM)
    heavy, terms = seen[near, None], np.vander(np.minimum(local[near, 0], 0.0) / LEVER_MM, 4)
    bends = np.linalg.lstsq(heavy * terms, heavy * local[near, 1:], rcond=None)[0]
    about = near & (across <= reach)
    about[near] |= np.linalg.norm(local[near, 1:] - terms @ bends, axis=1) <= reach
    return about, np.asarray(bends, dtype=np.float64)


def _across(volume: Volume, axes: Floats, bright: Floats) -> Iterator[Floats]:
    """Changes (7,) of a start for a needle that lies in few slices: its place across them has several optima."""
    spacing, length = float(spacing_mm(volume)[2]), float(-bright[:, 0].min(initial=-SHORTEST_MM))
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


def _layers(volume: Volume, axes: Floats) -> tuple[Floats, Floats]:
    """Blur of a layer of a slice (3, 3), mm², LPS, and where the layers lie (m, 3), mm, in axes."""
    count = 3 if float(spacing_mm(volume)[2]) > THIN_MM else 1
    steps = (np.arange(count) - (count - 1) / 2) / count
    return _blur(volume, count), np.outer(steps, axes @ volume.T_ct_index[:3, 2])


def _settled(curve: _Curve, begun: Floats, local: Floats, seen: Floats, noise: float = 0.0) -> OptimizeResult:
    """The numbers from a start (7,) or (11,) that bring the image of points (n, 3) nearest to what is seen (n,).

    Of 11 the bends are held to `BEND_SD`, which weighs as much as a voxel of so much noise.
    """
    zeros = np.zeros(11 - len(begun))

    def misfit(x: Floats) -> Floats:
        left = curve.parts(np.concatenate([x, zeros]), local) - seen
        return left if len(zeros) else np.concatenate([left, noise * x[7:] / BEND_SD])

    most = MOST_CALLS * len(begun)
    return least_squares(misfit, begun, x_scale=SCALES[: len(begun)], method="lm", max_nfev=most)


STRAIGHTENED, BENT_AGAIN = 2, 2
"""Times that a straight rod is fitted, as the first line through metal may hold something beside it; and a bent one."""
SCALES = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.3, 0.3, 1.0, 1.0, 1.0, 1.0])
"""Of what is fitted."""


def _noise(fit: OptimizeResult, count: int) -> float:
    """Standard deviation of so many voxels' residuals, widened by what neighbours share."""
    left, factor = fit.fun[:count], CORRELATED if len(fit.x) == 7 else CORRELATED_BENT
    return float(np.sqrt(factor * (left @ left) / max(count - len(fit.x), 1)))


def _bent(
    curve: _Curve, straight: OptimizeResult, bends: Floats, local: Floats, seen: Floats
) -> tuple[OptimizeResult, float]:
    """The bent fit, begun from the straight one and from the bend of the brightest voxels (4, 2); and its noise."""
    seen_bend = np.concatenate([[0.0], bends[3], bends[2] / LEVER_MM, straight.x[5:7], bends[1], bends[0]])
    starts = [np.concatenate([straight.x, np.zeros(4)]), seen_bend]
    noise = _noise(straight, len(seen))
    for _ in range(BENT_AGAIN):  # a bend that is not yet fitted looks like noise
        fit = min((_settled(curve, one, local, seen, noise) for one in starts), key=lambda one: float(one.cost))
        starts, noise = [fit.x], _noise(fit, len(seen))
    return fit, noise


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


class _Rod(NamedTuple):
    """Model of a rod that ends in the origin, blurred by a Gaussian.

    Attributes:
        forward: Shape (3,), unit, to its end.
        blur: Shape (3, 3), mm², covariance.
        diameter_mm: None for a rod that is much wider than the blur: then only what is near its axis is right.
    """

    forward: Floats
    blur: Floats
    diameter_mm: float | None

    def parts(self, points: Floats) -> Floats:
        """Part of the rod at each point (n, 3), mm, 0 to 1.

        Of a thin rod: π r² times the integral of the Gaussian's density along the axis, from infinity to the end. With
        Q the inverse covariance, a = n'Qn and m = n'Qx / a that is r²/2 √(det Q / a) exp(-(x'Qx - a m²) / 2) Φ(-m √a).
        The cross section's own width, r²/4 per axis, counts as blur.
        """
        n, covariance, factor = self.forward, self.blur, 1.0
        if self.diameter_mm is not None:
            covariance = covariance + self.diameter_mm**2 / 16 * (np.eye(3) - np.outer(n, n))
        Q = np.linalg.inv(covariance)
        a = float(n @ Q @ n)
        m = points @ Q @ n / a
        if self.diameter_mm is None:
            return np.asarray(ndtr(-(points @ n) / np.sqrt(n @ covariance @ n)))
        factor = self.diameter_mm**2 / 8 * np.sqrt(np.linalg.det(Q) / a)
        lateral = ((points @ Q) * points).sum(axis=1) - a * m**2
        return np.asarray(factor * np.exp(-0.5 * lateral) * ndtr(-m * np.sqrt(a)))


def _blur(volume: Volume, layers: int = 1) -> Floats:
    """Covariance of what blurs an image, shape (3, 3), mm²: the assumed one in the plane, and the slices' thickness.

    Args:
        layers: In which a slice is taken apart.
    """
    spacing = spacing_mm(volume)
    axes = volume.T_ct_index[:3, :3] / spacing
    variances = np.array([BLUR_SIGMA_MM**2, BLUR_SIGMA_MM**2, (spacing[2] / layers) ** 2 / 12])
    return np.asarray(axes @ np.diag(variances) @ axes.T)


class NeedleError(NamedTuple):
    """A needle's error seen from the target, mm: total² = lateral² + depth², depth positive when too deep."""

    tip_to_target_mm: float
    lateral_mm: float
    depth_mm: float


def needle_error(tip_ct: Floats, forward_ct: Floats, target_ct: Floats) -> NeedleError:
    """Tip minus target (3,), mm, split along and across the needle's unit direction (3,)."""
    error = tip_ct - target_ct
    depth = float(error @ forward_ct)
    return NeedleError(float(np.linalg.norm(error)), float(np.linalg.norm(error - depth * forward_ct)), depth)
