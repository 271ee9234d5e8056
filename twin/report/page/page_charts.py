"""The page's charts of a rehearsal over time, as plotly figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go

MOST_STRUCTURES = 6
"""Curves of clearance: so many of the nearest structures; the table has the rest."""

MOST_POINTS = 600

NAMED_PHASE = 0.07
"""Share of the time that a phase must last to carry its name; shorter ones would overlap."""


def rehearsal_charts(rehearsal: Any, keep_away: frozenset[str]) -> dict[str, Any]:
    """Two figures as plain values: ``distance`` (tip to target) and ``clearance`` (needle to structures)."""
    every = max(1, len(rehearsal.times_s) // MOST_POINTS)
    times = rehearsal.times_s[::every]
    away = np.linalg.norm(rehearsal.tip_true_ct[::every] - rehearsal.target_true_ct, axis=1)
    distance = go.Figure(
        data=[go.Scatter(x=times, y=np.round(away, 3), mode="lines", name="tip to target", line={"color": "#00684a"})],
        layout=_layout("true tip to true target, mm"),
    )
    for phase, start, length in _phases(rehearsal):
        words = phase if length > NAMED_PHASE * rehearsal.times_s[-1] else ""
        distance.add_vline(x=start, line={"color": "#999999", "width": 1, "dash": "dot"}, annotation_text=words)
    names = [name for name in rehearsal.clearance_mm if name in keep_away]
    nearest = sorted(names, key=lambda n: float(np.min(rehearsal.clearance_mm[n], initial=np.inf)))
    curves = [
        go.Scatter(
            x=rehearsal.clearance_times_s,
            y=np.round(rehearsal.clearance_mm[name], 2),
            mode="lines",
            name=name.replace("_", " "),
        )
        for name in nearest[:MOST_STRUCTURES]
    ]
    clearance = go.Figure(data=curves, layout=_layout("true needle to true structure, mm"))
    clearance.add_hline(y=0, line={"color": "#d6001e", "width": 1})
    return {"distance": dict(distance.to_plotly_json()), "clearance": dict(clearance.to_plotly_json())}


def _phases(rehearsal: Any) -> list[tuple[str, float, float]]:
    """Name, start and length of each phase, s."""
    phase, times = rehearsal.phase, rehearsal.times_s
    starts = np.concatenate([[0], np.flatnonzero(phase[1:] != phase[:-1]) + 1])
    ends = np.append(starts[1:], len(times) - 1)
    return [(str(phase[i]), float(times[i]), float(times[j] - times[i])) for i, j in zip(starts, ends, strict=True)]


def _layout(title: str) -> dict[str, Any]:
    return {
        "height": 330,
        "margin": {"l": 55, "r": 15, "t": 46, "b": 45},
        "xaxis": {"title": {"text": "time, s"}},
        "yaxis": {"title": {"text": title}, "rangemode": "tozero"},
        "legend": {"orientation": "h", "y": 1.22},
        "hovermode": "x unified",
        "plot_bgcolor": "#fbfbfc",
        "paper_bgcolor": "#ffffff",
    }
