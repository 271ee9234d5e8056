"""Where what holds together with the body ends in one section drawn along the bed: a table, cradle or pad.

A scanner's table has the same section in every slice; a patient has not. What touches the patient and is as dense as
they are cannot be told from them by threshold, but its far side can: seen from there, it is the same line in nearly
every slice. Nothing comes from beyond that line. The bed may run at an angle to the slices' axis (a tilted gantry).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.flat_side import SIDES, surface_ends
from puncture_twin.planning.base.arrays import Bools, Floats

DRAWN_MM = 0.75
"""A line of sight is drawn where the surface keeps within this of its median; noise moves it by some 0.3 mm."""
DRAWN_FRACTION = 0.8
"""Of the slices at least. Seen from its far side nothing lies before a table."""
DRAWN_WIDTH_MM = 100.0
"""Over so much of its width together. Of a real abdomen in air no side keeps to a line over more than 63 mm."""
BESIDE_WIDTH_MM = 20.0
"""Where one side is drawn, so much suffices for those beside it: where a cradle rises steeply it is seen from there."""
RUN_MM = 20.0
"""Single lines of sight may be drawn by chance; a table has runs of this width."""
SMOOTH_ALONG_MM = 12.0
"""Ends are averaged so far along the bed: a table is constant there, noise is not."""
LEAST_LENGTH_MM = 50.0
"""In a shorter image every body is nearly one section along the bed: tables that touch it are not told."""
TILTS_FROM_MM = 100.0
"""From this length of the image on, a bed at an angle to the slices' axis is looked for too."""
TILTS_RAD = np.radians(np.linspace(-4.0, 4.0, 17))
"""Of the bed against the slices' axis, across the lines of sight; along them any angle is found."""
NEARLY = 0.95
"""A tilted bed explains more than a straight one only if more than this is drawn."""
TOO_SHORT = (
    "the image is only {length:.0f} mm long: a curved table or cradle that is as dense as the body and touches it "
    "cannot be told from the body"
)


class DrawnSide(NamedTuple):
    """One line, drawn along the bed, at which a body ends.

    Attributes:
        axis: 0 or 1, running to the left or to the back: along the lines of sight.
        end: 0 or -1, the side of the body: at the axis' low or high end.
        across: Shape (n,), where the lines of sight cross the other axis in slice 0, ascending, voxels.
        along: Shape (n,), where each meets the line in slice 0, voxels along ``axis``.
        slope: How far ``across`` and ``along`` move from slice to slice, voxels.
        width_mm: How much of the width is drawn.
        whole: Whether this is the table's far side, so that its edges are where the line ends; else it is a part of a
            table that is seen from the side.
    """

    axis: int
    end: int
    across: Floats
    along: Floats
    slope: tuple[float, float]
    width_mm: float
    whole: bool

    @property
    def warning(self) -> str:
        """One sentence."""
        return (
            f"the body ends in one section along the bed at its {SIDES[self.axis, self.end]} side, over "
            f"{self.width_mm:.0f} mm, as a table or cradle does; nothing beyond it counts as free"
        )


class _Ends(NamedTuple):
    """Where lines of sight end at one side of a body.

    Attributes:
        axis: 0 or 1, along the lines of sight.
        end: 0 or -1.
        ends_mm: Shape (n, nz), along the axis, NaN where they end at nothing.
        firm: Shape (n, nz), which of them may count as drawn.
        spacing_mm: Shape (3,).
        near_mm: How near to their median ends are drawn.
        middle_mm: Shape (3,), of the body.
    """

    axis: int
    end: int
    ends_mm: Floats
    firm: Bools
    spacing_mm: Floats
    near_mm: float
    middle_mm: Floats

    @property
    def length_mm(self) -> float:
        """Of the image, along the bed."""
        return float(self.ends_mm.shape[1] * self.spacing_mm[2])


class _Bed(NamedTuple):
    """Ends of lines of sight (n,), mm, in slice 0 of a bed that may run at an angle to the slices' axis.

    Attributes:
        at: The median over the slices, NaN without any.
        farthest: The outermost over the slices, NaN without any.
        drawn: Whether the line of sight ends at the same place in most slices.
        slopes: Of the bed along axes 0 and 1, mm per mm.
        width_mm: How much is drawn.
    """

    at: Floats
    farthest: Floats
    drawn: Bools
    slopes: tuple[float, float]
    width_mm: float


def drawn_sides(above: NDArray[np.floating], trunk: Bools, spacing_mm: Floats) -> tuple[DrawnSide, ...]:
    """The sides at which a body, or what holds together with it, ends in one section along the bed.

    Args:
        above: Shape (nx, ny, nz), Hounsfield units above those of the body's surface, axis 2 along the bed.
        trunk: Same shape; what is as dense and connected with it counts too, however thin.
        spacing_mm: Shape (3,).
    """
    solid = _connected(above > 0.0, trunk)
    views, middle_mm = [], _middle_mm(trunk, spacing_mm)
    for axis, end in itertools.product((0, 1), (0, -1)):
        ends_mm = _smooth(surface_ends(above, solid, axis, end) * spacing_mm[axis], float(spacing_mm[2]))
        views.append(_Ends(axis, end, ends_mm, np.isfinite(ends_mm), spacing_mm, DRAWN_MM, middle_mm))
    return _sides(views)


def support_side(outside: Bools, body: Bools, spacing_mm: Floats) -> DrawnSide | None:
    """The side at which something outside of the body ends in one section along the bed: what it lies on.

    None where there is nothing like it; of several the widest. Between its parts, where the body lies before it, the
    line runs where the body ends farthest out.

    Args:
        outside: Shape (nx, ny, nz), what was scanned, lies outside of the body and is not air.
        body: Same shape.
        spacing_mm: Shape (3,).
    """
    views, middle_mm = [], _middle_mm(body, spacing_mm)
    solid = outside | body
    for axis, end in itertools.product((0, 1), (0, -1)):
        first = _first(solid, axis, end)
        ends_mm = _smooth(first * spacing_mm[axis], float(spacing_mm[2]))
        near_mm = max(DRAWN_MM, float(spacing_mm[axis]))
        firm = np.isfinite(ends_mm) & (_first(outside, axis, end) == first)
        views.append(_Ends(axis, end, ends_mm, firm, spacing_mm, near_mm, middle_mm))
    sides = [side for side in _sides(views) if side.whole]
    return max(sides, key=lambda side: side.width_mm, default=None)


def _middle_mm(body: Bools, spacing_mm: Floats) -> Floats:
    """The body's middle, shape (3,), from the first voxel's centre."""
    return np.asarray(scipy.ndimage.center_of_mass(body)) * spacing_mm


def _first(mask: Bools, axis: int, end: int) -> Floats:
    """Outer face of the first voxel of a mask along each line of an axis, from one end; NaN without any."""
    seen = np.moveaxis(mask, axis, 0)[:: -1 if end else 1]
    first = np.where(seen.any(axis=0), np.argmax(seen, axis=0) - 0.5, np.nan)
    return np.asarray(len(seen) - 1 - first if end else first)


def _sides(views: Sequence[_Ends]) -> tuple[DrawnSide, ...]:
    """The drawn sides of one bed: of the directions that each side suggests, the one under which most is drawn."""
    if views[0].length_mm < LEAST_LENGTH_MM:
        return ()
    suggested = [bed.slopes for bed in map(_own_bed, views) if bed.width_mm >= DRAWN_WIDTH_MM]
    found = [[_bed_at(view, slopes) for view in views] for slopes in [(0.0, 0.0), *suggested]]
    widths = [sum(bed.width_mm for bed in beds) for beds in found]
    nearly = [beds for beds, width in zip(found, widths, strict=True) if width >= NEARLY * max(widths)]
    beds = min(nearly, key=lambda beds: np.hypot(*beds[0].slopes))
    tables = [bed.width_mm >= DRAWN_WIDTH_MM for bed in beds]
    sides = []
    for view, bed, table in zip(views, beds, tables, strict=True):
        next_to = any(tables[i] for i, other in enumerate(views) if other.axis != view.axis)
        if table or (next_to and bed.width_mm >= BESIDE_WIDTH_MM):
            sides.append(_side(view, bed, table))
    return tuple(side for side in sides if side is not None)


def _connected(dense: Bools, body: Bools) -> Bools:
    """What is dense and holds together with the body, which is part of it."""
    labels, count = scipy.ndimage.label(dense | body)
    kept = np.zeros(count + 1, bool)
    kept[np.unique(labels[body])] = True
    kept[0] = False
    return np.asarray(kept[labels])


def _own_bed(view: _Ends) -> _Bed:
    """The bed under whose direction most lines of sight of one side are drawn."""
    if view.length_mm < TILTS_FROM_MM:
        return _bed_at(view, (0.0, 0.0))
    beds = [_bed_at(view, (0.0, 0.0))]
    for across in np.tan(sorted(TILTS_RAD, key=abs)):
        along = _commonest_slope(_sheared(view, across), float(view.spacing_mm[2]))
        beds.append(_bed_at(view, (along, across) if view.axis == 0 else (across, along)))
    return _straightest(beds)


def _straightest(beds: Sequence[_Bed]) -> _Bed:
    """Of the beds under which nearly most is drawn the one with the least tilt."""
    most = max(bed.width_mm for bed in beds)
    return min((bed for bed in beds if bed.width_mm >= NEARLY * most), key=lambda bed: np.hypot(*bed.slopes))


def _smooth(ends_mm: Floats, step_mm: float) -> Floats:
    """Means along the bed of the ends that are known."""
    size = 2 * round(SMOOTH_ALONG_MM / step_mm / 2) + 1
    known = np.isfinite(ends_mm)
    weight = scipy.ndimage.uniform_filter1d(known.astype(float), size, axis=1, mode="nearest")
    mean = scipy.ndimage.uniform_filter1d(np.where(known, ends_mm, 0.0), size, axis=1, mode="nearest")
    return np.where(known & (weight > 0.5), mean / np.maximum(weight, 0.5), np.nan)


def _bed_at(view: _Ends, slopes: tuple[float, float]) -> _Bed:
    """The bed of one direction; what ends before the body's middle is not beyond the body, but beside it."""
    along_bed = np.arange(view.ends_mm.shape[1]) * view.spacing_mm[2]
    level = _sheared(view, slopes[1 - view.axis]) - slopes[view.axis] * along_bed
    firm = _sheared(view._replace(ends_mm=np.where(view.firm, view.ends_mm, np.nan)), slopes[1 - view.axis])
    firm -= slopes[view.axis] * along_bed
    outward = 1.0 if view.end else -1.0
    at, farthest = _over_slices(np.nanmedian, firm), outward * _over_slices(np.nanmax, outward * level)
    middle = view.middle_mm[view.axis] - slopes[view.axis] * view.middle_mm[2]
    drawn = (np.abs(firm - at[:, None]) <= view.near_mm).mean(axis=1) >= DRAWN_FRACTION
    drawn &= outward * at > outward * middle
    return _Bed(at, farthest, drawn, slopes, float(drawn.sum() * view.spacing_mm[1 - view.axis]))


def _over_slices(measure: Callable[..., Floats], ends_mm: Floats) -> Floats:
    """Median or the like of every line of sight that ends anywhere; NaN for others."""
    known = np.isfinite(ends_mm).any(axis=1)
    found = np.full(len(ends_mm), np.nan)
    found[known] = measure(ends_mm[known], axis=1)
    return found


def _sheared(view: _Ends, across_slope: float) -> Floats:
    """Ends (n, nz) of the lines of sight that move with the bed across their direction."""
    across_mm, step_mm = float(view.spacing_mm[1 - view.axis]), float(view.spacing_mm[2])
    lines = np.arange(len(view.ends_mm)) * across_mm
    columns = [
        np.interp(lines + across_slope * k * step_mm, lines, column, left=np.nan, right=np.nan)
        for k, column in enumerate(view.ends_mm.T)
    ]
    return np.stack(columns, axis=1)


def _commonest_slope(ends_mm: Floats, step_mm: float) -> float:
    """The slope along the bed that most lines of sight have between slices half the image apart."""
    lag = ends_mm.shape[1] // 2
    slopes = (ends_mm[:, lag:] - ends_mm[:, :-lag]) / (lag * step_mm)
    slopes = np.sort(slopes[np.isfinite(slopes)])
    if len(slopes) == 0:
        return 0.0
    window = 2.0 * DRAWN_MM / (lag * step_mm)
    counts = np.searchsorted(slopes, slopes + window, side="right") - np.arange(len(slopes))
    first = int(np.argmax(counts))
    return float(np.median(slopes[first : first + counts[first]]))


def _side(view: _Ends, bed: _Bed, table: bool) -> DrawnSide | None:
    """The line from the first run of drawn lines of sight to the last; between runs the outermost end counts."""
    along_mm, across_mm, step_mm = (float(view.spacing_mm[axis]) for axis in (view.axis, 1 - view.axis, 2))
    run = max(1, int(RUN_MM / across_mm))
    runs = scipy.ndimage.binary_opening(scipy.ndimage.binary_closing(bed.drawn, np.ones(3)), np.ones(run))
    if not runs.any():
        return None
    first, last = np.flatnonzero(runs)[[0, -1]]
    across = np.arange(first, last + 1)
    at = np.where(bed.drawn, bed.at, bed.farthest)[across]
    known = np.isfinite(at)
    along = np.interp(across, across[known], at[known]) / along_mm
    slope = (bed.slopes[1 - view.axis] * step_mm / across_mm, bed.slopes[view.axis] * step_mm / along_mm)
    middle_mm = view.middle_mm[1 - view.axis] - bed.slopes[1 - view.axis] * view.middle_mm[2]
    whole = table and bool(first * across_mm <= middle_mm <= last * across_mm)
    return DrawnSide(view.axis, view.end, across.astype(float), along, slope, bed.width_mm, whole)
