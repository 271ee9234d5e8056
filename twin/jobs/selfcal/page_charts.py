"""The page's charts of a self-calibration, as plotly's script reads them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.puncture import Puncture
from puncture_twin.twin.report.page.page_charts import curve

COLOURS = ("#0072b2", "#e69f00", "#009e73")
"""Okabe and Ito's blue, orange, green."""

SET_ASIDE = "#d6001e"

IMAGE_AXES = ("residual along u, mm", "residual along v, mm")


def residual_charts(found: Calibration, recording: Recording) -> dict[str, Any]:
    """``residuals``: each pose's three components in the image frame; ``in_image``: the same, v over u."""
    rotated = np.einsum("nji,nj->ni", recording.A[:, :3, :3] @ found.X[:3, :3], found.residuals)
    aside = np.isin(recording.names, found.outliers)
    used = list(np.flatnonzero(~aside))
    names = np.array(recording.names)
    by_pose, in_image = [], []
    for axis, label in enumerate(("u, along the face", "v, into the depth", "across the slice")):
        marks = {"color": COLOURS[axis], "size": 6}
        by_pose.append(curve(label, names[used], _mm(rotated[used, axis]), "markers") | {"marker": marks})
    marks = {"color": COLOURS[0], "size": 7}
    in_image.append(curve("used", _mm(rotated[used, 0]), _mm(rotated[used, 1]), "markers") | {"marker": marks})
    if aside.any():
        marks = {"color": SET_ASIDE, "size": 8, "symbol": "x"}
        for axis in range(3):
            style = {"showlegend": axis == 0, "marker": marks}
            by_pose.append(curve("set aside", names[aside], _mm(rotated[aside, axis]), "markers") | style)
        in_image.append(
            curve("set aside", _mm(rotated[aside, 0]), _mm(rotated[aside, 1]), "markers") | {"marker": marks}
        )
    pose_layout, image_layout = _layout("pose", "residual, mm"), _layout(*IMAGE_AXES)
    pose_layout["xaxis"]["type"] = "category"
    image_layout["yaxis"]["scaleanchor"] = "x"
    return {
        "residuals": {"data": by_pose, "layout": pose_layout},
        "in_image": {"data": in_image, "layout": image_layout},
    }


def puncture_chart(reached: Sequence[Puncture]) -> dict[str, Any]:
    """Error of every target, in the order reached, beside what calibration and reading let expect."""
    x, curves = np.arange(1, len(reached) + 1), []
    parts = (("distance", "error_mm", COLOURS[0]), ("across the needle", "lateral_mm", COLOURS[2]))
    for label, key, colour in parts:
        y = _mm(np.array([getattr(one, key) for one in reached]))
        curves.append(curve(label, x, y, "markers") | {"marker": {"color": colour, "size": 7}})
    expected = _mm(np.array([one.expected_mm for one in reached]))
    line = {"color": "#5b616b", "dash": "dash"}
    curves.append(curve("expected (rms): calibration and reading", x, expected) | {"line": line})
    layout = _layout("target", "true tip to true target, mm")
    layout["yaxis"]["rangemode"] = "tozero"
    return {"data": curves, "layout": layout}


def _mm(values: Any) -> Any:
    return np.round(values, 3)


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
