"""What else would be safe: with less assumed beyond the image, and with a shorter needle of the catalogue."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.beyond_image import BEYOND_IMAGE, beyond_images
from puncture_twin.planning.base.findings import Finding, Severity
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import Directions
from puncture_twin.planning.clearance.engine import ClearanceEngine
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.reach.standoff import axis_lengths, own_paths
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.organs import organ_candidates
from puncture_twin.planning.search.selection.windows import find_windows


def alternatives(case: Case, anatomy: Anatomy, engine: ClearanceEngine, found: Candidates) -> Iterator[Finding]:
    """What else would be safe for the organs; ``found`` are the case's directions, ranked."""
    more = hangs_on_beyond(case, anatomy, found)
    if more:
        said = f"{more} more directions would be safe for the organs with [ct] beyond_mm = 0"
        yield Finding("hangs_on_beyond_image", Severity.NOTE, said, {"directions": more})
    if case.needle.lengths_mm:
        yield _catalogue(case, anatomy, engine, found)


def hangs_on_beyond(case: Case, anatomy: Anatomy, found: Candidates) -> int:
    """How many directions are kept from being safe by that alone by which a body is wider beyond its image."""
    clearance, named = found.clearance, found.verdict.structure == BEYOND_IMAGE
    others = ~np.isnan(clearance.margins) & (np.array(clearance.structures) != BEYOND_IMAGE)
    rows = np.flatnonzero(named & (clearance.distance[:, others] >= clearance.margins[others]).all(axis=1))
    if not len(rows) or case.ct.beyond_mm == 0.0:
        return 0
    narrow = replace(case, ct=replace(case.ct, beyond_mm=0.0))
    (solid,), outward = beyond_images(narrow, anatomy.skin, anatomy.scan).structures, found.outward_ct[rows]
    lengths = axis_lengths(case, [solid], own_paths(case, anatomy.skin, outward))
    axes = FastEngine([solid.mesh]).measure(case.target_ct, outward, lengths, shown=False)
    return int((axes.distance >= case.needle.radius_mm + solid.margin_mm).sum())


def _catalogue(case: Case, anatomy: Anatomy, engine: ClearanceEngine, found: Candidates) -> Finding:
    """How many directions are safe with each needle, and the shortest that fits the best path of each window."""
    directions = Directions(found.theta, found.beta, found.outward_ct, found.grid)
    safe = {
        length: organ_candidates(replace(case, needle=case.needle.of_length(length)), anatomy, engine, directions).safe
        for length in sorted(case.needle.lengths_mm)
    }
    said = ", ".join(f"{int(rows.sum())} with {length:g} mm" for length, rows in safe.items())
    best = [window.best for window in find_windows(found).windows]
    shortest = [next((length for length, rows in safe.items() if rows[row]), np.nan) for row in best]
    fits = ", ".join(f"{length:g} mm" for length in shortest)
    numbers = {"lengths_mm": list(safe), "safe": [float(rows.sum()) for rows in safe.values()], "shortest_mm": shortest}
    said += f"; the shortest that fits the best path of each window: {fits or 'none'}"
    return Finding("needle_catalogue", Severity.NOTE, f"needles, safe for the organs: {said}", numbers)
