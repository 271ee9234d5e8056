"""Slicer's markups (.mrk.json), schema 1.0.3: named points, or a line of two, in LPS mm.

Source: the Markups schema that Slicer publishes, version 1.0.3.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Literal

from puncture_twin.planning.base.arrays import Floats

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
_AXES = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def markups_text(kind: Literal["Fiducial", "Line"], name: str, labels: Sequence[str], points_ct: Floats) -> str:
    """The file of one markup.

    Args:
        kind: ``Line`` has two points.
        name: Of the markup.
        labels: Of its points.
        points_ct: Shape (n, 3), LPS mm.
    """
    points = [
        {
            "id": str(number),
            "label": label,
            "position": position,
            "orientation": _AXES,
            "selected": True,
            "locked": True,
            "visibility": True,
            "positionStatus": "defined",
        }
        for number, (label, position) in enumerate(zip(labels, points_ct.tolist(), strict=True), start=1)
    ]
    markup = {
        "type": kind,
        "name": name,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "fixedNumberOfControlPoints": True,
        "labelFormat": "%N-%d",
        "controlPoints": points,
    }
    return json.dumps({"@schema": SCHEMA, "markups": [markup]}, indent=1, ensure_ascii=False) + "\n"
