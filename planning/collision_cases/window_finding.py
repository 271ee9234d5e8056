"""The window that holds a direction, against a ``[[window]]`` table."""

from __future__ import annotations

from collections.abc import Iterator
from decimal import ROUND_FLOOR

from puncture_twin.planning.collision_cases.checks_file import WindowSection
from puncture_twin.planning.collision_cases.finding import Difference, Finding, NewNumber
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.explain import reason_text
from puncture_twin.planning.search.selection.windows import Windows, find_windows, nearest_row

DIGIT_SQUARE_DEG = 1.0
"""To which a rewritten area is rounded."""

MOST_SHOWN = 6
"""Windows."""


def window_finding(window: WindowSection, direction: Candidates, search: Candidates) -> Finding:
    """What of a window is not as expected.

    Args:
        window: What is expected.
        direction: The direction alone, checked.
        search: The search of the case's grid.
    """
    windows = find_windows(search)
    differences = tuple(_differences(window, direction, search, windows))
    return Finding(differences, tuple(_listed(search, windows))) if differences else Finding()


def _differences(
    window: WindowSection, direction: Candidates, search: Candidates, windows: Windows
) -> Iterator[Difference]:
    if not direction.safe[0]:
        yield Difference(f"the direction is rejected: {reason_text(direction, 0)}")
        return
    row = nearest_row(search, direction.outward_ct[0])
    if row is None:
        yield Difference("the direction is safe, but lies beyond the grid that the case searches")
    elif not search.safe[row]:
        yield Difference(f"the nearest direction of the grid, {_angles(search, row)}: {reason_text(search, row)}")
    else:
        yield from _too_small(window, windows, int(windows.of_row[row]))


def _too_small(window: WindowSection, windows: Windows, number: int) -> Iterator[Difference]:
    want, got = window.min_square_deg, windows.windows[number - 1].square_deg
    if not got >= want:
        line = f"window {number} that holds it: expected at least {want:g} square degrees, found {got:.1f}"
        yield Difference(line, NewNumber(("min_square_deg",), got, DIGIT_SQUARE_DEG, ROUND_FLOOR))


def _listed(search: Candidates, windows: Windows) -> Iterator[str]:
    yield f"windows: {len(windows.windows)}"
    for one in windows.windows[:MOST_SHOWN]:
        yield f"  {one.number}: {one.square_deg:.1f} square degrees, best at {_angles(search, one.best)}"


def _angles(found: Candidates, row: int) -> str:
    at = found.at(row)
    return f"theta {at['theta_deg']:g} deg, beta {at['beta_deg']:g} deg"
