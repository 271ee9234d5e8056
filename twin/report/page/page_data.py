"""Data of the page's script: the map, a picture of the cap with the rows behind it for the pointer, and the scene.

The scene's bodies are those of the picture, with fewer triangles for a browser, as plotly traces.
"""

import base64
import shlex
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.reasons import REASON_TEXT, Reason, css
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.search.candidates import MOST_WINDOWS, NOT_SEEN, Candidates, Pick
from puncture_twin.planning.search.constraints import closest_miss
from puncture_twin.twin.report.map.map_raster import PIXELS as FINE, MapRaster, map_raster, shown_front
from puncture_twin.twin.report.map_view import body_directions, map_view
from puncture_twin.twin.report.page.template import image_address
from puncture_twin.twin.report.palette import PNG_LEVEL
from puncture_twin.twin.report.raster.render import Layer
from puncture_twin.twin.report.scene import scene_parts
from puncture_twin.twin.report.scene.scene_parts import Scene, SceneBody
from puncture_twin.twin.report.slices.panel import MOST_NEAR, NEAR_MM

PIXELS = FINE // 2  # side of the map on the page, CSS pixels; the picture is twice as fine for sharp screens

DETAIL_UNITS = {  # what ``Candidates.verdict.amount`` is, by reason
    Reason.TOO_CLOSE: ("clearance", "mm"),
    Reason.UNKNOWN_REGION: ("clearance", "mm"),
    Reason.TOO_LONG: ("path", "mm"),
    Reason.SKIN_ANGLE: ("skin angle", "°"),
    Reason.UNSAFE_WHEN_BREATHING: ("clearance", "mm"),
    Reason.NEEDLE_BENDS: ("clearance", "mm"),
    Reason.HIT_UNLIKELY: ("chance to hit", " "),
    Reason.TOUCH_LIKELY: ("chance to touch", " "),
}
WELDED = 0.75  # corners per triangle; a closed surface that shares its corners has half a corner per triangle


def picked_row(candidates: Candidates, pick: Pick | None) -> int:
    """The row of a pick; one beyond the last for one that the search has no row of, -1 without any."""
    if pick is None:
        return -1
    if pick.candidates is candidates:
        return pick.row
    theta, beta = pick.candidates.theta[pick.row], pick.candidates.beta[pick.row]
    matches = np.flatnonzero(np.isclose(candidates.theta, theta) & np.isclose(candidates.beta, beta))
    return int(matches[0]) if len(matches) else len(candidates)


def map_data(case: Any, candidates: Candidates, pick: Pick | None, raster: MapRaster | None = None) -> dict[str, Any]:
    """Data with which the page's script draws the map and answers the pointer; plain values, degrees and mm.

    The pixel-to-row table is stored run by run, row after row of the picture: ``runs`` is [candidate, length, ...],
    candidate -1 outside the grid. A pick that the search has no row of is one row more.
    """
    view, windows = map_view(case, candidates), candidates.windows
    raster = map_raster(candidates, view) if raster is None else raster
    front, picked = shown_front(candidates, view), picked_row(candidates, pick)
    flat = raster.rows[::2, ::2].ravel()
    starts = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1])
    runs = np.stack([flat[starts], np.diff(np.append(starts, len(flat)))], axis=1)
    parts = [(candidates, np.arange(len(candidates)), windows.of_row)]
    if pick is not None and picked == len(candidates):
        parts.append((pick.candidates, np.array([pick.row]), np.zeros(len(pick.candidates), int)))
    return {
        "size": PIXELS,
        "image": image_address(Image.fromarray(raster.rgba), PNG_LEVEL),
        "runs": runs.ravel().tolist(),
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
    """Facts of each direction, a list a column; structures, reasons and sentences by their places."""
    verdicts = [candidates.verdict.of(rows) for candidates, rows, _ in parts]
    named = {str(name) for one in verdicts for name in one.named}
    structures = sorted(named.union(*(candidates.clearance.structures for candidates, *_ in parts)))
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
    candidates: Candidates, rows: Ints, window: Ints, structures: list[str], reasons: list[str], sentences: list[str]
) -> dict[str, list[Any]]:
    verdict, path, arm = candidates.verdict.of(rows), candidates.path, candidates.arm
    index = {name: i for i, name in enumerate(structures)}
    columns = {
        "theta": _rounded(np.degrees(candidates.theta[rows]), 5),
        "beta": _rounded(np.degrees(candidates.beta[rows]), 5),
        "reason": [reasons.index(str(r)) for r in verdict.reason],
        "structure": [index[str(s)] for s in verdict.named],
        "sentence": [sentences.index(str(text)) for text in verdict.detail],
        "depth": _rounded(verdict.depth, 1),
        "amount": _rounded(verdict.amount, 2),
        "near": _near(candidates, rows, index),
        "path": _rounded(path.length[rows], 3),
        "skin_angle": _rounded(np.degrees(path.skin_angle[rows]), 1),
        "rank": candidates.ranking.rank[rows].tolist(),
        "window": window[rows].tolist(),
        "safe_cone": _rounded(np.degrees(candidates.safe_cone[rows]), 1),
        "reachable": arm.reachable[rows].tolist(),
        "outward": _rounded(candidates.outward_ct[rows].ravel(), 6),
    }
    chances = candidates.chances
    if chances is not None:  # what is not there is not spoken of
        columns |= {
            "p_hit": _rounded(chances.hit[rows], 9),
            "p_touch_any": _rounded(chances.touch_any[rows], 9),
            "touch_refined": chances.refined[rows].tolist(),
        }
    return columns


def _near(candidates: Candidates, rows: Ints, index: dict[str, int]) -> list[list[float]]:
    """As `Subject.near`, of every row: place, mm, place, mm, and so on; at least the nearest, however far it is."""
    demanding = np.flatnonzero(np.isfinite(candidates.clearance.margins))
    distance = candidates.clearance.by_structure[np.ix_(rows, demanding)]
    order = np.argsort(distance, axis=1, kind="stable")[:, :MOST_NEAR]
    nearest = np.round(np.take_along_axis(distance, order, axis=1), 3)
    shown = np.isfinite(nearest) & ((nearest < NEAR_MM) | (np.arange(order.shape[1]) == 0))
    places = np.array([index[name] for name in candidates.clearance.structures], int)[demanding]
    return [
        [value for k in np.flatnonzero(keep) for value in (int(places[one[k]]), float(mm[k]))]
        for one, mm, keep in zip(order, nearest, shown, strict=True)
    ]


def _rounded(values: Any, digits: int) -> list[float | None]:
    values = np.asarray(values, dtype=float)
    rounded: list[float | None] = np.round(values, digits).tolist()
    for i in np.flatnonzero(~np.isfinite(values)):
        rounded[i] = None
    return rounded


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


def scene_figure(scene: Scene) -> dict[str, Any]:
    """A plotly figure as plain values, meshes in base64; without a plan the arm is that of the search."""
    case, anatomy, plan, direction, standoff = scene.case, scene.anatomy, scene.plan, scene.outward_ct, []
    bodies = [
        *scene_parts.patient(anatomy, case),
        *scene_parts.room(case, scene.base),
        *scene_parts.safe_region(scene.candidates, case),
        *scene.needle,
        *scene.arm,
    ]
    if plan is not None and direction is not None:
        tip = case.target_ct + plan.standoff_mm * direction
        arm = scene_parts.ArmPicture(plan.model, plan.T_base_ct, case.tool).bodies(plan.insertion.q[0])
        for b in (*arm, *scene_parts.needle_bodies(case.needle, tip, direction)):
            standoff.append(SceneBody(f"{b.name}, standoff", f"{b.group}-standoff", b.mesh, b.colour))
    light = lightened([*bodies, *standoff], TRIANGLES)
    hidden = set(range(len(bodies), len(light)))
    first = {_legend_name(body): i for i, body in reversed(list(enumerate(light))) if i not in hidden}
    traces = [
        _trace(body, hidden=i in hidden, in_legend=first.get(_legend_name(body)) == i) for i, body in enumerate(light)
    ]
    traces.append(_labels(case, anatomy))
    shown = [one.mesh.vertices for one in light if one.group != "room"]
    q = scene.candidates.arm.q_insertion
    q = q[np.isfinite(q).all(axis=1)]
    if scene.T_base_ct is not None and len(q):  # the arm of every direction: plotly cuts what is beyond
        origins = apply(np.linalg.inv(scene.T_base_ct), link_poses(case.robot.model, q)[..., :3, 3].reshape(-1, 3))
        shown.append(np.stack([origins.min(axis=0) - AROUND_LINKS_MM, origins.max(axis=0) + AROUND_LINKS_MM]))
    points = np.concatenate([*shown, _label_places(case, anatomy)])
    low, high = points.min(axis=0), points.max(axis=0)
    box = np.stack([low, high]) + BORDER * (high - low) * np.array([[-1.0], [1.0]])
    layout = _layout(case, bodies, box)
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


def arm_data(scene: Scene) -> dict[str, Any] | None:
    """Data with which the page's script moves the links to every direction that the arm reaches; None without them.

    Denavit and Hartenberg's lengths, where the base is, the joints of the scene's meshes, and those of each row, rad.
    """
    first, T_base_ct, plan, q = scene.q_target, scene.T_base_ct, scene.plan, scene.candidates.arm.q_insertion
    if first is None or T_base_ct is None or (plan is not None and not np.allclose(plan.T_base_ct, T_base_ct)):
        return None
    rows = np.flatnonzero(np.isfinite(q).all(axis=1))
    return {
        "lengths": list(scene.case.robot.model.lengths),
        "base": np.linalg.inv(T_base_ct)[:3].T.tolist(),
        "first": first.tolist(),
        "q": dict(zip(rows.tolist(), np.round(q[rows], JOINT_DIGITS).tolist(), strict=True)),
    }


def lightened(bodies: Sequence[SceneBody], triangles: int) -> list[SceneBody]:
    """The bodies with about so many triangles altogether, each cut by the same share."""
    fraction = min(1.0, triangles / max(1, sum(len(b.mesh.faces) for b in bodies)))
    least = [LEAST_OF_ARM if body.group.startswith("arm") else LEAST_TRIANGLES for body in bodies]
    wanted = [max(few, int(fraction * len(body.mesh.faces))) for few, body in zip(least, bodies, strict=True)]
    return [replace(body, mesh=lighter_mesh(body.mesh, most)) for body, most in zip(bodies, wanted, strict=True)]


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


def _layout(case: Any, bodies: Sequence[SceneBody], box: Floats) -> dict[str, Any]:
    # Unseen, with fixed ranges, so that the page's script can place its camera; edges of the drawn box as these ranges,
    # divided by their geometric mean, which is its unit: of itself plotly scales each axis by the shown traces.
    axes = {
        f"{name}axis": {"visible": False, "showspikes": False, "range": box[:, i].tolist()}
        for i, name in enumerate("xyz")
    }
    ratio = np.diff(box, axis=0)[0] / np.cbrt(np.prod(np.diff(box, axis=0)))
    content = np.concatenate([b.mesh.vertices for b in bodies if b.group != "room"])
    blockers = Layer([b.surface for b in bodies if b.group in {"arm", "room", "target"}])
    seen = scene_parts.overview(case, content, case.target_ct[None], blockers, VIEW)
    vectors = {"up": scene_parts.up_ct(case), "eye": -EYE_DISTANCE * seen.axes[2]}
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
