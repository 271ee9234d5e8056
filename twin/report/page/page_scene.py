"""The page's scene: the same bodies as the picture, with fewer triangles for a browser, as plotly traces."""

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
from puncture_twin.twin.report.scene import scene_parts
from puncture_twin.twin.report.scene.views import overview, up_ct

TRIANGLES = 40_000  # for the whole scene: a phone turns that smoothly, and the page stays near 3 MB
GRAIN_MM = 0.25  # vertices are shown to so much, a power of two: it packs well
JOINT_DIGITS = 5  # of rad: 0.01 mm at a metre
AROUND_LINKS_MM = 100.0  # more than a link's body is from the line between its frames
VIEW = (1200, 640)  # width and height of the scene on the page, CSS pixels
LEAST_TRIANGLES = 300  # a body is never cut below this
LEAST_OF_ARM = 1_500  # nor a part of an arm below this: the thin shells of its links fell apart into single triangles
LABEL_OUT_MM = 45.0
BORDER = 0.02  # of the scene's box, around it
LEGEND_FRACTION = 0.14  # of the width; the legend stands left of the scene
EYE_DISTANCE = 1.55  # in plotly's unit, the scene's size
GROUP_NAMES = {"safe": "safe region", "arm": "arm", "room": "room", "needle": "needle"}
"""Bodies that share one line of the legend."""


HOLDER_OPACITY = 0.3  # of the needle's holder: from the entry it stands before what the needle goes to


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
    base = T_base_ct if plan is None else plan.T_base_ct
    direction, standoff = scene_parts.chosen_direction(pick, plan), []
    bodies = [
        *scene_parts.patient(anatomy, case),
        *scene_parts.room(case, base),
        *scene_parts.safe_region(candidates, case),
    ]
    if direction is not None:
        bodies += scene_parts.needle_bodies(case.needle, case.target_ct, direction)
    bodies += scene_parts.arm_bodies(case, plan, pick, base)
    if plan is not None and direction is not None:
        tip = case.target_ct + plan.standoff_mm * direction
        arm = scene_parts.ArmPicture(plan.model, plan.T_base_ct, case.tool).bodies(plan.insertion.q[0])
        for b in (*arm, *scene_parts.needle_bodies(case.needle, tip, direction)):
            standoff.append(scene_parts.SceneBody(f"{b.name}, standoff", f"{b.group}-standoff", b.mesh, b.colour))
    light = lightened([*bodies, *standoff], TRIANGLES)
    hidden = set(range(len(bodies), len(light)))
    first = {_legend_name(body): i for i, body in reversed(list(enumerate(light))) if i not in hidden}
    traces = [
        _trace(body, hidden=i in hidden, in_legend=first.get(_legend_name(body)) == i) for i, body in enumerate(light)
    ]
    traces.append(_labels(case, anatomy))
    shown = [one.mesh.vertices for one in light if one.group != "room"]
    q = candidates.arm.q_insertion
    q = q[np.isfinite(q).all(axis=1)]
    if T_base_ct is not None and len(q):  # the arm of every direction: plotly cuts what is beyond
        origins = apply(np.linalg.inv(T_base_ct), link_poses(case.robot.model, q)[..., :3, 3].reshape(-1, 3))
        shown.append(np.stack([origins.min(axis=0) - AROUND_LINKS_MM, origins.max(axis=0) + AROUND_LINKS_MM]))
    layout = _layout(case, bodies, box_of(np.concatenate([*shown, _label_places(case, anatomy)])))
    probe = {  # of the direction that the pointer chose on the map; the page's script fills it
        "type": "scatter3d",
        **{axis: [None] for axis in "xyz"},
        "mode": "lines",
        "line": {"color": "#d6001e", "width": 7},
        "name": "direction clicked on the map",
        "hoverinfo": "skip",
        "showlegend": False,
    }
    return {"data": [*traces, probe], "layout": layout}


def arm_data(
    case: Any, candidates: Candidates, plan: Any | None, pick: Pick | None, T_base_ct: Floats | None
) -> dict[str, Any] | None:
    """With which the page's script moves the links to every direction that the arm reaches; None without them.

    Denavit and Hartenberg's lengths, where the base is, the joints of the scene's meshes, and those of each row, rad.
    """
    first = scene_parts.joints_on_target(plan, pick)
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


def lightened(bodies: Sequence[scene_parts.SceneBody], triangles: int) -> list[scene_parts.SceneBody]:
    """The bodies with about so many triangles altogether, each cut by the same share."""
    fraction = min(1.0, triangles / max(1, sum(len(b.mesh.faces) for b in bodies)))
    least = [LEAST_OF_ARM if body.group.startswith("arm") else LEAST_TRIANGLES for body in bodies]
    wanted = [max(few, int(fraction * len(body.mesh.faces))) for few, body in zip(least, bodies, strict=True)]
    return [replace(body, mesh=lighter_mesh(body.mesh, most)) for body, most in zip(bodies, wanted, strict=True)]


def _legend_name(body: scene_parts.SceneBody) -> str:
    base = body.group.removesuffix("-standoff")
    return GROUP_NAMES.get(base, body.name).replace("_", " ")


def _trace(body: scene_parts.SceneBody, *, hidden: bool, in_legend: bool) -> dict[str, Any]:
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
            "frame": scene_parts.FLANGE if base == "needle" else body.frame,
        },
    }


def _packed(values: NDArray[Any], dtype: type) -> dict[str, str]:
    """An array as plotly's script reads it: its type and its bytes in base64."""
    array: NDArray[Any] = np.ascontiguousarray(values, dtype=dtype)
    return {"dtype": array.dtype.str[1:], "bdata": base64.b64encode(array.tobytes()).decode("ascii")}


def _labels(case: Any, anatomy: Any) -> dict[str, Any]:
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


def _layout(case: Any, bodies: Sequence[scene_parts.SceneBody], box: Floats) -> dict[str, Any]:
    # Unseen, with fixed ranges, so that the page's script can place its camera; edges of the drawn box as these ranges,
    # divided by their geometric mean, which is its unit: of itself plotly scales each axis by the shown traces.
    axes = {
        f"{name}axis": {"visible": False, "showspikes": False, "range": box[:, i].tolist()}
        for i, name in enumerate("xyz")
    }
    ratio = np.diff(box, axis=0)[0] / np.cbrt(np.prod(np.diff(box, axis=0)))
    content = np.concatenate([b.mesh.vertices for b in bodies if b.group != "room"])
    blockers = Layer([b.surface for b in bodies if b.group in {"arm", "room", "target"}])
    seen = overview(case, content, case.target_ct[None], blockers, VIEW)
    vectors = {"up": up_ct(case), "eye": -EYE_DISTANCE * seen.axes[2]}
    camera = {k: dict(zip("xyz", (float(x) for x in v), strict=True)) for k, v in vectors.items()}
    return {
        "scene": {
            "domain": {"x": [LEGEND_FRACTION, 1.0]},
            "aspectmode": "manual",
            "aspectratio": dict(zip("xyz", ratio.tolist(), strict=True)),
            **axes,
            "camera": camera,
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"itemsizing": "constant", "font": {"size": 12}, "x": 0.0, "y": 1.0},
        "paper_bgcolor": "#f6f7f9",
        "uirevision": "keep",
    }


WELDED = 0.75  # corners per triangle; a closed surface that shares its corners has half a corner per triangle


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
