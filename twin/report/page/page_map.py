"""The page's map: a picture of the cap, and the rows behind it for the pointer to read."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from puncture_twin.planning.base.reasons import REASON_TEXT, Reason
from puncture_twin.planning.search.candidates import NOT_SEEN, Candidates, Pick
from puncture_twin.planning.search.windows import MOST_WINDOWS, find_windows
from puncture_twin.twin.report.map.map_raster import PIXELS as FINE, MapRaster, map_raster, shown_front
from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.page.template import image_address
from puncture_twin.twin.report.palette import PNG_LEVEL, reason_of

PIXELS = FINE // 2
"""Side of the map on the page, CSS pixels; the picture is twice as fine for sharp screens."""

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


def map_data(case: Any, candidates: Candidates, pick: Pick | None, raster: MapRaster | None = None) -> dict[str, Any]:
    """What the page's script needs to draw the map and answer the pointer; plain values, degrees and mm.

    The pixel-to-row table is stored run by run, row after row of the picture: ``runs`` is [candidate, length, ...],
    candidate -1 outside the grid.

    Args:
        case: The case.
        candidates: The search's rows.
        pick: What is shown as chosen.
        raster: The map's pixels where somebody has them already.
    """
    view, windows = map_view(case, candidates), find_windows(candidates)
    raster = map_raster(candidates, view) if raster is None else raster
    rows = map_raster_rows(raster.rows[::2, ::2])
    structures = sorted({*map(str, candidates.verdict.named), *candidates.clearance.structures})
    front = shown_front(candidates, view)
    reasons = [str(r) for r in np.unique(candidates.verdict.reason)]
    return {
        "size": PIXELS,
        "image": image_address(Image.fromarray(raster.rgba), PNG_LEVEL),
        "runs": rows,
        "theta_max_deg": round(float(np.degrees(view.theta_max)), 4),
        "turn_deg": round(float(np.degrees(view.turn)), 4),
        "rim": [{"text": label.text, "angle_deg": float(np.degrees(label.angle))} for label in view.rim],
        "centre": view.centre,
        "structures": structures,
        "reasons": [REASON_TEXT[reason_of(r)] for r in reasons],
        "safe": candidates.safe_text,
        "arm": candidates.arm_note,
        "codes": [r or "safe" for r in reasons],
        "details": [DETAIL_UNITS.get(reason_of(r), ("", "")) for r in reasons],
        **_directions(candidates, structures, reasons),
        "outcome": "plan" if candidates.arm_checked else "check",
        "file": _typed(case.path),
        "picked": -1 if pick is None or pick.candidates is not candidates else pick.row,
        "best": [window.best for window in windows.windows[:MOST_WINDOWS]],
        "window": windows.of_row.tolist(),
        "safe_cone": _rounded(np.degrees(candidates.safe_cone), 1),
        "chosen": None if pick is None else pick.candidates.at(pick.row),
        "pareto": front.rows.tolist(),
        "front": front.text,
        "not_seen": NOT_SEEN,
        **_chances(candidates),
    }


def _directions(candidates: Candidates, structures: list[str], reasons: list[str]) -> dict[str, Any]:
    """What is said of each direction, a list a column; structures, reasons and sentences by their places."""
    index = {name: i for i, name in enumerate(structures)}
    nearest, amounts = _nearest(candidates)
    sentences, sentence = np.unique(candidates.verdict.detail, return_inverse=True)
    return {
        "theta": _rounded(np.degrees(candidates.theta), 3),
        "beta": _rounded(np.degrees(candidates.beta), 3),
        "reason": [reasons.index(str(r)) for r in candidates.verdict.reason],
        "structure": [index[str(s)] for s in candidates.verdict.named],
        "sentences": [str(s) for s in sentences],
        "sentence": sentence.tolist(),
        "depth": _rounded(candidates.verdict.depth, 1),
        "amount": _rounded(candidates.verdict.amount, 2),
        "nearest": [index[name] if name else -1 for name in nearest],
        "clearance": _rounded(amounts, 2),
        "path": _rounded(candidates.path.length, 1),
        "skin_angle": _rounded(np.degrees(candidates.path.skin_angle), 1),
        "rank": candidates.ranking.rank.tolist(),
        "reachable": candidates.arm.reachable.tolist(),
        "outward": _rounded(candidates.outward_ct.ravel(), 5),
    }


def _typed(path: Path) -> str:
    """A file as a shell takes it, from whatever folder; a link keeps its name, for its folder is what counts."""
    return shlex.quote(str(path.parent.resolve() / path.name))


def _chances(candidates: Candidates) -> dict[str, Any]:
    """Chances for the pointer to read; nothing of a case without declared errors."""
    found = candidates.chances
    if found is None:
        return {}
    chances = {"p_hit": _rounded(found.hit, 9), "p_touch_any": _rounded(found.touch_any, 9)}
    return {**chances, "touch_refined": found.refined.tolist()}


def map_raster_rows(rows: Any) -> list[int]:
    """Run lengths of a table of integers, flattened: [value, length, value, length, ...]."""
    flat = np.asarray(rows).ravel()
    starts = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1])
    lengths = np.diff(np.append(starts, len(flat)))
    runs: list[int] = np.stack([flat[starts], lengths], axis=1).ravel().tolist()
    return runs


def _nearest(candidates: Candidates) -> tuple[list[str], Any]:
    """For every row the nearest structure that demands a margin, and its clearance."""
    demanding = np.flatnonzero(np.isfinite(candidates.clearance.margins))
    if len(demanding) == 0:
        return [""] * len(candidates), np.full(len(candidates), np.nan)
    clearance = candidates.clearance
    columns = demanding[np.argmin(np.nan_to_num(clearance.distance[:, demanding], nan=np.inf), axis=1)]
    nearest = clearance.distance[np.arange(len(candidates)), columns]
    return [clearance.structures[column] for column in columns], nearest


def _rounded(values: Any, digits: int) -> list[float | None]:
    """JSON-ready numbers; what is not finite becomes null."""
    values = np.asarray(values, dtype=float)
    rounded: list[float | None] = np.round(values, digits).tolist()
    for i in np.flatnonzero(~np.isfinite(values)):
        rounded[i] = None
    return rounded
