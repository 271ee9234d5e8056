"""What a body lies on: tables, cradles, boards and pads, touching it or not, and what of them the image does not show.

A table has one section, drawn along the bed; a patient has not. Seen from its far side it ends at one line in most
slices, or along a hand's breadth. Where it touches a body as dense as itself and is wider, its thickness is seen beside
the body, and it is cut off there. A body that has one section at all four sides is no table, but a phantom.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.cut_ends import SIDES
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.geometry.parts import ends_of, middle_of, parts_of

DRAWN_MM, DRAWN_FRACTION = 0.75, 0.8
"""A line of sight is drawn where the surface keeps so near to one line (noise: .3 mm), in so many of the slices."""
DRAWN_WIDTH_MM, RUN_MM = 100.0, 20.0
"""Over so much of its width together, of runs of so much. Of a real abdomen in air no side is drawn over 63 mm."""
ONE_PIECE_MM, ONE_PIECE = 0.25, 0.945
"""Ends of a table keep so near to one another from slice to slice, or thrice their noise, .955 of them and more in
drawn CTs. Of a trunk's straight back it is .80, of flanks .93: a back has no edge, flanks are none beside a table."""
THICKEST_MM, ALIKE_MM = 80.0, 5.0
"""No table is thicker, and beside the body it is as thick to so much all over."""
LEAST_LENGTH_MM, LEAST_SLICES, TILTS_FROM_MM, EDGE_MM = 50.0, 12, 100.0, 30.0
"""A shorter image, or fewer slices of a part of one, may show any body as one section; a bed at an angle needs more.
The edge of a table or cradle is no thicker than the last."""
NEAR_MM, CUT_FRACTION = 60.0, 0.5
"""A face is so near the body: mattresses are at most 50 mm thick, and their foam is hardly seen. It cuts what the body
lies on where something outside of the body ends at it in so many of the slices."""
TOO_SHORT = (
    "the image is only {length:.0f} mm long: a table or cradle that is as dense as the body and touches the body "
    "cannot be distinguished from it"
)
CUT_OFF = (
    "a table {thick:.0f} mm thick touches the body at its {name} side; it is wider than the body, and was removed there"
)
TOUCHES = (
    "the body ends in one section along the bed at its {name} side, over {width:.0f} mm, like a table or board: the "
    "space beyond it does not count as free ([ct] table{overrule})"
)
NO_TABLE, NO_OTHER = ' = "none" if there is none', ' = "present" if what was removed is all that the body lies on'
NOT_TOUCHING = ' = "present" is for a table that touches the body: leave the key out if none does, then no side is one'
PRISM = (
    "the body has a constant section along the bed at all four sides, like a phantom: no side counts as a table "
    '([ct] table = "present" if one touches it; region = "phantom" if it is a whole phantom)'
)

Face = tuple[int, int]
NAMES: dict[Face, str] = {(axis, -end): name for name, (axis, end) in SIDES.items() if axis < 2}
FACES = tuple(NAMES)
"""Array axis and end (0, -1) of a face of the image beside the bed's two ends."""


@dataclass(frozen=True)
class Shown:
    """What a person says of an image: then no rule guesses it."""

    phantom: bool = False
    arms: str | None = None
    table: str | None = None
    whole: bool = False  # the image shows all of it, in air
    about: tuple[float, ...] | None = None
    """Of several phantoms the one that holds this point is meant, LPS mm; the largest where none does."""

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
    """A section, drawn along the bed, at which a body or what it lies on ends."""

    face: Face
    line: Floats
    """Shape (n, nz), by line of sight and slice, where it ends or may end, voxels along the face's axis."""
    lines: Bools  # shape (n,), which lines of sight are those of the table; ``width_mm`` of them are drawn
    slope: float  # how it moves along the face's axis, mm per mm along the bed
    width_mm: float
    firm: bool  # whether the ends keep to one another, as those of a straight flank do less

    def beyond(self, shape: tuple[int, ...]) -> Bools:
        """The voxels of an image beyond the line."""
        axis, end = self.face
        index = np.arange(shape[axis])[:, None, None]
        return np.asarray(np.moveaxis(index > self.line if end else index < self.line, 0, axis))


class Touching(NamedTuple):
    """Voxels of tables that are cut off the body, and sides at which it ends as other tables do."""

    cut_off: Bools
    sides: tuple[TableSide, ...]
    warnings: tuple[str, ...]


def touching_tables(
    hu: NDArray[Any], trunk: Bools, spacing_mm: Floats, shown: Shown = PATIENT, level: float = 0.0
) -> Touching:
    """The tables that hold together with a body (nx, ny, nz), axis 2 along the bed; of a phantom only what is cut off.

    What is denser than a level and connected with the body counts as body, however thin.
    """
    dense = hu > level
    parts = parts_of(dense | trunk)
    drawn = drawn_sides(surface_ends(hu, parts.painted(parts.counts(trunk) > 0), level), trunk, spacing_mm)
    cut_off, left, said = np.zeros(trunk.shape, bool), list[TableSide](), list[str]()
    for side in drawn:
        table = table_beside(dense, side, spacing_mm)
        if table.any():
            deep = table.sum(axis=side.face[0])
            thick_mm = float(np.median(deep[deep > 0]) * spacing_mm[side.face[0]])
            said.append(CUT_OFF.format(thick=thick_mm, name=NAMES[side.face]))
            cut_off |= table
        elif side.firm or not any(one.firm for one in drawn):  # beside a table straight flanks are none
            left.append(side)
    prism, present = len(drawn) == len(FACES), shown.table == "present"
    own = prism or shown.phantom  # its sides are its own, unless a person says that it lies on a table
    if prism and not (shown.phantom or present):
        said.append(PRISM)
    if cut_off.any() if present else own:
        left = []
    overrule = NO_OTHER if cut_off.any() else NOT_TOUCHING if own else NO_TABLE
    said += [TOUCHES.format(name=NAMES[side.face], width=side.width_mm, overrule=overrule) for side in left]
    if (length_mm := trunk.shape[2] * float(spacing_mm[2])) < LEAST_LENGTH_MM:
        said.append(TOO_SHORT.format(length=length_mm))
    return Touching(cut_off, tuple(left), tuple(said))


def table_beside(dense: Bools, side: TableSide, spacing_mm: Floats) -> Bools:
    """The table on which a body lies, shape of ``dense``, below the body as thick as beside it; nothing if not seen."""
    axis, end = side.face
    table, along_mm = np.zeros(dense.shape, bool), float(spacing_mm[axis])
    view, out = (np.moveaxis(one, axis, 0)[:: -1 if end else 1] for one in (dense, table))  # as it is seen
    steps = np.arange(int(THICKEST_MM / along_mm) + 2)[:, None, None]
    at = np.minimum(view.argmax(axis=0) + steps, len(view) - 1)
    solid = np.logical_and.accumulate(np.take_along_axis(view, at, axis=0), axis=0)
    thick_mm = solid.sum(axis=0) * along_mm
    middle = np.median(thick_mm, axis=1)
    alike = np.abs(thick_mm - middle[:, None]) <= max(ALIKE_MM / 2.0, 1.5 * along_mm)
    seen = side.lines & (alike.mean(axis=1) >= DRAWN_FRACTION) & (middle > 0.0) & (middle <= THICKEST_MM)
    run, lines = max(2, int(RUN_MM / spacing_mm[1 - axis])), np.flatnonzero(side.lines)
    ends = [some[seen[some]] for some in (lines[:run], lines[-run:])]
    lies_on = (~seen[lines]).any() or (thick_mm[lines] > THICKEST_MM).any()  # a head, an arm: in some slices
    if not lies_on or any(len(one) < DRAWN_FRACTION * run or np.ptp(middle[one]) > 2 * ALIKE_MM for one in ends):
        return table
    most_mm = max(float(np.median(middle[one])) for one in ends) + ALIKE_MM
    table_mm = np.interp(np.arange(len(seen)), np.flatnonzero(seen), middle[seen], left=0.0, right=0.0)
    solid &= steps * along_mm < np.minimum(table_mm, most_mm)[:, None] - 1e-6
    np.put_along_axis(out, at, solid | np.take_along_axis(out, at, axis=0), axis=0)
    return table


def surface_ends(hu: NDArray[Any], body: Bools, level: float = 0.0) -> dict[Face, Floats]:
    """By face, where a body's surface is at a level of values (nx, ny, nz), voxels along its axis, shape (n, nz).

    NaN where there is no body, and where the image cuts it.
    """
    surfaces = {}
    for (axis, end), at in zip(FACES, ends_of(body), strict=True):
        values, out = np.moveaxis(hu, axis, 0), 1 if end else -1
        known = (at >= 0) & (at != (len(values) - 1 if end else 0))
        at = np.where(known, at, 1)
        within, outside = (np.take_along_axis(values, k[None], axis=0)[0] - float(level) for k in (at, at + out))
        crossed = known & (within > 0.0) & (outside < 0.0)
        fraction = np.divide(within, within - outside, out=np.full(within.shape, 0.5), where=crossed)
        surfaces[axis, end] = np.where(known, at + out * fraction, np.nan)
    return surfaces


def drawn_sides(
    surfaces: dict[Face, Floats], body: Bools, spacing_mm: Floats, *, touching: bool = True
) -> tuple[TableSide, ...]:
    """The sides at which `surface_ends` have one section along the bed, beyond the middle of a body (nx, ny, nz).

    Either the body itself ends there (``touching``), or what is apart from it: that is known to a voxel.
    """
    if body.shape[2] * spacing_mm[2] < LEAST_LENGTH_MM:
        return ()
    sides, middle = list[TableSide | None](), middle_of(body)
    for face, ends in surfaces.items():
        side_of = partial(_side, face, ends, spacing_mm, middle, touching)
        parts = map(side_of, _parts(ends, spacing_mm[face[0]], spacing_mm[1 - face[0]], float(spacing_mm[2])))
        sides.append(side_of() or max(filter(None, parts), key=lambda side: side.width_mm, default=None))
    return tuple(filter(None, sides))


def _side(
    face: Face, ends: Floats, spacing_mm: Floats, middle: Floats, touching: bool, part: slice = slice(None)
) -> TableSide | None:
    """The table's side in some of the slices, if there is one beyond the middle of the body, voxels.

    By where lines of sight end (n, nz), voxels, NaN for nothing that counts. Where the body itself ends there, nothing
    is free beyond both edges either.
    """
    axis, end = face
    along_mm, across_mm, step_mm = spacing_mm[[axis, 1 - axis, 2]].tolist()
    near_mm, outward = DRAWN_MM if touching else max(DRAWN_MM, along_mm), 1.0 if end else -1.0
    along_bed, ends_mm = np.arange(ends.shape[1]) * step_mm, ends[:, part] * along_mm
    slope = _slopes(ends_mm, step_mm, across_mm)
    level_mm = ends_mm - slope[:, None] * along_bed[part]
    at = _medians(level_mm)
    off_mm = level_mm - at[:, None]
    drawn = (np.abs(off_mm) <= near_mm).mean(axis=1) >= DRAWN_FRACTION
    drawn &= outward * (at + slope * middle[2] * step_mm) > outward * middle[axis] * along_mm
    width_mm, closed = float(drawn.sum() * across_mm), scipy.ndimage.binary_closing(drawn, np.ones(3))
    runs = scipy.ndimage.binary_opening(closed, np.ones(max(1, int(RUN_MM / across_mm))))
    first, last = np.flatnonzero(runs)[[0, -1]] if runs.any() else (np.inf, -np.inf)
    if width_mm < DRAWN_WIDTH_MM or not first <= middle[1 - axis] <= last:
        return None
    farthest = outward * np.fmax.reduce(outward * level_mm, axis=1)
    at, across = np.where(drawn, at, farthest), np.arange(len(at))
    within = (across >= first) & (across <= last)
    known = np.isfinite(at) & within
    line = np.interp(across, across[known], at[known])
    firm = not touching
    if touching:  # a table's ends keep to one another but for the noise of all; those of a straight back do so less
        noise_mm = float(np.nanmedian(np.abs(np.diff(ends_mm, 2, axis=1))))
        apart_mm = np.abs(off_mm[drawn] - _medians(off_mm[drawn].T))
        alike = apart_mm <= max(ONE_PIECE_MM, 3.0 * noise_mm)
        firm = bool(alike.sum() >= ONE_PIECE * np.isfinite(apart_mm).sum())
    line[~within] -= outward * ((EDGE_MM if firm else 0.0) if touching else -np.inf)
    steady = np.interp(across, across[drawn], slope[drawn])[:, None] * along_bed
    lines, of_bed = runs | (known & drawn), float(np.median(slope[drawn]))
    return TableSide(face, (line[:, None] + steady) / along_mm, lines, of_bed, width_mm, firm)


def _parts(ends: Floats, along_mm: float, across_mm: float, step_mm: float) -> Iterator[slice]:
    """The parts of the bed between slices at which something as wide as a table begins or ends."""
    ends_mm = np.nan_to_num(ends, nan=-1e6) * along_mm
    moved = np.abs(ends_mm[:, 2:] - ends_mm[:, :-2]) >= ALIKE_MM
    whole = np.pad(moved.sum(axis=0) * across_mm < DRAWN_WIDTH_MM, 1, constant_values=True)
    for (part,) in scipy.ndimage.find_objects(scipy.ndimage.label(whole)[0]):
        if max(LEAST_SLICES, LEAST_LENGTH_MM / step_mm) <= part.stop - part.start < ends.shape[1]:
            yield part


def _slopes(ends_mm: Floats, step_mm: float, across_mm: float) -> Floats:
    """How the ends (n, nz) of lines of sight move along the bed, shape (n,), mm per mm; steep after a tilted gantry."""
    lag = ends_mm.shape[1] // 2
    if ends_mm.shape[1] * step_mm < TILTS_FROM_MM:
        return np.zeros(len(ends_mm))
    slope = np.nan_to_num(_medians(ends_mm[:, lag:] - ends_mm[:, :-lag]) / (lag * step_mm))
    return scipy.ndimage.median_filter(slope, 2 * round(RUN_MM / across_mm) + 1)


def _medians(values: Floats) -> Floats:
    """Of each row (n, k) the median of those that are known, shape (n,), the lower one of two; NaN without any."""
    ordered, count = np.sort(values, axis=1), np.isfinite(values).sum(axis=1)  # NaN comes last
    return np.asarray(ordered[np.arange(len(values)), np.maximum(count - 1, 0) // 2])


class Support(NamedTuple):
    """Where a body lies: the far side of what is apart from it, whether any is seen, faces with the unknown beyond."""

    drawn: tuple[TableSide, ...]
    seen: bool
    open_faces: tuple[Face, ...]


def find_support(
    outside: Bools, body: Bools, spacing_mm: Floats, touching: Sequence[TableSide] = (), shown: Shown = PATIENT
) -> Support:
    """The support that the body lies on, and the faces of the image beyond which nothing is known.

    ``outside`` was scanned, lies outside of the body (nx, ny, nz), and is not air; tables that touch the body are not
    in it.
    """
    if shown.table == "none":
        return Support((), False, ())
    surfaces = {}
    for face, first, own in zip(FACES, ends_of(outside | body), ends_of(outside), strict=True):
        surfaces[face] = np.where((first == own) & (own >= 0), first + (0.5 if face[1] else -0.5), np.nan)
    sides = drawn_sides(surfaces, body, spacing_mm, touching=False)
    drawn = tuple(sorted(sides, key=lambda side: side.width_mm)[-1:])
    supports = {side.face[0] for side in (*drawn, *touching)}
    arms = shown.limbs and bool(body[:, :, [0, -1]].any())  # of a body that ends in the image its arms are there too

    def hides(face: Face) -> bool:
        axis, occupied = face[0], np.flatnonzero(body.any(axis=(1 - face[0], 2)))
        gap_mm = float(spacing_mm[axis] * (body.shape[axis] - 1 - occupied[-1] if face[1] else occupied[0]))
        arm = arms and (shown.arms != "present" or gap_mm == 0.0)  # else they lie in the image
        if gap_mm > NEAR_MM or not (axis == 1 or arm):
            return False
        if not supports:
            return not shown.phantom
        cuts = outside.take(face[1], axis=axis).any(axis=0).mean() >= CUT_FRACTION  # arms may lie on it beside the body
        return bool(supports - {axis} and gap_mm > 0.0 and cuts)

    return Support(drawn, bool(supports), tuple(face for face in FACES if hides(face)))


def support_warnings(seen: bool, open_faces: Sequence[Face]) -> Iterator[str]:
    """What the image does not show of what lies beside the body, and the key that says that nothing lies there."""
    bed, arms = "the CT does not show the support of the body", "the CT may not show all of the arms"
    asked = ((1, bed.replace("the support", "all of the support"), "table"), (0, arms, "arms"))
    for axis, said, key in asked if seen else ((None, bed, "table"),):
        names = " and ".join(NAMES[face] for face in open_faces if axis in {face[0], None})
        if names:
            yield (
                f"{said}: the space beyond its {names} face, within {NEAR_MM:g} mm of the body, is unknown_region "
                f'(outside_body; [ct] {key} = "none" if nothing is there)'
            )
    if not seen and not open_faces:
        yield "the CT shows no support below the body; the space beyond its faces counts as air"
