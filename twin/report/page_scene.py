"""The page's scene: the same bodies as the picture, lightened for a browser, as plotly traces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import fast_simplification
import numpy as np
import plotly.graph_objects as go

from planning.candidates import Candidates
from planning.mesh import TriangleMesh
from twin.report.map_view import body_directions
from twin.report.palette import css
from twin.report.render import Layer
from twin.report.scene_parts import (
    ArmPicture,
    Body,
    chosen_direction,
    needle_bodies,
    patient,
    room,
    safe_region,
)
from twin.report.views import overview, up_ct

TRIANGLES = 100_000
"""For the whole scene; a laptop turns that smoothly."""

VIEW = (1200, 640)
"""Width and height of the scene on the page, CSS pixels."""

LEAST_TRIANGLES = 300
"""A body is never cut below this."""

LABEL_OUT_MM = 45.0
LEGEND_SHARE = 0.14
"""Of the width; the legend stands left of the scene."""

EYE_DISTANCE = 1.55
"""In plotly's unit, the scene's size."""

GROUP_NAMES = {"safe": "safe region", "arm": "arm", "room": "room", "needle": "needle"}
"""Bodies that share one line of the legend."""


def scene_figure(case: Any, anatomy: Any, candidates: Candidates, plan: Any | None) -> dict[str, Any]:
    """A plotly figure as plain values, meshes in base64.

    Args:
        case: The case.
        anatomy: Structures and skin.
        candidates: The search's rows.
        plan: The plan, or None: then there is no arm.
    """
    bodies, standoff = _bodies(case, anatomy, candidates, plan)
    light = lightened([*bodies, *standoff], TRIANGLES)
    hidden = set(range(len(bodies), len(light)))
    first = {_legend_name(body): i for i, body in reversed(list(enumerate(light))) if i not in hidden}
    traces = [
        _trace(body, hidden=i in hidden, in_legend=first.get(_legend_name(body)) == i) for i, body in enumerate(light)
    ]
    traces.append(_labels(case, anatomy))
    figure = go.Figure(data=[*traces, _probe()], layout=_layout(case, bodies))
    return dict(figure.to_plotly_json())


def lightened(bodies: Sequence[Body], triangles: int) -> list[Body]:
    """The bodies with about so many triangles altogether, each cut by the same share."""
    share = min(1.0, triangles / max(1, sum(len(b.mesh.faces) for b in bodies)))
    light = []
    for body in bodies:
        wanted = max(LEAST_TRIANGLES, int(share * len(body.mesh.faces)))
        light.append(body if wanted >= len(body.mesh.faces) else _lighter(body, wanted))
    return light


def _lighter(body: Body, wanted: int) -> Body:
    corners, welded = np.unique(body.mesh.vertices, axis=0, return_inverse=True)  # a robot's STL shares no corners
    faces = np.ascontiguousarray(welded.reshape(-1)[body.mesh.faces], dtype=np.int32)
    vertices, faces = fast_simplification.simplify(corners, faces, target_count=wanted)
    if len(faces) == 0:  # nothing may vanish from a picture
        return body
    mesh = TriangleMesh(np.asarray(vertices, dtype=np.float64), np.asarray(faces))
    return Body(body.name, body.group, mesh, body.colour, body.alpha)


def _bodies(case: Any, anatomy: Any, candidates: Candidates, plan: Any | None) -> tuple[list[Body], list[Body]]:
    """What is shown at first (the needle on the target), and what the standoff pose adds."""
    T_base_ct = None if plan is None else plan.T_base_ct
    bodies = [*patient(anatomy, case), *room(case, T_base_ct), *safe_region(candidates, case)]
    direction = chosen_direction(candidates, case, plan)
    if direction is not None:
        bodies += needle_bodies(case.needle, case.target_ct, direction).all
    if plan is None or direction is None:
        return bodies, []
    arm = ArmPicture(plan.model, plan.T_base_ct)
    bodies += arm.bodies(plan.insertion.q[-1])
    tip = case.target_ct + plan.standoff_mm * direction
    waiting = [*arm.bodies(plan.insertion.q[0]), *needle_bodies(case.needle, tip, direction).all]
    return bodies, [Body(f"{b.name}, standoff", f"{b.group}-standoff", b.mesh, b.colour) for b in waiting]


def _legend_name(body: Body) -> str:
    base = body.group.removesuffix("-standoff")
    return GROUP_NAMES.get(base, body.name).replace("_", " ")


def _trace(body: Body, *, hidden: bool, in_legend: bool) -> go.Mesh3d:
    vertices, faces = body.mesh.vertices.astype(np.float32), body.mesh.faces
    base, group = body.group.removesuffix("-standoff"), _legend_name(body)
    moving = base in {"arm", "needle"}
    return go.Mesh3d(
        x=vertices[:, 0],
        y=vertices[:, 1],
        z=vertices[:, 2],
        i=faces[:, 0],
        j=faces[:, 1],
        k=faces[:, 2],
        color=css(body.colour),
        opacity=body.alpha,
        name=group,
        legendgroup=group,
        showlegend=in_legend,
        visible=not hidden,
        hoverinfo="name" if base == "organ" else "skip",
        flatshading=False,
        lighting={"ambient": 0.5, "diffuse": 0.7, "specular": 0.15, "roughness": 0.6, "fresnel": 0.1},
        meta={"pose": "standoff" if hidden else "target" if moving else ""},
    )


def _labels(case: Any, anatomy: Any) -> go.Scatter3d:
    """The body's directions, written around it."""
    low, high = anatomy.skin.mesh.bounds
    centre, half = (low + high) / 2, (high - low) / 2
    names = body_directions(case.space)
    places = np.array([centre + v * (np.abs(v) @ half + LABEL_OUT_MM) for v in names.values()])
    return go.Scatter3d(
        x=places[:, 0],
        y=places[:, 1],
        z=places[:, 2],
        mode="text",
        text=[f"<b>{name}</b>" for name in names],
        textfont={"size": 14, "color": "#222222"},
        hoverinfo="skip",
        showlegend=False,
        name="directions",
    )


def _probe() -> go.Scatter3d:
    """The line of the direction that the pointer chose on the map; the page's script fills it."""
    return go.Scatter3d(
        x=[None],
        y=[None],
        z=[None],
        mode="lines",
        line={"color": "#d6001e", "width": 7},
        name="direction clicked on the map",
        hoverinfo="skip",
        showlegend=False,
    )


def _layout(case: Any, bodies: Sequence[Body]) -> dict[str, Any]:
    axis = {"visible": False, "showspikes": False}
    content = np.concatenate([b.mesh.vertices for b in bodies if b.group != "room"])
    blockers = Layer([b.surface for b in bodies if b.group in {"arm", "room", "target"}])
    seen = overview(case, content, case.target_ct[None], blockers, VIEW)
    vectors = {"up": up_ct(case), "eye": -EYE_DISTANCE * seen.axes[2]}
    camera = {k: dict(zip("xyz", (float(x) for x in v), strict=True)) for k, v in vectors.items()}
    return {
        "scene": {
            "domain": {"x": [LEGEND_SHARE, 1.0]},
            "aspectmode": "data",
            "xaxis": axis,
            "yaxis": axis,
            "zaxis": axis,
            "camera": camera,
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"itemsizing": "constant", "font": {"size": 12}, "x": 0.0, "y": 1.0},
        "paper_bgcolor": "#f6f7f9",
        "height": VIEW[1],
        "uirevision": "keep",
    }
