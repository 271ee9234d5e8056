"""The search's result on disk: ``placements.csv`` for a table, ``place.json`` with everything."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.place.estimate import ReachEstimate
from puncture_twin.planning.place.mounts import mount_lines
from puncture_twin.planning.place.search import PlaceSearch, RatedPlacement

PLACE_VERSION = 1
"""Version of ``place.json``'s layout."""

COLUMNS = (
    *("rank", "placement", "along_mm", "across_mm", "height_mm", "share", "held", "asked", "margin", "home_contact"),
    *("base_x_mm", "base_y_mm", "base_z_mm"),
)
"""Of ``placements.csv``; the base's coordinates are in the case's space."""

EXPECTED = "expected_error_mm"
"""A further column where the case declares errors and has markers."""


def placement_rows(found: PlaceSearch) -> list[dict[str, Any]]:
    """One row a checked placement, best first, rank 1; the case's own comes last, without a rank."""
    rows = [_row(rank, one) for rank, one in enumerate(found.rated, start=1)]
    return rows if found.own is None else [*rows, _row(None, found.own)]


def _row(rank: int | None, one: RatedPlacement) -> dict[str, Any]:
    along, across, height = (None, None, None) if one.site is None else one.site.position
    values = (rank, one.name, along, across, height, one.verdict.fraction, one.verdict.reached, one.verdict.count)
    rest = (one.verdict.margin, one.verdict.home_contact, *one.mount.position_mm)
    row = dict(zip(COLUMNS, (*values, *rest), strict=True))
    return row if one.expected_mm is None else {**row, EXPECTED: round(one.expected_mm, 4)}


def _estimate(estimate: ReachEstimate) -> dict[str, float]:
    return {
        "reach": estimate.reach,
        "room": estimate.unobstructed,
        "share": estimate.fraction,
        "margin": estimate.margin,
    }


def place_document(found: PlaceSearch, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Everything as plain values: mm; fractions and margins 0..1."""
    rows = placement_rows(found)
    for row, one in zip(rows, (*found.rated, *((found.own,) if found.own else ())), strict=True):
        row["mount"] = {key: list(value) for key, value in one.mount.model_dump().items()}
        row["reasons"] = dict(one.verdict.reasons)
        row["estimate"] = None if one.estimate is None else _estimate(one.estimate)
    best = found.rated[0] if found.rated else None
    return {
        "version": PLACE_VERSION,
        **provenance,
        "T_ct_bed": np.asarray(found.T_ct_bed).tolist(),
        "sites": {"coarse": len(found.coarse), "refined": found.refined, "judged": len(found.rated)},
        "possible_share": found.possible,
        "placements": rows,
        "mount_lines": None if best is None else mount_lines(best.mount),
    }


def write_placements(found: PlaceSearch, path: Path) -> None:
    """Write the table as CSV, whole or not at all."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        rows = placement_rows(found)
        writer = csv.DictWriter(stream, (*COLUMNS, *([EXPECTED] if any(EXPECTED in row for row in rows) else [])))
        writer.writeheader()
        writer.writerows(rows)


def write_place_document(document: Mapping[str, Any], path: Path) -> None:
    """Write the document as JSON, whole or not at all."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
