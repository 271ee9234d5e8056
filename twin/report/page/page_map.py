"""The page's map: a picture of the cap, and the rows behind it for the pointer to read."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image

from puncture_twin.planning.base.arrays import Ints
from puncture_twin.planning.base.reasons import REASON_TEXT, Reason
from puncture_twin.planning.search.candidates import NOT_SEEN, Candidates, Pick
from puncture_twin.planning.search.constraints import closest_miss
from puncture_twin.planning.search.windows import MOST_WINDOWS
from puncture_twin.twin.report.map.map_raster import PIXELS as FINE, MapRaster, map_raster, shown_front
from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.page.template import image_address
from puncture_twin.twin.report.palette import PNG_LEVEL
from puncture_twin.twin.report.slices.panel import MOST_NEAR, NEAR_MM

PIXELS = FINE // 2  # side of the map on the page, CSS pixels; the picture is twice as fine for sharp screens

DETAIL_UNITS = {
    Reason.TOO_CLOSE: ("clearance", "mm"),
    Reason.UNKNOWN_REGION: ("clearance", "mm"),
    Reason.TOO_LONG: ("path", "mm"),
    Reason.SKIN_ANGLE: ("skin angle", "°"),
    Reason.UNSAFE_WHEN_BREATHING: ("clearance", "mm"),
    Reason.NEEDLE_BENDS: ("clearance", "mm"),
    Reason.HIT_UNLIKELY: ("chance to hit", " "),
    Reason.TOUCH_LIKELY: ("chance to touch", " "),
}
"""What ``Candidates.verdict.amount`` is, by reason."""


def picked_row(candidates: Candidates, pick: Pick | None) -> int:
    """The row of a pick; one beyond the last for one that the search has no row of, -1 without any."""
    if pick is None:
        return -1
    if pick.candidates is candidates:
        return pick.row
    theta, beta = pick.candidates.theta[pick.row], pick.candidates.beta[pick.row]
    same = np.flatnonzero(np.isclose(candidates.theta, theta) & np.isclose(candidates.beta, beta))
    return int(same[0]) if len(same) else len(candidates)


def map_data(case: Any, candidates: Candidates, pick: Pick | None, raster: MapRaster | None = None) -> dict[str, Any]:
    """What the page's script needs to draw the map and answer the pointer; plain values, degrees and mm.

    The pixel-to-row table is stored run by run, row after row of the picture: ``runs`` is [candidate, length, ...],
    candidate -1 outside the grid. A pick that the search has no row of is one row more.

    Args:
        raster: The map's pixels where somebody has them already.
    """
    view, windows = map_view(case, candidates), candidates.windows
    raster = map_raster(candidates, view) if raster is None else raster
    front, picked = shown_front(candidates, view), picked_row(candidates, pick)
    parts = [(candidates, np.arange(len(candidates)), windows.of_row)]
    if pick is not None and picked == len(candidates):
        parts.append((pick.candidates, np.array([pick.row]), np.zeros(len(pick.candidates), int)))
    return {
        "size": PIXELS,
        "image": image_address(Image.fromarray(raster.rgba), PNG_LEVEL),
        "runs": map_raster_rows(raster.rows[::2, ::2]),
        "searched": len(candidates),
        "frame": np.round(np.asarray(case.T_ct_entry)[:3, :3], 9).ravel().tolist(),
        "theta_max_deg": round(float(np.degrees(view.theta_max)), 4),
        "turn_deg": round(float(np.degrees(view.turn)), 4),
        "rim": [{"text": label.text, "angle_deg": float(np.degrees(label.angle))} for label in view.rim],
        "centre": view.centre,
        "safe": candidates.safe_text,
        "arm": candidates.arm_note,
        **_directions(parts),
        "outcome": "plan" if candidates.arm_checked else "check",
        "file": shlex.quote(str(case.path.parent.resolve() / case.path.name)),  # a link keeps its name
        "space": str(case.space),
        "picked": picked,
        "first": picked if picked >= 0 else closest_miss(candidates) or 0,
        "best": [window.best for window in windows.windows[:MOST_WINDOWS]],
        "pareto": front.rows.tolist(),
        "front": front.text,
        "not_seen": NOT_SEEN,
    }


def _directions(parts: Sequence[tuple[Candidates, Ints, Ints]]) -> dict[str, Any]:
    """What is said of each direction, a list a column; structures, reasons and sentences by their places."""
    verdicts = [found.verdict.of(rows) for found, rows, _ in parts]
    named = {str(name) for one in verdicts for name in one.named}
    structures = sorted(named.union(*(found.clearance.structures for found, *_ in parts)))
    reasons = sorted({str(reason) for one in verdicts for reason in one.reason})
    sentences = sorted({str(text) for one in verdicts for text in one.detail})
    columns = [_columns(*part, structures, reasons, sentences) for part in parts]
    return {
        "structures": structures,
        "reasons": [REASON_TEXT[Reason(r)] for r in reasons],
        "codes": [r or "safe" for r in reasons],
        "details": [DETAIL_UNITS.get(Reason(r), ("", "")) for r in reasons],
        "sentences": sentences,
        **{name: [value for one in columns for value in one[name]] for name in columns[0]},
    }


def _columns(
    found: Candidates, rows: Ints, window: Ints, structures: list[str], reasons: list[str], sentences: list[str]
) -> dict[str, list[Any]]:
    verdict, path, arm = found.verdict.of(rows), found.path, found.arm
    index = {name: i for i, name in enumerate(structures)}
    columns = {
        "theta": _rounded(np.degrees(found.theta[rows]), 5),
        "beta": _rounded(np.degrees(found.beta[rows]), 5),
        "reason": [reasons.index(str(r)) for r in verdict.reason],
        "structure": [index[str(s)] for s in verdict.named],
        "sentence": [sentences.index(str(text)) for text in verdict.detail],
        "depth": _rounded(verdict.depth, 1),
        "amount": _rounded(verdict.amount, 2),
        "near": _near(found, rows, index),
        "path": _rounded(path.length[rows], 3),
        "skin_angle": _rounded(np.degrees(path.skin_angle[rows]), 1),
        "rank": found.ranking.rank[rows].tolist(),
        "window": window[rows].tolist(),
        "safe_cone": _rounded(np.degrees(found.safe_cone[rows]), 1),
        "reachable": arm.reachable[rows].tolist(),
        "outward": _rounded(found.outward_ct[rows].ravel(), 6),
    }
    chances = found.chances
    if chances is not None:  # what is not there is not spoken of
        columns |= {
            "p_hit": _rounded(chances.hit[rows], 9),
            "p_touch_any": _rounded(chances.touch_any[rows], 9),
            "touch_refined": chances.refined[rows].tolist(),
        }
    return columns


def _near(found: Candidates, rows: Ints, index: dict[str, int]) -> list[list[float]]:
    """As `Subject.near`, of every row: place, mm, place, mm, and so on; at least the nearest, however far it is."""
    demanding = np.flatnonzero(np.isfinite(found.clearance.margins))
    distance = found.clearance.distance[np.ix_(rows, demanding)]
    order = np.argsort(distance, axis=1, kind="stable")[:, :MOST_NEAR]
    nearest = np.round(np.take_along_axis(distance, order, axis=1), 3)
    kept = np.isfinite(nearest) & ((nearest < NEAR_MM) | (np.arange(order.shape[1]) == 0))
    places = np.array([index[name] for name in found.clearance.structures], int)[demanding]
    return [
        [value for k in np.flatnonzero(keep) for value in (int(places[one[k]]), float(mm[k]))]
        for one, mm, keep in zip(order, nearest, kept, strict=True)
    ]


def map_raster_rows(rows: Any) -> list[int]:
    """Run lengths of a table of integers, flattened: [value, length, value, length, ...]."""
    flat = np.asarray(rows).ravel()
    starts = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1])
    lengths = np.diff(np.append(starts, len(flat)))
    runs: list[int] = np.stack([flat[starts], lengths], axis=1).ravel().tolist()
    return runs


def _rounded(values: Any, digits: int) -> list[float | None]:
    values = np.asarray(values, dtype=float)
    rounded: list[float | None] = np.round(values, digits).tolist()
    for i in np.flatnonzero(~np.isfinite(values)):
        rounded[i] = None
    return rounded
