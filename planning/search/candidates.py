"""The result of a search: one row per direction, with its verdict and the reason for each refusal."""

from __future__ import annotations

import pathlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Columns, Floats, Ints, Ints32, Texts
from puncture_twin.planning.base.errors import Finding, refuse, require_extra
from puncture_twin.planning.base.files import check_writable
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.polar_map import NO_MAP, Entry, PolarMap, Sectors, polar_map
from puncture_twin.planning.base.provenance import read_inputs
from puncture_twin.planning.base.reasons import REASON_COLOURS, REASON_TEXT, SAFE, Reason
from puncture_twin.planning.base.text import Facts, Shown, brief, plural
from puncture_twin.planning.case.entry import AngleGrid

ARM_CHECKED = "checked"
"""``Candidates.arm_note`` where "safe" includes that the arm can reach and insert along the candidate."""
CONE_OF_GRID, CONE_CERTIFIED = "grid", "certificate"
"""Where a safe cone comes from: the directions of the search, or the proof of all between them."""
NOT_SEEN = "not seen: image or mesh ends"
"""Named in place of the skin for a path that leaves the scanned region."""
SQUARE_DEGREES = float(np.degrees(1.0) ** 2)
"""Square degrees in a steradian."""
MOST_WINDOWS = 10
"""Windows that are listed to people."""
ANGLE_DIGITS = 9
"""Decimals of an angle in degrees: 59.99999999999999 is 60; 1e-9 degrees move no needle by a nanometre."""


@dataclass(frozen=True, eq=False)
class Verdict(Columns):
    """The first constraint that each candidate breaks."""

    reason: Texts
    """Shape (n,), values of `Reason`; the empty string where the candidate is safe."""
    structure: Texts
    """Shape (n,), the structure (or arm body and what it touches) that the reason names, or ""."""
    depth: Floats
    """Shape (n,), distance from the target along the needle, mm; NaN where it means nothing."""
    amount: Floats
    """Shape (n,), the number that fell short: clearance for ``too_close``, ``needle_bends``, ``unsafe_when_breathing``
    and an ``unknown_region`` of a structure, path length for ``too_long``, degrees for ``skin_angle``, the
    chance for ``hit_unlikely`` and ``touch_likely``; NaN otherwise."""
    detail: Texts
    """Shape (n,), why the arm cannot execute it, in one sentence; "" for the organs' reasons."""

    @property
    def safe(self) -> Bools:
        """Shape (n,), which candidates break none."""
        return self.reason == Reason.NONE.value

    @property
    def not_seen(self) -> Bools:
        """Shape (n,), whether the reason is that the body was not scanned there, and no structure's clearance."""
        return (self.reason == Reason.UNKNOWN_REGION.value) & np.isnan(self.amount)

    @property
    def named(self) -> Texts:
        """Shape (n,), what the reason names, for people: `structure`, and `NOT_SEEN` where nothing was scanned."""
        return np.where(self.not_seen, NOT_SEEN, self.structure)

    def of(self, rows: Ints) -> Verdict:
        """The verdicts of some rows."""
        return Verdict(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def with_rows(self, rows: Ints, **columns: Texts | Floats | str) -> Verdict:
        """The verdicts with some columns of rows (m,) replaced, each by one value or by an array, shape (m,)."""
        arrays = {name: getattr(self, name).copy() for name in columns}
        for name, values in columns.items():
            arrays[name][rows] = values
        return replace(self, **arrays)


@dataclass(frozen=True, eq=False)
class Path(Columns):
    """The path from the skin to the target."""

    entry_ct: Floats
    """Shape (n, 3), where the path crosses the skin, mm; NaN without an entry."""
    length: Floats
    """Shape (n,), target to entry, mm."""
    skin_angle: Floats
    """Shape (n,), between the path and the skin's inward normal, rad; 0 is straight in."""
    tissue: Floats
    """Shape (n,), length of path inside structures that may be crossed, mm."""


@dataclass(frozen=True, eq=False)
class ClearanceColumns(Columns):
    """Clearances of the needle's surface from k structures, mm."""

    structures: tuple[str, ...]
    margins: Floats
    """Shape (k,), what each structure demands; NaN for one that demands nothing."""
    by_structure: Floats
    """Shape (n, k), axis distance minus needle radius."""
    least: Floats
    """Shape (n,), smallest over the structures with a margin."""


@dataclass(frozen=True, eq=False)
class ArmColumns(Columns):
    """Whether and how the arm reaches each candidate."""

    reachable: NDArray[np.int8]
    """Shape (n,), 1 yes, 0 no, -1 not queried."""
    margin: Floats
    """Shape (n,), 0..1 distance from joint limits and singularities; NaN where not queried."""
    q_insertion: Floats
    """Shape (n, 6), the joints that put the tip on the target, rad; NaN where the arm does not reach it."""

    @classmethod
    def unknown(cls, count: int) -> ArmColumns:
        """The columns of ``count`` candidates for which the arm was not queried."""
        return cls(np.full(count, -1, np.int8), np.full(count, np.nan), np.full((count, 6), np.nan))


@dataclass(frozen=True, eq=False)
class Ranking(Columns):
    """The order of the safe candidates."""

    cost: Floats
    """Shape (n,), NaN for rejected candidates."""
    rank: Ints32
    """Shape (n,), 1 is best, 0 for rejected candidates."""
    pareto: Bools
    """Shape (n,), on the Pareto front of the cost's terms."""

    @classmethod
    def none(cls, count: int) -> Ranking:
        """The ranking of ``count`` candidates that are not ranked."""
        return cls(np.full(count, np.nan), np.zeros(count, np.int32), np.zeros(count, bool))


@dataclass(frozen=True, eq=False)
class BreathingColumns(Columns):
    """Verdict over the breath of each candidate that is safe for the organs where the CT shows them."""

    safe_all_phases: Bools
    """Shape (n,), safe for the organs at every phase, if inserted at that phase."""
    worst_phase: Floats
    """Shape (n,), the position s in the gate's window (without a gate: of all) with the least clearance beyond a
    margin; NaN for what was rejected before."""
    clearance: Floats
    """Shape (n,), the least to any structure with a margin, in the window, mm; NaN for what was rejected before."""
    safe_when: str
    """At each phase, or in the gate's window, if inserted then; never that a needle may stay."""


@dataclass(frozen=True, eq=False)
class Chances(Columns):
    """Chances of n candidates and k structures that demand a margin; NaN where nothing was computed."""

    structures: tuple[str, ...]
    hit: Floats  # shape (n,), that the tip is in the target's mesh, or within its radius
    touch: Floats  # shape (n, k), that the needle touches each structure
    margin: Floats  # shape (n, k), that it breaks each structure's margin
    touch_any: Floats  # shape (n,), min(1, sum of touch): never below the truth of what `touch` says
    touch_joint: Floats
    """Shape (n,), that it touches any, all linearised together; of the best candidates alone."""
    lateral_mm: Floats
    """Shape (n,), expected (rms) error of the tip across the needle, target reading included."""
    depth_mm: Floats  # shape (n,), along it
    refined: Bools  # shape (n,), whether touch and margin are line-sampled; else they are of first order

    @classmethod
    def unknown(cls, structures: tuple[str, ...], count: int) -> Chances:
        """The chances of candidates for which nothing was computed."""
        shapes = {"touch": (count, len(structures)), "margin": (count, len(structures))}
        names = {field.name for field in fields(cls)} - {"structures", "refined"}
        blank = {name: np.full(shapes.get(name, (count,)), np.nan) for name in names}
        return cls(structures, refined=np.zeros(count, bool), **blank)

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns of the table of a case that declares errors, each (n,), after all others."""
        kinds = {"touch": self.touch, "margin": self.margin}
        wide = {
            f"p_{kind}_{name}": values[:, at]
            for kind, values in kinds.items()
            for at, name in enumerate(self.structures)
        }
        return {
            "p_hit": self.hit,
            **wide,
            "p_touch_any": self.touch_any,
            "p_touch_joint": self.touch_joint,
            "touch_refined": self.refined,
            "sigma_lateral_mm": self.lateral_mm,
            "sigma_depth_mm": self.depth_mm,
        }

    def with_rows(self, rows: Ints, known: Chances) -> Chances:
        """These chances with those of some candidates replaced."""
        values = {field.name: getattr(self, field.name).copy() for field in fields(self) if field.name != "structures"}
        for name, value in values.items():
            value[rows] = getattr(known, name)
        return Chances(self.structures, **values)


@dataclass(frozen=True, repr=False)
class Window(Shown):
    """One connected set of safe directions."""

    number: int
    """1 for the window that holds the best candidate, then by the rank of each one's best."""
    best: int  # row of its best candidate
    directions: int
    square_deg: float
    entry_cm2: float
    """Area of skin through which its paths enter, cm2."""
    widest_cone: float
    """Largest safe cone of its candidates, rad; NaN where none is known."""

    @property
    def wide_deg(self) -> float:
        """Width of a cone of the same solid angle, degrees."""
        return 2.0 * float(np.degrees(np.arccos(1.0 - self.square_deg / SQUARE_DEGREES / (2.0 * np.pi))))

    @property
    def text(self) -> str:
        """The window's size for a person."""
        return f"{self.entry_cm2:.1f} cm2 on the skin, {self.wide_deg:.0f} deg wide"


@dataclass(frozen=True, eq=False, repr=False)
class Windows(Shown):
    """All windows of a search."""

    of_row: Ints
    """Shape (n,), the number of each candidate's window; 0 for a rejected candidate."""
    windows: tuple[Window, ...]

    def __len__(self) -> int:
        return len(self.windows)

    def __iter__(self) -> Iterator[Window]:
        return iter(self.windows)

    def __getitem__(self, at: int) -> Window:
        return self.windows[at]

    @property
    def largest(self) -> Window | None:
        """The window with the most skin; None where nothing is safe."""
        return max(self.windows, key=lambda one: one.entry_cm2, default=None)

    @property
    def headline(self) -> str:
        """One sentence on the largest window."""
        one = self.largest
        if one is None:
            return "no window: nothing is safe"
        return f"the largest window: {one.text}, {one.number} of {len(self.windows)}"

    def _facts(self) -> Facts:
        yield "count", str(len(self.windows))
        yield "largest", "–" if self.largest is None else self.largest.text

    def rows(self, number: int) -> Ints:
        """Rows of the candidates in one window."""
        return np.flatnonzero(self.of_row == number)


@dataclass(frozen=True, eq=False)
class Candidates(Columns, Shown):
    """Every direction of the grid: n rows in groups of columns; mm, radians, points in the CT frame."""

    theta: Floats  # shape (n,), puncture angle
    beta: Floats  # shape (n,), azimuth
    outward_ct: Floats
    """Shape (n, 3), unit vectors from the target outward."""
    verdict: Verdict
    path: Path
    clearance: ClearanceColumns
    arm: ArmColumns
    ranking: Ranking
    safe_cone: Floats
    """Shape (n,), by how much one may be off in any direction and still be safe for the organs, rad; NaN for rejected
    candidates, and where neither a grid nor a certificate says."""
    arm_note: str = "not checked"
    """`ARM_CHECKED`, or "not checked: " and why: then a safe candidate is safe for the organs alone."""
    chances: Chances | None = None
    """To hit and to touch; None where the case declares no errors."""
    breathing: BreathingColumns | None = None
    """What the breath leaves; None where the case does not declare it."""
    deflection: Floats | None = None
    """Shape (n,), how far the needle may bend on each path, mm, NaN without one; None where the case declares no
    tissue."""
    grid: AngleGrid | None = None
    """The regular grid that the rows are; None for any others."""
    cone_source: str = ""
    """`CONE_OF_GRID` or `CONE_CERTIFIED`; "" where there are no safe cones."""
    findings: tuple[Finding, ...] = ()
    """What else would be safe (`planning.search.context`)."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Case, input hashes, version, seed and step, as plain values; empty of what no case has searched."""

    def __len__(self) -> int:
        return len(self.theta)

    @brief
    def __repr__(self) -> str:
        best = self.best
        at = "" if best is None else f"; best theta {best.theta_deg:g} deg, beta {best.beta_deg:g} deg"
        return f"{plural(len(self), 'direction')}, {int(self.safe.sum()):,} {self.safe_text}{at}; arm {self.arm_note}"

    def _title(self) -> str:
        return f"{len(self):,} candidates, {int(self.safe.sum()):,} {self.safe_text}"

    def _facts(self) -> Facts:
        yield "arm", self.arm_note
        if (best := self.best) is not None:
            yield "best direction", f"θ {best.theta_deg:g}°, β {best.beta_deg:g}°"
            yield "its path, target to skin", f"{self.path.length[best.row]:.1f} mm"
            yield "its least clearance", f"{self.least_clearance[best.row]:.1f} mm"
        for code, count in self.counts().items():
            yield self.safe_text if code == "safe" else REASON_TEXT[Reason(code)], f"{count:,}"

    def _picture(self) -> str:
        return self.plot_map()._repr_html_()

    @property
    def theta_deg(self) -> Floats:
        """Puncture angle, shape (n,), degrees."""
        return np.asarray(np.round(np.degrees(self.theta), ANGLE_DIGITS))

    @property
    def beta_deg(self) -> Floats:
        """Azimuth, shape (n,), degrees."""
        return np.asarray(np.round(np.degrees(self.beta), ANGLE_DIGITS))

    @property
    def safe(self) -> Bools:
        """Which rows are not rejected, shape (n,)."""
        return self.verdict.safe

    @property
    def unseen_air(self) -> Bools:
        """Which rows are rejected for what is unknown outside of the body alone: beyond its skin, shape (n,)."""
        beyond = self.verdict.depth > self.path.length
        return (self.verdict.reason == Reason.UNKNOWN_REGION.value) & beyond

    @property
    def arm_checked(self) -> bool:
        """Whether "safe" includes the arm."""
        return self.arm_note == ARM_CHECKED

    @property
    def safe_text(self) -> str:
        """Text for a safe candidate: never "safe" alone with an unchecked arm, or a breath."""
        safe = "safe" if self.arm_checked else "safe for the organs"
        return safe if self.breathing is None else f"{safe} {self.breathing.safe_when}"

    @property
    def least_clearance(self) -> Floats:
        """Least clearance to a structure with a margin over all checked positions of the breath, shape (n,), mm."""
        if self.breathing is None:
            return self.clearance.least
        return np.asarray(np.fmin(self.clearance.least, self.breathing.clearance))

    @property
    def ranked(self) -> Ints:
        """Row numbers of the safe candidates, best first."""
        rows = np.flatnonzero(self.ranking.rank > 0)
        return rows[np.argsort(self.ranking.rank[rows], kind="stable")]

    @property
    def best(self) -> Pick | None:
        """The best candidate; None where nothing is safe."""
        ranked = self.ranked
        return Pick(self, int(ranked[0])) if len(ranked) else None

    @cached_property
    def windows(self) -> Windows:
        """The connected sets of safe directions, that of the best candidate first."""
        return find_windows(self)

    def to_pandas(self) -> Any:
        """The table that `write` writes, as a pandas DataFrame: a row a direction, mm and degrees.

        Raises:
            InputError: pandas is not installed.
        """
        require_extra("pandas", "to_pandas")
        from puncture_twin.planning.search.table import to_table

        return to_table(self).to_pandas()

    def write(self, folder: pathlib.Path | str) -> pathlib.Path:
        """Write ``candidates.parquet`` as the command ``search`` does: as a set of the folder, with its provenance.

        Raises:
            InputError: A folder that cannot be written to, or that holds another program's file of this name.
        """
        from puncture_twin.planning.search.table import TABLE, write_table

        out = check_writable(folder)
        with writing(out, "search", inputs=read_inputs(self.provenance.get("inputs", [])), names=(TABLE,)) as draft:
            write_table(self, draft.folder / TABLE)
        return out / TABLE

    def plot_map(self) -> PolarMap:
        """The map of the directions by verdict: a picture for a notebook, or to be written; θ outward, β around."""
        if not 0 < len(self) <= MOST_ROWS:
            return NO_MAP
        reasons = [Reason.NONE, *REASON_COLOURS]
        legend = [Entry(self.safe_text, SAFE), *(Entry(REASON_TEXT[r], REASON_COLOURS[r]) for r in reasons[1:])]
        number = {reason.value: row for row, reason in enumerate(reasons)}
        code = np.array([number[str(reason)] for reason in self.verdict.reason])
        azimuth, half = np.mod(self.beta, 2 * np.pi), np.array([-0.5, 0.5])
        steps = _step(self.theta), _step(azimuth)
        theta = np.clip(self.theta[:, None] + half * steps[0], 0.0, np.pi)
        cells = Sectors(theta, azimuth[:, None] + half * steps[1], code)
        return polar_map(cells, legend, min(steps) / 2)  # the cells' edges lie at halves of a step

    def pick(self, row: int) -> Pick:
        """One candidate by its row. Raises InputError: There is no such row."""
        if isinstance(row, bool) or not isinstance(row, int | np.integer) or not 0 <= row < len(self):
            refuse(f"row {row!r}", "pick", f"a row number from 0 to {len(self) - 1}", "out_of_range")
        return Pick(self, int(row))

    def counts(self) -> dict[str, int]:
        """Number of candidates by reason, most frequent first; "safe" among them."""
        counted = Counter(self.verdict.reason.tolist()).most_common()
        return {str(reason) or "safe": count for reason, count in counted}

    def at(self, row: int) -> dict[str, float]:
        """The angles of one row, degrees, rounded to what a person types."""
        return {"theta_deg": float(self.theta_deg[row]), "beta_deg": float(self.beta_deg[row])}


class Pick(NamedTuple):
    """One candidate: a row of a search, or of a check of it alone."""

    candidates: Candidates
    row: int

    @property
    def theta_deg(self) -> float:
        """Puncture angle, degrees."""
        return self.candidates.at(self.row)["theta_deg"]

    @property
    def beta_deg(self) -> float:
        """Azimuth, degrees."""
        return self.candidates.at(self.row)["beta_deg"]


SAME_ANGLE = 1e-7
"""rad: two angles nearer than this are one line of the grid."""
ALONE = np.radians(2.0)
"""rad: how wide a direction is drawn where no other has another angle."""
MOST_ROWS = 200_000
"""Directions that are painted; the table says all that there is to say about more."""


def _step(values: Floats) -> float:
    """The grid's step: the least gap between two of its angles, rad."""
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > SAME_ANGLE]
    return float(gaps.min()) if len(gaps) else ALONE


def find_windows(candidates: Candidates) -> Windows:
    """The windows of ranked `Candidates`; without a grid every candidate is one of its own, without area."""
    label = connected(candidates.grid, candidates.safe)
    ranked = candidates.ranked
    firsts = ranked[np.sort(np.unique(label[ranked], return_index=True)[1])]  # best of each set, by rank
    number = np.zeros(len(candidates), np.int64)
    for one, row in enumerate(firsts, start=1):
        number[(label == label[row]) & candidates.safe] = one
    cell = np.zeros(len(candidates)) if candidates.grid is None else candidates.grid.solid_angle()
    # each cell's skin, mm2: the sphere's patch over the cosine of the skin angle
    skin, windows = cell * candidates.path.length**2 / np.cos(candidates.path.skin_angle), []
    for one, best in enumerate(firsts.tolist(), start=1):
        rows = number == one
        square_deg, entry_cm2 = float(cell[rows].sum()) * SQUARE_DEGREES, float(skin[rows].sum()) / 100.0
        widest = float(np.fmax.reduce(candidates.safe_cone[rows]))
        windows.append(Window(one, best, int(rows.sum()), square_deg, entry_cm2, widest))
    return Windows(number, tuple(windows))


def nearest_row(candidates: Candidates, outward_ct: Floats) -> int | None:
    """Row of the grid nearest to a direction, shape (3,); None where it is beyond the grid by a step."""
    row = int(np.argmax(candidates.outward_ct @ outward_ct))  # largest cosine
    near = candidates.outward_ct[row]
    apart = float(np.arctan2(np.linalg.norm(np.cross(near, outward_ct)), near @ outward_ct))
    return None if candidates.grid is None or apart > candidates.grid.step else row


def connected(grid: AngleGrid | None, safe: Bools) -> Ints:
    """Label of each row's connected set, shape (n,): the least row among neighbouring safe ones.

    A label is a row of the same set. Where neighbours differ, the row that one names takes the other's label if that is
    less, and all rows take the label of the row that they name (Shiloach and Vishkin, J. Algorithms 3, 1982).
    """
    if grid is None:
        return np.arange(len(safe))
    pairs = grid.neighbours()
    one, other = pairs[safe[pairs].all(axis=1)].T
    label: Ints = np.arange(len(safe))
    while not np.array_equal(label[one], label[other]):
        least, ends = np.minimum(label[one], label[other]), (label[one], label[other])
        for end in ends:
            np.minimum.at(label, end, least)
        label = label[label]  # pointer jumping
    return label
