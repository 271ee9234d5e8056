"""The page's scene: the same bodies as the picture, lightened for a browser, as plotly traces.

A mesh with fewer triangles, for a browser; pictures only.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import fast_simplification
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.twin.report.map_view import body_directions
from puncture_twin.twin.report.raster.render import Layer
from puncture_twin.twin.report.scene.scene_parts import (
    FLANGE,
    ArmPicture,
    SceneBody,
    arm_bodies,
    chosen_direction,
    joints_on_target,
    needle_bodies,
    patient,
    room,
    safe_region,
)
from puncture_twin.twin.report.scene.views import overview, up_ct

TRIANGLES = 40_000
"""For the whole scene: a phone turns that smoothly, and the page stays near 3 MB."""

GRAIN_MM = 0.25
"""Vertices are shown to so much, a power of two: it packs well."""

JOINT_DIGITS = 5
"""Of rad: 0.01 mm at a metre."""

AROUND_LINKS_MM = 100.0
"""More than a link's body is from the line between its frames."""

VIEW = (1200, 640)
"""Width and height of the scene on the page, CSS pixels."""

LEAST_TRIANGLES = 300
"""A body is never cut below this."""

LEAST_OF_ARM = 1_500
"""Nor a part of an arm below this: the thin shells of its links fell apart into single triangles."""

LABEL_OUT_MM = 45.0
BORDER = 0.02
"""Of the scene's box, around it."""
LEGEND_FRACTION = 0.14
"""Of the width; the legend stands left of the scene."""

EYE_DISTANCE = 1.55
"""In plotly's unit, the scene's size."""

GROUP_NAMES = {"safe": "safe region", "arm": "arm", "room": "room", "needle": "needle"}
"""Bodies that share one line of the legend."""


HOLDER_OPACITY = 0.3
"""Of the needle's holder: from the entry it stands before what the needle goes to."""


def scene_figure(
    case: Any,
    anatomy: Any,
    candidates: Candidates,
    plan: Any | None,
    pick: Pick | None = None,
    T_base_ct: Floats | None = None,
) -> dict[str, Any]:
    """A plotly figure as plain values, meshes in base64.

    Args:
        plan: The plan, or None: then the arm is that of the search, if it reaches the pick.
        pick: Whose needle is shown where there is no plan; None shows none.
        T_base_ct: Shape (4, 4), mm, of a search whose arm was checked.
    """
    bodies, standoff = _bodies(case, anatomy, candidates, plan, pick, T_base_ct if plan is None else plan.T_base_ct)
    light = lightened([*bodies, *standoff], TRIANGLES)
    hidden = set(range(len(bodies), len(light)))
    first = {_legend_name(body): i for i, body in reversed(list(enumerate(light))) if i not in hidden}
    traces = [
        _trace(body, hidden=i in hidden, in_legend=first.get(_legend_name(body)) == i) for i, body in enumerate(light)
    ]
    traces.append(_labels(case, anatomy))
    arms = _arms_box(case, candidates, T_base_ct)
    shown = np.concatenate([*(one.mesh.vertices for one in light if one.group != "room"), arms])
    layout = _layout(case, bodies, box_of(np.concatenate([shown, _label_places(case, anatomy)])))
    return {"data": [*traces, _probe()], "layout": layout}


def _arms_box(case: Any, candidates: Candidates, T_base_ct: Floats | None) -> Floats:
    """Corners of a box that holds the arm of every direction, shape (2, 3), mm, or none: plotly cuts what is beyond."""
    q = candidates.arm.q_insertion
    q = q[np.isfinite(q).all(axis=1)]
    if T_base_ct is None or not len(q):
        return np.zeros((0, 3))
    origins = apply(np.linalg.inv(T_base_ct), link_poses(case.robot.model, q)[..., :3, 3].reshape(-1, 3))
    return np.stack([origins.min(axis=0) - AROUND_LINKS_MM, origins.max(axis=0) + AROUND_LINKS_MM])


def arm_data(
    case: Any, candidates: Candidates, plan: Any | None, pick: Pick | None, T_base_ct: Floats | None
) -> dict[str, Any] | None:
    """With which the page's script moves the links to every direction that the arm reaches; None without them.

    Denavit and Hartenberg's lengths, where the base is, the joints of the scene's meshes, and those of each row, rad.
    """
    first = joints_on_target(plan, pick)
    if first is None or T_base_ct is None or (plan is not None and not np.allclose(plan.T_base_ct, T_base_ct)):
        return None
    q = candidates.arm.q_insertion
    rows = np.flatnonzero(np.isfinite(q).all(axis=1))
    return {
        "lengths": list(case.robot.model.lengths),
        "base": np.linalg.inv(T_base_ct)[:3].T.tolist(),
        "first": first.tolist(),
        "q": dict(zip(rows.tolist(), np.round(q[rows], JOINT_DIGITS).tolist(), strict=True)),
    }


def box_of(points_ct: Floats) -> Floats:
    """What the scene shows, shape (2, 3): the points' box with a little around it."""
    low, high = points_ct.min(axis=0), points_ct.max(axis=0)
    return np.stack([low, high]) + BORDER * (high - low) * np.array([[-1.0], [1.0]])


def lightened(bodies: Sequence[SceneBody], triangles: int) -> list[SceneBody]:
    """The bodies with about so many triangles altogether, each cut by the same share."""
    fraction = min(1.0, triangles / max(1, sum(len(b.mesh.faces) for b in bodies)))
    least = [LEAST_OF_ARM if body.group.startswith("arm") else LEAST_TRIANGLES for body in bodies]
    wanted = [max(few, int(fraction * len(body.mesh.faces))) for few, body in zip(least, bodies, strict=True)]
    return [replace(body, mesh=lighter_mesh(body.mesh, most)) for body, most in zip(bodies, wanted, strict=True)]


def _bodies(
    case: Any, anatomy: Any, candidates: Candidates, plan: Any | None, pick: Pick | None, T_base_ct: Floats | None
) -> tuple[list[SceneBody], list[SceneBody]]:
    """What is shown at first (the needle on the target), and what the standoff pose adds."""
    bodies = [*patient(anatomy, case), *room(case, T_base_ct), *safe_region(candidates, case)]
    direction = chosen_direction(pick, plan)
    if direction is not None:
        bodies += needle_bodies(case.needle, case.target_ct, direction)
    bodies += arm_bodies(case, plan, pick, T_base_ct)
    if plan is None or direction is None:
        return bodies, []
    arm = ArmPicture(plan.model, plan.T_base_ct, case.tool)
    tip = case.target_ct + plan.standoff_mm * direction
    waiting = [*arm.bodies(plan.insertion.q[0]), *needle_bodies(case.needle, tip, direction)]
    return bodies, [SceneBody(f"{b.name}, standoff", f"{b.group}-standoff", b.mesh, b.colour) for b in waiting]


def _legend_name(body: SceneBody) -> str:
    base = body.group.removesuffix("-standoff")
    return GROUP_NAMES.get(base, body.name).replace("_", " ")


def _trace(body: SceneBody, *, hidden: bool, in_legend: bool) -> dict[str, Any]:
    base, group = body.group.removesuffix("-standoff"), _legend_name(body)
    moving = base in {"arm", "needle"}
    vertices = np.round(body.mesh.vertices / GRAIN_MM) * GRAIN_MM
    index = np.uint16 if len(vertices) <= np.iinfo(np.uint16).max else np.int32
    return {
        "type": "mesh3d",
        **{axis: _packed(values, np.float32) for axis, values in zip("xyz", vertices.T, strict=True)},
        **{corner: _packed(values, index) for corner, values in zip("ijk", body.mesh.faces.T, strict=True)},
        "color": css(body.colour),
        "opacity": HOLDER_OPACITY if body.name.startswith("needle holder") else body.alpha,
        "name": group,
        "legendgroup": group,
        "showlegend": in_legend,
        "visible": not hidden and base != "arm",
        "hoverinfo": "name" if base == "organ" else "skip",
        "flatshading": False,
        "lighting": {"ambient": 0.5, "diffuse": 0.7, "specular": 0.15, "roughness": 0.6, "fresnel": 0.1},
        "meta": {
            "pose": "standoff" if hidden else "target" if moving else "",
            "arm": base == "arm",
            "frame": FLANGE if base == "needle" else body.frame,
        },
    }


def _packed(values: NDArray[Any], dtype: type) -> dict[str, str]:
    """An array as plotly's script reads it: its type and its bytes in base64."""
    array: NDArray[Any] = np.ascontiguousarray(values, dtype=dtype)
    return {"dtype": array.dtype.str[1:], "bdata": base64.b64encode(array.tobytes()).decode("ascii")}


def _labels(case: Any, anatomy: Any) -> dict[str, Any]:
    """The body's directions, written around it."""
    names, places = body_directions(case.space), _label_places(case, anatomy)
    return {
        "type": "scatter3d",
        **{axis: values.tolist() for axis, values in zip("xyz", places.T, strict=True)},
        "mode": "text",
        "text": [f"<b>{name}</b>" for name in names],
        "textfont": {"size": 14, "color": "#222222"},
        "hoverinfo": "skip",
        "showlegend": False,
        "name": "directions",
    }


def _label_places(case: Any, anatomy: Any) -> Floats:
    low, high = anatomy.skin.mesh.bounds
    centre, half = (low + high) / 2, (high - low) / 2
    return np.array([centre + v * (np.abs(v) @ half + LABEL_OUT_MM) for v in body_directions(case.space).values()])


def _probe() -> dict[str, Any]:
    """The line of the direction that the pointer chose on the map; the page's script fills it."""
    return {
        "type": "scatter3d",
        **{axis: [None] for axis in "xyz"},
        "mode": "lines",
        "line": {"color": "#d6001e", "width": 7},
        "name": "direction clicked on the map",
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _layout(case: Any, bodies: Sequence[SceneBody], box: Floats) -> dict[str, Any]:
    axes = {f"{name}axis": _axis(*box[:, i].tolist()) for i, name in enumerate("xyz")}
    content = np.concatenate([b.mesh.vertices for b in bodies if b.group != "room"])
    blockers = Layer([b.surface for b in bodies if b.group in {"arm", "room", "target"}])
    seen = overview(case, content, case.target_ct[None], blockers, VIEW)
    vectors = {"up": up_ct(case), "eye": -EYE_DISTANCE * seen.axes[2]}
    camera = {k: dict(zip("xyz", (float(x) for x in v), strict=True)) for k, v in vectors.items()}
    return {
        "scene": {
            "domain": {"x": [LEGEND_FRACTION, 1.0]},
            **_true_to_scale(box),
            **axes,
            "camera": camera,
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"itemsizing": "constant", "font": {"size": 12}, "x": 0.0, "y": 1.0},
        "paper_bgcolor": "#f6f7f9",
        "uirevision": "keep",
    }


def _true_to_scale(box: Floats) -> dict[str, Any]:
    """Edges of the drawn box as its ranges: of itself plotly scales each axis by the traces that are shown.

    Divided by their geometric mean, which is the unit in which the page's script places its camera.
    """
    extent = box[1] - box[0]
    ratio = extent / np.cbrt(np.prod(extent))
    return {"aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio.tolist(), strict=True))}


def _axis(low: float, high: float) -> dict[str, Any]:
    """Unseen, and with a fixed range, so that the page's script can place its camera."""
    return {"visible": False, "showspikes": False, "range": [low, high]}


WELDED = 0.75
"""Corners per triangle; a closed surface that shares its corners has half a corner per triangle."""


def lighter_mesh(mesh: TriangleMesh, triangles: int) -> TriangleMesh:
    """The mesh with about so many triangles; itself where it has no more, or where nothing would be left."""
    if triangles >= len(mesh.faces):
        return mesh
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if len(vertices) > WELDED * len(faces):  # a robot's STL shares no corners
        vertices, welded = np.unique(vertices, axis=0, return_inverse=True)
        faces = np.ascontiguousarray(welded.reshape(-1)[faces], dtype=np.int32)
    vertices, faces = fast_simplification.simplify(vertices, faces, target_count=triangles)
    return TriangleMesh(vertices.astype(np.float64), faces.astype(np.int32)) if len(faces) else mesh
