"""Tables, cradles and pads that a body lies on, touching it or not, and the parts of them that the image does not show.

A scanner's table has the same section in every slice; a patient has not. Seen from its far side it is one line, drawn
along the bed, which may run at an angle to the slices' axis (a tilted gantry). Nothing comes from beyond that line.
Where the table touches a body as dense as itself and is wider, its thickness is seen beside the body, and it is cut off
there: what is left is the body. A board that touches along a part of the image ends it in a plane: no skin is flat over
a hand's breadth, unless it is pressed flat.

A body that has one section at all four sides is no table, whatever it lies on: it is a phantom, or a part of one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.geometry.parts import ends_of, middle_of, parts_of

FLAT_MM = 1.0
"""A side is flat where it keeps within this of one plane; noise moves the surface of a 5 mm voxel by some 0.2 mm."""
FLAT_WIDTH_MM = 100.0
"""Over so much of its width, in enough slices. A round back with a radius of 1.2 m is as flat."""
FLAT_LENGTH_MM = 50.0
"""Enough are half of the slices, or all along so much of the bed: a board may be shorter than the image."""
BEYOND_FRACTION = 0.01
"""Of a side's surface: more of it beyond the plane, and the plane is a step, such as a table's top beside the body."""
SIDES = {(0, 0): "right", (0, -1): "left", (1, 0): "front", (1, -1): "back"}
"""Names of the sides by array axis and end, axes running to the left, back and head."""
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
THICKEST_MM, ALIKE_MM = 80.0, 5.0
"""No table is thicker, and beside the body it is as thick to so much all over."""
LEAST_LENGTH_MM = 50.0
"""In a shorter image every body is nearly one section along the bed: tables that touch it are not told."""
TILTS_FROM_MM = 100.0
"""From this length of the image on, a bed at an angle to the slices' axis is looked for too."""
TILTS_RAD = np.radians(np.linspace(-4.0, 4.0, 17))
"""Of the bed against the slices' axis, across the lines of sight; along them any angle is found."""
TILT_SAMPLING_MM = 4.0, 8.0
"""Spacing of lines of sight and slices by which such an angle is sought; smoothed along the bed they hold all of it."""
NEARLY = 0.95
"""A tilted bed explains more than a straight one only if more than this is drawn."""
EDGE_MM = 40.0
"""The edge of a table or cradle is no thicker."""
TOO_SHORT = (
    "the image is only {length:.0f} mm long: a curved table or cradle that is as dense as the body and touches it "
    "cannot be told from the body"
)
CUT_OFF = (
    "a table {thick:.0f} mm thick touches the body at its {name} side; it is wider than the body, and was cut off there"
)
PRISM = (
    "the body has one section along the bed at all four sides, as a phantom has: none of them counts as a table "
    '([ct] table = "present" says that one is; region = "phantom", if it is one, that it is whole)'
)
NEAR_MM = 60.0
"""A face is near the body up to this distance. Mattresses are at most some 50 mm thick; of their foam a CT shows
nothing that is denser than air."""
CUT_FRACTION = 0.5
"""A face cuts what the body lies on where something outside of the body ends at it in so many of the slices."""

Side = tuple[int, int]
"""Axis and end of a face, as `SIDES` names them."""
FACES: tuple[Side, ...] = tuple(itertools.product((0, 1), (0, -1)))
"""The faces of an image beside the bed's two ends."""


@dataclass(frozen=True)
class Shown:
    """Statements of a person about what an image shows: then no rule guesses it.

    Attributes:
        phantom: It shows a phantom: no limb, and what holds together is the phantom.
        arms, table: ``none`` or ``present``; None where nobody said so.
        whole: The image shows all of it, in air.
    """

    phantom: bool = False
    arms: str | None = None
    table: str | None = None
    whole: bool = False

    @property
    def limbs(self) -> bool:
        """Whether limbs are looked for."""
        return self.arms != "none" and not self.phantom

    @property
    def tables(self) -> bool:
        """Whether tables are looked for."""
        return self.table == "present" or (self.table is None and not (self.phantom and self.whole))


PATIENT = Shown()


class TableSide(NamedTuple):
    """One line, drawn along the bed, at which a body or what it lies on ends.

    Attributes:
        axis: 0 or 1, running to the left or to the back: along the lines of sight.
        end: 0 or -1, the side of the body: at the axis' low or high end.
        across: Shape (n,), where the lines of sight cross the other axis in slice 0, ascending, voxels.
        along: Shape (n,), where each meets the line in slice 0, voxels along ``axis``.
        slope: How far ``across`` and ``along`` move from slice to slice, voxels.
        width_mm: How much of the width is drawn.
        whole: Whether this is the table's far side, so that its edges are where the line ends; else it is a part of a
            table that is seen from the side.
        edge_mm: How far before the line its edges count as table, beyond both of its ends; None where they do not.
    """

    axis: int
    end: int
    across: Floats
    along: Floats
    slope: tuple[float, float]
    width_mm: float
    whole: bool
    edge_mm: float | None = None

    @property
    def face(self) -> Side:
        """Axis and end."""
        return self.axis, self.end

    @property
    def warning(self) -> str:
        """One sentence."""
        flat = np.ptp(self.along) == 0.0
        how = "is flat" if flat else "ends in one section along the bed"
        like = "it is pressed on something there, or is one with it" if flat else "as a table or cradle does"
        return (
            f"the body {how} at its {SIDES[self.face]} side, over {self.width_mm:.0f} mm: {like}; nothing beyond it "
            'counts as free ([ct] table = "none" where there is none)'
        )


class Touching(NamedTuple):
    """The objects that touch the body.

    Attributes:
        cut_off: Shape of the body, what of it is a table whose thickness is seen beside the body.
        sides: At which the body ends as a table does, which could not be cut off.
        warnings: One sentence each.
    """

    cut_off: Bools
    sides: tuple[TableSide, ...]
    warnings: tuple[str, ...]


def touching_tables(
    hu: NDArray[np.floating], trunk: Bools, spacing_mm: Floats, shown: Shown = PATIENT, level: float = 0.0
) -> Touching:
    """The tables that hold together with a body.

    Args:
        hu: Shape (nx, ny, nz), axis 2 along the bed.
        trunk: Same shape; what is as dense and connected with it counts too, however thin.
        spacing_mm: Shape (3,).
        shown: What a person says: a phantom may end in one section, and only what can be cut off it is a table, unless
            there is said to be one.
        level: Where the body's surface is, of the values.
    """
    dense = hu > level
    drawn = drawn_sides(hu, trunk, spacing_mm, level)
    cut_off, said, cut = np.zeros(trunk.shape, bool), list[str](), set[Side]()
    for side in (side for side in drawn if side.whole):
        table = table_beside(dense, side, spacing_mm)
        if table.any():
            thick_mm = float(np.median(table.sum(axis=side.axis)[table.any(axis=side.axis)])) * spacing_mm[side.axis]
            said.append(CUT_OFF.format(thick=thick_mm, name=SIDES[side.face]))
            cut_off |= table
            cut.add(side.face)
    if cut:
        trunk = trunk & ~cut_off
        hu = hu.copy()
        hu[cut_off] = level - np.abs(hu[cut_off] - level)
        drawn = drawn_sides(hu, trunk, spacing_mm, level)
    flat = flat_sides(hu, trunk, spacing_mm, level)
    prism = {side.face for side in (*flat, *drawn) if side.whole} == set(FACES)
    if (shown.phantom or prism) and shown.table != "present":
        return Touching(cut_off, (), tuple(said) if shown.phantom else (*said, PRISM))
    named = {side.face for side in flat}
    left = [side for side in drawn if side.face not in cut]  # at a table's face the body is pressed into its section
    left = left if not cut or any(side.whole for side in left) else []
    said += [side.warning for side in (*flat, *(one for one in left if one.whole and one.face not in named))]
    length_mm = trunk.shape[2] * float(spacing_mm[2])
    if length_mm < LEAST_LENGTH_MM:
        said.append(TOO_SHORT.format(length=length_mm))
    return Touching(cut_off, (*flat, *left), tuple(said))


def table_beside(dense: Bools, side: TableSide, spacing_mm: Floats) -> Bools:
    """The table on which a body lies, as thick as it is seen beside the body; nothing where it is not seen there.

    Below the body its thickness is that between the two places beside the body where it is seen.

    Args:
        dense: Shape (nx, ny, nz).
        side: Its far side.
        spacing_mm: Shape (3,).
    """
    along_mm, across_mm = (float(spacing_mm[axis]) for axis in (side.axis, 1 - side.axis))
    found, view = np.zeros(dense.shape, bool), np.moveaxis(dense, side.axis, 0)
    first = ends_of(dense)[FACES.index(side.face)]
    inward = np.arange(int(THICKEST_MM / along_mm) + 2)
    index = first + (-1 if side.end else 1) * inward[:, None, None]
    seen = (first >= 0) & (index >= 0) & (index < len(view))
    seen &= np.take_along_axis(view, np.clip(index, 0, len(view) - 1), axis=0)
    lines = np.unique(np.clip(np.rint(side.across).astype(int), 0, view.shape[1] - 1))
    thick_mm = np.where(seen.all(axis=0), np.inf, np.argmin(seen, axis=0) * along_mm)[lines]
    middle = np.median(thick_mm, axis=1)
    alike_mm = max(ALIKE_MM / 2.0, 1.5 * along_mm)
    alike = (thick_mm >= middle[:, None] - alike_mm) & (thick_mm <= middle[:, None] + alike_mm)
    open_to_body = (alike.mean(axis=1) >= DRAWN_FRACTION) & (middle <= THICKEST_MM)
    at = np.where(open_to_body, middle, np.nan)
    run = max(2, int(RUN_MM / across_mm))
    edges = [_seen_edge(at, run), _seen_edge(at[::-1], run)]
    if not all(edges) or open_to_body.all():
        return found
    table_mm = np.interp(np.arange(view.shape[1]), lines[open_to_body], middle[open_to_body], left=0.0, right=0.0)
    table_mm = np.minimum(table_mm, max(edges) + ALIKE_MM)
    deep, line, k = np.nonzero(seen & (inward[:, None, None] * along_mm < table_mm[:, None] - 1e-6))
    np.moveaxis(found, side.axis, 0)[index[deep, line, k], line, k] = True
    return found


def _seen_edge(thick_mm: Floats, run: int) -> float:
    """How thick a table is at its first edge, where it is seen in a run of lines and is as thick all along it; or 0."""
    seen = np.flatnonzero(np.isfinite(thick_mm))
    first = thick_mm[seen[0] : seen[0] + run] if len(seen) else thick_mm[:0]
    known = first[np.isfinite(first)]
    enough = len(known) >= 0.8 * run and float(np.ptp(known)) <= 2.0 * ALIKE_MM
    return float(np.median(known)) if enough else 0.0


def flat_sides(hu: NDArray[np.floating], body: Bools, spacing_mm: Floats, level: float = 0.0) -> tuple[TableSide, ...]:
    """The sides at which a body ends in a plane across its image's axes; arguments as of `touching_tables`."""
    return tuple(_flat_sides(surface_ends(hu, body, level), body, spacing_mm))


def _flat_sides(surfaces: dict[Side, Floats], body: Bools, spacing_mm: Floats) -> Iterator[TableSide]:
    for (axis, end), ends in surfaces.items():
        step_mm, across_mm = float(spacing_mm[axis]), float(spacing_mm[1 - axis])
        plane = _commonest(ends[np.isfinite(ends)], FLAT_MM / step_mm)
        outward_mm = (ends - plane) * (step_mm if end else -step_mm)
        width_mm = _flat_width((np.abs(outward_mm) <= FLAT_MM / 2).sum(axis=0), float(spacing_mm[2])) * across_mm
        if width_mm >= FLAT_WIDTH_MM and np.mean(outward_mm[np.isfinite(ends)] > FLAT_MM) < BEYOND_FRACTION:
            lines = np.arange(body.shape[1 - axis], dtype=float)
            yield TableSide(axis, end, lines, np.full(len(lines), plane), (0.0, 0.0), width_mm, True, 0.0)


def surface_ends(hu: NDArray[np.floating], body: Bools, level: float = 0.0) -> dict[Side, Floats]:
    """Where a body's surface is along each line of an axis, seen from each end of it.

    Args:
        hu: Shape (nx, ny, nz), axis 2 along the bed.
        body: Same shape.
        level: Where the surface is, of the values.

    Returns:
        By face, voxels along its axis, shape (n, nz); NaN where there is no body, and where the image cuts it.
    """
    surfaces = {}
    for (axis, end), at in zip(FACES, ends_of(body), strict=True):
        values, out = np.moveaxis(hu, axis, 0), 1 if end else -1
        known = (at >= 0) & (at != (len(values) - 1 if end else 0))
        at = np.where(known, at, 1)
        within, beside = (np.take_along_axis(values, k[None], axis=0)[0] - float(level) for k in (at, at + out))
        crossed = known & (within > 0.0) & (beside < 0.0)
        share = np.divide(within, within - beside, out=np.full(within.shape, 0.5), where=crossed)
        surfaces[axis, end] = np.where(known, at + out * share, np.nan)
    return surfaces


def _flat_width(flat: NDArray[np.integer], step_mm: float) -> float:
    """How many lines are flat in half of the slices, or along `FLAT_LENGTH_MM` without a gap, whichever is more.

    Args:
        flat: Shape (nz,), the flat lines of each slice.
        step_mm: From slice to slice.
    """
    run = min(len(flat), int(np.ceil(FLAT_LENGTH_MM / step_mm)))
    least = np.lib.stride_tricks.sliding_window_view(flat, run).min(axis=1)
    return max(float(np.median(flat)), float(least.max()))


def _commonest(values: Floats, window: float) -> float:
    """The middle of the window that holds most values; NaN for none."""
    if len(values) == 0:
        return float("nan")
    values = np.sort(values)
    counts = np.searchsorted(values, values + window, side="right") - np.arange(len(values))
    return float(values[np.argmax(counts)] + window / 2)


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
        """Length of the image along the bed, mm."""
        return float(self.ends_mm.shape[1] * self.spacing_mm[2])

    def sampled(self) -> _Ends:
        """Some of its lines of sight in some of its slices."""
        axes = [1 - self.axis, 2]
        step = np.maximum(1, (TILT_SAMPLING_MM / self.spacing_mm[axes]).astype(int))
        spacing_mm, some = self.spacing_mm.copy(), np.s_[:: step[0], :: step[1]]
        spacing_mm[axes] *= step
        return self._replace(ends_mm=self.ends_mm[some], firm=self.firm[some], spacing_mm=spacing_mm)


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


def drawn_sides(
    hu: NDArray[np.floating], trunk: Bools, spacing_mm: Floats, level: float = 0.0
) -> tuple[TableSide, ...]:
    """The sides at which a body, or what holds together with it, ends in one section along the bed; edges count.

    Arguments are those of `touching_tables`.
    """
    if trunk.shape[2] * spacing_mm[2] < LEAST_LENGTH_MM:
        return ()
    parts = parts_of((hu > level) | trunk)
    surfaces = surface_ends(hu, parts.painted(parts.counts(trunk) > 0), level)
    sides = _sides(_views(surfaces, trunk, spacing_mm))
    return tuple(side._replace(edge_mm=EDGE_MM) if side.whole else side for side in sides)


def support_side(outside: Bools, body: Bools, spacing_mm: Floats) -> TableSide | None:
    """The side at which something outside of the body ends in one section along the bed: what it lies on.

    None where there is nothing like it; of several the widest. Between its parts, where the body lies before it, the
    line runs where the body ends farthest out.

    Args:
        outside: Shape (nx, ny, nz), what was scanned, lies outside of the body and is not air.
        body: Same shape.
        spacing_mm: Shape (3,).
    """
    surfaces, own = {}, {}
    for face, first, outer in zip(FACES, ends_of(outside | body), ends_of(outside), strict=True):
        surfaces[face] = np.where(first < 0, np.nan, first + (0.5 if face[1] else -0.5))  # the voxel's outer face
        own[face] = outer == first
    sides = [side for side in _sides(_views(surfaces, body, spacing_mm, own)) if side.whole]
    return max(sides, key=lambda side: side.width_mm, default=None)


def _views(
    surfaces: dict[Side, Floats], body: Bools, spacing_mm: Floats, own: dict[Side, Bools] | None = None
) -> list[_Ends]:
    """Surfaces as seen from each side; where ``own`` says which ends count, they are known to a voxel."""
    views, middle_mm = [], middle_of(body) * spacing_mm
    for (axis, end), ends in surfaces.items():
        ends_mm = _smooth(ends * spacing_mm[axis], float(spacing_mm[2]))
        firm = np.isfinite(ends_mm) & (True if own is None else own[axis, end])
        near_mm = DRAWN_MM if own is None else max(DRAWN_MM, float(spacing_mm[axis]))
        views.append(_Ends(axis, end, ends_mm, firm, spacing_mm, near_mm, middle_mm))
    return views


def _sides(views: Sequence[_Ends]) -> tuple[TableSide, ...]:
    if views[0].length_mm < LEAST_LENGTH_MM:
        return ()
    slopes = _direction([view.sampled() for view in views])
    beds = [_bed_at(view, slopes) for view in views]
    tables = [bed.width_mm >= DRAWN_WIDTH_MM for bed in beds]
    sides = []
    for view, bed, table in zip(views, beds, tables, strict=True):
        next_to = any(tables[i] for i, other in enumerate(views) if other.axis != view.axis)
        if table or (next_to and bed.width_mm >= BESIDE_WIDTH_MM):
            sides.append(_side(view, bed, table))
    return tuple(side for side in sides if side is not None)


def _direction(views: Sequence[_Ends]) -> tuple[float, float]:
    """A bed's slopes under which most is drawn at one side; of those under which nearly most is, the least."""
    widths = {(0.0, 0.0): max(_bed_at(view, (0.0, 0.0)).width_mm for view in views)}
    for view in views if views[0].length_mm >= TILTS_FROM_MM else ():
        for across in np.tan(TILTS_RAD):
            along = _commonest_slope(_sheared(view, across), float(view.spacing_mm[2]))
            tilt = (along, float(across)) if view.axis == 0 else (float(across), along)
            widths[tilt] = max(widths.get(tilt, 0.0), _bed_at(view, tilt).width_mm)
    most = max(widths.values())
    return min((tilt for tilt, width in widths.items() if width >= NEARLY * most), key=lambda tilt: np.hypot(*tilt))


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
    at, farthest = _medians(firm), outward * np.fmax.reduce(outward * level, axis=1)
    middle = view.middle_mm[view.axis] - slopes[view.axis] * view.middle_mm[2]
    drawn = (np.abs(firm - at[:, None]) <= view.near_mm).mean(axis=1) >= DRAWN_FRACTION
    drawn &= outward * at > outward * middle
    return _Bed(at, farthest, drawn, slopes, float(drawn.sum() * view.spacing_mm[1 - view.axis]))


def _medians(ends_mm: Floats) -> Floats:
    """Median of each line of sight's end over the slices in which it ends anywhere; NaN where it never does."""
    ends_mm, rows = np.sort(ends_mm, axis=1), np.arange(len(ends_mm))  # NaN comes last
    count = np.isfinite(ends_mm).sum(axis=1)
    return np.asarray((ends_mm[rows, (count - 1) // 2] + ends_mm[rows, count // 2 - (count == 0)]) / 2.0)


def _sheared(view: _Ends, across_slope: float) -> Floats:
    """Ends (n, nz) of the lines of sight that move with the bed across their direction."""
    count, slices = view.ends_mm.shape
    shift = across_slope * np.arange(slices) * view.spacing_mm[2] / view.spacing_mm[1 - view.axis]
    at = np.arange(count)[:, None] + shift
    low = np.floor(at).astype(int)
    between = at - low
    below, above = (
        np.take_along_axis(view.ends_mm, np.clip(k, 0, count - 1), axis=0) for k in (low, low + (between > 0.0))
    )
    found = below + between * (above - below)
    return np.asarray(np.where((at >= 0.0) & (at <= count - 1), found, np.nan))


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


def _side(view: _Ends, bed: _Bed, table: bool) -> TableSide | None:
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
    return TableSide(view.axis, view.end, across.astype(float), along, slope, bed.width_mm, whole)


class Support(NamedTuple):
    """What a body lies on.

    Attributes:
        drawn: Its far side, where it does not hold together with the body; one or none.
        seen: Whether the image shows any, there or as one with the body.
        open_faces: Faces beyond which nothing is known, apart from those that are known to cut a body which lies on
            something that is seen.
    """

    drawn: tuple[TableSide, ...]
    seen: bool
    open_faces: tuple[Side, ...]


def find_support(
    outside: Bools, body: Bools, spacing_mm: Floats, touching: Sequence[TableSide] = (), shown: Shown = PATIENT
) -> Support:
    """Find what the body lies on, and the faces of the image beyond which nothing is known.

    Args:
        outside: Shape (nx, ny, nz), what was scanned, lies outside of the body and is not air; axis 2 along the bed.
        body: Same shape.
        spacing_mm: Shape (3,).
        touching: Tables that hold together with the body, so that they are not outside of it.
        shown: What a person says: a phantom lies on nothing where nothing is seen.
    """
    if shown.table == "none":
        return Support((), False, ())
    side = support_side(outside, body, spacing_mm)
    drawn = () if side is None else (side,)
    supports = {side.face for side in (*drawn, *touching) if side.whole}
    cut = [face for face in FACES if _cuts(outside, face) and any(face[0] != axis for axis, _ in supports)]
    faces = cut if supports else FACES
    arms = shown.limbs and bool(body[:, :, [0, -1]].any())  # of a body that ends in the image its arms are there too
    faces = [face for face in faces if face[0] == 1 or arms]  # at its sides only an arm may lie unseen
    gaps = {face: _gap_mm(body, face, spacing_mm) for face in faces}
    near = tuple(face for face, gap in gaps.items() if gap <= NEAR_MM and not (supports and gap == 0.0))
    return Support(drawn, bool(supports), () if shown.phantom and not supports else near)


def support_warnings(seen: bool, open_faces: Sequence[Side]) -> Iterator[str]:
    """What the image does not show of what lies beside the body, and what says so where nothing lies there.

    Args:
        seen: Whether it shows what the body lies on.
        open_faces: The faces beyond which nothing is known.
    """
    bed = f"the CT does not show {'all of ' if seen else ''}what the body lies on"
    sides = ((1, bed, "[ct] table"), (0, "the CT need not show all of the arms", "[ct] arms"))
    for axis, said, key in sides:
        names = " and ".join(SIDES[face] for face in open_faces if face[0] == axis)
        if names:
            yield (
                f"{said}: what is beyond its {names} face, within {NEAR_MM:g} mm of the body, is unknown_region "
                f'(outside_body; {key} = "none" where there is nothing)'
            )
    if not seen and not open_faces:
        yield "the CT shows nothing that the body lies on; what is beyond its faces counts as air"


def _cuts(outside: Bools, face: Side) -> bool:
    axis, end = face
    return bool(outside.take(end, axis=axis).any(axis=0).mean() >= CUT_FRACTION)


def _gap_mm(body: Bools, face: Side, spacing_mm: Floats) -> float:
    """Distance from the body to a face of the image, mm; 0 where the face cuts it."""
    axis, end = face
    occupied = np.flatnonzero(body.any(axis=(1 - axis, 2)))
    voxels = occupied[0] if end == 0 else body.shape[axis] - 1 - occupied[-1]
    return float(voxels * spacing_mm[axis])
