"""A needle found in a CT: its axis by the least-squares line through its metal, its tip by a blurred rod's image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar
from scipy.special import ndtr

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
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply

SHORTEST_MM = 20.0
"""A shorter piece of metal is no needle."""
SHAFT_MM = 12.0
"""Behind the foremost voxel of metal, and beyond it, so far the needle is looked at."""
WIDE_MM = 3.0
"""About the axis of a needle, so far; of a wide rod half of its width."""
WIDEST_SLICE = 0.6
"""Fraction of a slice's thickness: one slice at least is so near to the axis."""
SLENDER = 8.0
"""Length over width: a rib is bent, and so wider."""
BLUR_SIGMA_MM = 0.5
"""Assumed of reconstruction and pixel together, in the plane."""


LEVELS_HU = (METAL_HU, 1000.0, 600.0, 400.0)
"""From what on voxels are taken for metal, one after the other until a needle is found: thick slices dilute it."""


FITTED_MM = 80.0
"""Behind the tip, so much of a needle is taken as straight."""
GROWTHS = 2
"""The first line through a short piece is not yet the needle's."""
SEEN_MM = 3.0
"""So far before and beyond a tip the needle's axis is clear of other metal: else the tip is not seen."""
LARGEST_GAP_MM = 6.0
"""Along a needle, between voxels that show it."""


class _Line(NamedTuple):
    """Middle (3,) and direction (3,), unit, of an axis, LPS mm; and how far the metal lies from it (rms)."""

    middle: Floats
    forward: Floats
    width_mm: float


class FoundNeedle(NamedTuple):
    """A needle in a CT, LPS mm.

    Attributes:
        tip_ct: Shape (3,).
        forward_ct: Shape (3,), unit, to the tip.
        width_mm: Root mean square distance of its metal from the axis.
    """

    tip_ct: Floats
    forward_ct: Floats
    width_mm: float


def find_needle(volume: Volume, target_ct: Floats, diameter_mm: float | None = None) -> FoundNeedle:
    """Find the needle of a control CT.

    Metal that is wider than the needle (bolts, plates) is not looked at, nor what it blurs into: the axis is that of
    the thin metal next to it. A tip there cannot be distinguished from it and is refused.

    Args:
        volume: The CT.
        target_ct: Shape (3,), LPS mm: its tip is the end nearer to this.
        diameter_mm: Of the needle; None for a rod that is wider than three pixels.

    Raises:
        InputError: No long piece of metal, or a needle that ends at other metal.
    """
    hidden = np.zeros(volume.values.shape, np.bool_) if diameter_mm is None else wide_metal(volume, diameter_mm)
    for level in LEVELS_HU[: 1 if diameter_mm is None else None]:
        rods = [piece for piece in metal_pieces(volume, level, hidden) if piece.size_mm >= SHORTEST_MM]
        for metal in sorted(rods, key=lambda piece: _gap(piece, volume, target_ct)):
            line = _axis(volume, metal, target_ct)
            if diameter_mm is None:
                return FoundNeedle(_tip(volume, metal, line, None), line.forward, line.width_mm)
            widest = diameter_mm / 2 + 0.5 * float(spacing_mm(volume).max()) + BLUR_SIGMA_MM
            if line.width_mm < min(widest, metal.size_mm / SLENDER):
                metal, line = _whole(volume, metal, line, target_ct, hidden)
                found = _fitted(volume, metal, line, diameter_mm, hidden)
                _check_tip(volume, found, target_ct, hidden)
                return found
    allowed = f"a straight piece of metal of {SHORTEST_MM:g} mm or more"
    raise InputError("no needle in the image", where=volume.path, allowed=allowed, code="needle_not_seen")


def _check_tip(volume: Volume, found: FoundNeedle, target_ct: Floats, hidden: Bools) -> None:
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


def _whole(volume: Volume, metal: Metal, line: _Line, target_ct: Floats, hidden: Bools) -> tuple[Metal, _Line]:
    """The whole needle, where thick slices dilute it and show it only in pieces at first."""
    for _ in range(GROWTHS):
        at = np.argwhere((volume.values > LEVELS_HU[-1]) & ~hidden)
        points = apply(volume.T_ct_index, at.astype(float)) - line.middle
        along = points @ line.forward
        across = np.linalg.norm(points - along[:, None] * line.forward, axis=1)
        near = across <= WIDE_MM + WIDEST_SLICE * float(spacing_mm(volume).max())
        at, along = at[near], along[near]
        order = np.argsort(along)
        parts = np.concatenate([[0], np.cumsum(np.diff(along[order]) > LARGEST_GAP_MM)])
        own = parts[np.argmin(np.abs(along[order]))]
        metal = _piece(volume, at[order[parts == own]])
        line = _axis(volume, metal, target_ct)
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


def _gap(metal: Metal, volume: Volume, point_ct: Floats) -> float:
    index = np.argwhere(metal.voxels) + [axis.start for axis in metal.box]
    return float(np.linalg.norm(apply(volume.T_ct_index, index.astype(float)) - point_ct, axis=1).min())


def _axis(volume: Volume, metal: Metal, target_ct: Floats) -> _Line:
    """Middle and direction of the weighted line of least squares, and how far the metal lies from it."""
    weights = metal_weights(volume, metal)
    at = np.argwhere(weights > 0)
    heavy = weights[tuple(at.T)]
    points = apply(volume.T_ct_index, at + np.array([axis.start for axis in metal.box], dtype=float))
    middle = centroid(weights, metal.box, volume.T_ct_index)
    spread = (points - middle) * np.sqrt(heavy / heavy.sum())[:, None]  # weighted for the SVD
    _, sizes, axes = np.linalg.svd(spread, full_matrices=False)
    forward = axes[0] if (target_ct - middle) @ axes[0] > 0 else -axes[0]  # toward the target
    return _Line(middle, forward, float(np.hypot(sizes[1], sizes[2])))


def _tip(volume: Volume, metal: Metal, line: _Line, diameter_mm: float | None) -> Floats:
    """The end of the rod whose blurred and clipped image is nearest to the voxels about the axis."""
    parts, full = metal_parts(volume, metal), full_part(volume)
    index = np.argwhere(np.ones(parts.shape, dtype=bool))
    points = apply(volume.T_ct_index, index + np.array([axis.start for axis in metal.box], dtype=float)) - line.middle
    along = points @ line.forward
    across = np.linalg.norm(points - along[:, None] * line.forward, axis=1)
    end = float(along[parts.ravel() > full / 2].max())
    thin = diameter_mm is not None
    wide = max(WIDE_MM if thin else line.width_mm / 2, WIDEST_SLICE * float(spacing_mm(volume).max()))
    near = (across <= wide) & (np.abs(along - end) <= SHAFT_MM)
    seen, points = np.minimum(parts.ravel()[near], full), points[near]
    image = _Rod(line.forward, _blur(volume), diameter_mm)

    def misfit(tip: float) -> float:
        return float(np.sum((np.minimum(image.parts(points - tip * line.forward), full) - seen) ** 2))

    found = minimize_scalar(misfit, bounds=(end - SHAFT_MM / 2, end + SHAFT_MM / 2), method="bounded")
    return line.middle + float(found.x) * line.forward


def _fitted(volume: Volume, metal: Metal, line: _Line, diameter_mm: float, hidden: Bools) -> FoundNeedle:
    """Tip and direction of the thin rod whose blurred and clipped image is nearest to the voxels about it."""
    start, full, blur = _tip(volume, metal, line, diameter_mm), full_part(volume), _blur(volume)
    parts = np.minimum(metal_parts(volume, metal), full).ravel()
    index = np.argwhere(np.ones(metal.voxels.shape, dtype=bool)) + [axis.start for axis in metal.box]
    points = apply(volume.T_ct_index, index.astype(float)) - start
    along = points @ line.forward
    across = np.linalg.norm(points - along[:, None] * line.forward, axis=1)
    reach = WIDE_MM + WIDEST_SLICE * float(spacing_mm(volume).max())
    near = (across <= reach) & (along > -FITTED_MM) & (along < SHAFT_MM) & ~hidden[tuple(index.T)]
    side = np.linalg.svd(line.forward[None])[2][1:]  # two unit vectors across the axis

    def rod(change: Floats) -> tuple[Floats, Floats]:
        forward = line.forward + change[3:] @ side
        return change[:3], forward / np.linalg.norm(forward)

    def misfit(change: Floats) -> Floats:
        shift, forward = rod(change)
        image = _Rod(forward, blur, diameter_mm).parts(points[near] - shift)
        return np.asarray(np.minimum(image, full) - parts[near])

    shift, forward = rod(least_squares(misfit, np.zeros(5), x_scale=[1.0, 1.0, 1.0, 0.02, 0.02]).x)
    return FoundNeedle(start + shift, forward, line.width_mm)


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
        lateral = np.einsum("ni,ij,nj->n", points, Q, points) - a * m**2
        return np.asarray(factor * np.exp(-0.5 * lateral) * ndtr(-m * np.sqrt(a)))


def _blur(volume: Volume) -> Floats:
    """Covariance of what blurs an image, shape (3, 3), mm²: the assumed one in the plane, and the slices' thickness."""
    spacing = spacing_mm(volume)
    axes = volume.T_ct_index[:3, :3] / spacing
    variances = np.array([BLUR_SIGMA_MM**2, BLUR_SIGMA_MM**2, spacing[2] ** 2 / 12])
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
