"""Windows: connected sets of safe directions, each with its area and its best candidate."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.text import Facts, Shown
from puncture_twin.planning.case.entry import AngleGrid

SQUARE_DEGREES = float(np.degrees(1.0) ** 2)
"""Square degrees in a steradian."""
MOST_WINDOWS = 10
"""Windows that are listed to people."""


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
        """One sentence on how much is safe."""
        one = self.largest
        if one is None:
            return "no window: nothing is safe"
        return f"the largest window: {one.text}, {one.number} of {len(self.windows)}"

    def _facts(self) -> Facts:
        yield "count", str(len(self.windows))
        yield "largest", "–" if self.largest is None else self.largest.text

    def rows(self, number: int) -> Ints:
        """The candidates of one window."""
        return np.flatnonzero(self.of_row == number)


def find_windows(candidates: Any) -> Windows:
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


def nearest_row(candidates: Any, outward_ct: Floats) -> int | None:
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
