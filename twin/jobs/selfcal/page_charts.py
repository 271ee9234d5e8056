"""The page's charts of a self-calibration, as plotly figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.puncture import Puncture

COLOURS = ("#0072b2", "#e69f00", "#009e73")
"""Okabe and Ito's blue, orange, green."""

SET_ASIDE = "#d6001e"


def residual_charts(found: Calibration, recording: Recording) -> dict[str, Any]:
    """``residuals``: each pose's three components in the image frame; ``in_image``: the same, v over u."""
    turned = np.einsum("nji,nj->ni", recording.A[:, :3, :3] @ found.X[:3, :3], found.residuals)
    aside = np.isin(recording.names, found.outliers)
    used = list(np.flatnonzero(~aside))
    by_pose = go.Figure(layout=_layout("pose", "residual, mm"))
    names = np.array(recording.names)
    for axis, label in enumerate(("u, along the face", "v, into the depth", "across the slice")):
        marks = {"color": COLOURS[axis], "size": 6}
        by_pose.add_scatter(x=names[used], y=_mm(turned[used, axis]), mode="markers", name=label, marker=marks)
    in_image = go.Figure(layout=_layout("residual along u, mm", "residual along v, mm"))
    marks = {"color": COLOURS[0], "size": 7}
    in_image.add_scatter(x=_mm(turned[used, 0]), y=_mm(turned[used, 1]), mode="markers", name="used", marker=marks)
    if aside.any():
        marks = {"color": SET_ASIDE, "size": 8, "symbol": "x"}
        for axis in range(3):
            first = {"name": "set aside", "showlegend": axis == 0, "marker": marks, "mode": "markers"}
            by_pose.add_scatter(x=names[aside], y=_mm(turned[aside, axis]), **first)
        in_image.add_scatter(
            x=_mm(turned[aside, 0]), y=_mm(turned[aside, 1]), mode="markers", name="set aside", marker=marks
        )
    in_image.update_yaxes(scaleanchor="x")
    by_pose.update_xaxes(type="category")
    return {"residuals": _plain(by_pose), "in_image": _plain(in_image)}


def puncture_chart(reached: Sequence[Puncture]) -> dict[str, Any]:
    """Error of every target, in the order reached, beside what calibration and reading let expect."""
    figure = go.Figure(layout=_layout("target", "true tip to true target, mm"))
    x = np.arange(1, len(reached) + 1)
    parts = (("distance", "error_mm", COLOURS[0]), ("across the needle", "lateral_mm", COLOURS[2]))
    for label, key, colour in parts:
        y = _mm(np.array([getattr(one, key) for one in reached]))
        figure.add_scatter(x=x, y=y, mode="markers", name=label, marker={"color": colour, "size": 7})
    expected = _mm(np.array([one.expected_mm for one in reached]))
    line = {"color": "#5b616b", "dash": "dash"}
    figure.add_scatter(x=x, y=expected, mode="lines", name="expected (rms): calibration and reading", line=line)
    figure.update_yaxes(rangemode="tozero")
    return _plain(figure)


def _mm(values: Any) -> Any:
    return np.round(values, 3)


def _plain(figure: go.Figure) -> dict[str, Any]:
    return dict(figure.to_plotly_json())


def _layout(x: str, y: str) -> dict[str, Any]:
    return {
        "height": 360,
        "margin": {"l": 60, "r": 15, "t": 20, "b": 45},
        "xaxis": {"title": {"text": x}},
        "yaxis": {"title": {"text": y}, "zeroline": True, "zerolinecolor": "#999999"},
        "legend": {"orientation": "h", "y": 1.16},
        "plot_bgcolor": "#fbfbfc",
        "paper_bgcolor": "#ffffff",
    }
