"""``scene.png``: the patient with the safe corridor, the needle and the arm, from afar and close by."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import SAFE, Rgb
from puncture_twin.twin.report import annotate, palette
from puncture_twin.twin.report.numbers import length_text, nearest_text, target_text
from puncture_twin.twin.report.raster.camera import ViewCamera
from puncture_twin.twin.report.raster.render import BACKGROUND, Layer, picture
from puncture_twin.twin.report.scene import scene_parts
from puncture_twin.twin.report.scene.scene_parts import Scene, SceneBody

WIDTH, HEIGHT = 1720, 1020
Box = tuple[int, int, int, int]  # left, top, right, bottom, pixels
LEFT_BOX = (16, 84, 926, 840)
RIGHT_BOX = (942, 84, 1704, 840)
LEGEND_TOP = 858
AXES_LENGTH, AXES_CORNER = 44, 110  # pixels: length of the body's axes, and how far from the corner they cross
CORNER_GAIN = 0.1  # how much emptier the upper corner must be for the axes to stand there instead of below
BODY_RADIUS_MM = 700.0  # the overview shows the patient within this distance of the target, and the whole arm
CLOSE_RADIUS_MM = 38.0
HIDDEN_NEARBY = ("room", "safe")  # not in the close-up: a rib seen through green would look safe to hit
NOTHING_RADIUS_MM = 90.0  # around the target, when there is no path to show
MOST_ENTRIES = 26  # up to so many entries of the legend nothing is folded


def draw_scene(scene: Scene, path: Path) -> None:
    """Write the picture of the scene; without a plan the arm is that of the search, and the needle that of the pick."""
    case, path_ct = scene.case, scene.path_ct
    bodies = [
        *scene_parts.patient(scene.anatomy, case),
        *scene_parts.safe_region(scene.candidates, case),
        *scene_parts.room(case, scene.base),
        *scene.needle,
    ]
    arm = () if scene.refusal else scene.arm
    image = Image.new("RGB", (WIDTH, HEIGHT), annotate.WHITE)
    draw = ImageDraw.Draw(image)
    with_arm = [*bodies, *arm]
    needle = None if path_ct is None else _needle_line(case, path_ct)
    title = "Overview" + (": needle on the target" if arm else "")
    _view(image, with_arm, _overview_camera(case, with_arm, path_ct), LEFT_BOX, case, title, needle)
    along, radius = path_ct, CLOSE_RADIUS_MM
    if along is None:
        along, radius = case.target_ct + np.outer([0.0, 1.0], case.T_ct_entry[:3, 2]), NOTHING_RADIUS_MM
    organs = Layer([b.surface for b in bodies if b.alpha >= 1 and b.group in {"organ", "target"}])
    near = scene_parts.close_up(case, along, radius, organs, _size(RIGHT_BOX))
    few = [body for body in bodies if body.name != "needle holder" and body.group not in HIDDEN_NEARBY]
    _view(image, few, near, RIGHT_BOX, case, "Close-up of the path", needle)
    bottom = _text(draw, scene, bodies, arm=bool(arm))
    annotate.write_image(image.crop((0, 0, WIDTH, min(HEIGHT, round(bottom) + 8))), path)


def render_bodies(bodies: Sequence[SceneBody], camera: ViewCamera) -> NDArray[np.uint8]:
    """One view of a scene, anti-aliased: the opaque bodies, and the see-through ones over them."""
    opaque, glass = ([b.surface for b in bodies if (b.alpha >= 1) == solid] for solid in (True, False))
    return picture(Layer(opaque), Layer(glass), camera)


def _overview_camera(case: Any, bodies: Sequence[SceneBody], path_ct: Any) -> ViewCamera:
    size = _size(LEFT_BOX)
    points = []
    for body in bodies:
        vertices = body.mesh.vertices
        farthest = np.linalg.norm(np.abs(body.mesh.bounds - case.target_ct).max(axis=0))  # no corner is farther
        if body.group in {"skin", "organ"} and farthest >= BODY_RADIUS_MM:
            vertices = vertices[np.linalg.norm(vertices - case.target_ct, axis=1) < BODY_RADIUS_MM]
        if body.group != "room" and len(vertices):
            points.append(vertices)
    focus = np.stack([case.target_ct]) if path_ct is None else _needle_line(case, path_ct)
    blockers = Layer([b.surface for b in bodies if b.alpha >= 1 and b.group in {"arm", "room", "target"}])
    outward = None if path_ct is None else (path_ct[1] - path_ct[0]) / np.linalg.norm(path_ct[1] - path_ct[0])
    return scene_parts.overview(case, np.concatenate(points), focus, blockers, size, outward)


def _needle_line(case: Any, path_ct: Floats) -> Floats:
    along = path_ct[1] - path_ct[0]
    along = along / np.linalg.norm(along)
    return np.asarray(path_ct[0] + np.linspace(0, case.needle.length_mm, 24)[:, None] * along)


def _size(box: Box) -> tuple[int, int]:
    return box[2] - box[0], box[3] - box[1]


def _view(
    image: Image.Image,
    bodies: Sequence[SceneBody],
    camera: ViewCamera,
    box: Box,
    case: Any,
    title: str,
    needle: Floats | None,
) -> None:
    seen, draw = render_bodies(bodies, camera), ImageDraw.Draw(image)
    image.paste(Image.fromarray(seen), box[:2])
    annotate.panel(draw, box, title)
    on_needle = np.empty((0, 2)) if needle is None else camera.project(needle)[:, :2] + box[:2]
    annotate.body_axes(draw, camera, case.space, _empty_corner(seen, box, on_needle), AXES_LENGTH)
    annotate.scale_bar(draw, camera, case.target_ct, box[0] + 20, box[3] - 22, 200)


def _empty_corner(seen: NDArray[np.uint8], box: Box, on_needle: Floats) -> tuple[float, float]:
    """The middle of the right corner, upper or lower, where no needle is, or else less is to be seen."""
    far = AXES_CORNER
    upper, lower = (box[2] - far, box[1] + far), (box[2] - far, box[3] - far)
    covers = [bool((np.linalg.norm(on_needle - corner, axis=1) < far).any()) for corner in (upper, lower)]
    if covers[0] != covers[1]:
        return lower if covers[0] else upper
    plain = (seen == np.round(BACKGROUND).astype(np.uint8)).all(axis=2)
    emptier = plain[: 2 * far, -2 * far :].mean() > plain[-2 * far :, -2 * far :].mean() + CORNER_GAIN
    return upper if emptier else lower


def _text(draw: ImageDraw.ImageDraw, scene: Scene, bodies: Sequence[SceneBody], *, arm: bool) -> float:
    """Write the text around the views; returns the row below the legend."""
    case, candidates, plan = scene.case, scene.candidates, scene.plan
    annotate.write(draw, (18, 12), f"{case.name}: needle path to {target_text(case)}", size=28, bold=True)
    nothing = scene.chosen is None and plan is None
    text, colour = "NOTHING IS SAFE: every direction is rejected; no needle is shown", annotate.RED
    if not nothing:
        text, colour = _path_text(scene, arm=arm), annotate.RED if scene.refusal else annotate.FAINT
    annotate.write(draw, (18, 50), text, size=18, bold=nothing, colour=colour)
    least, needle = scene_parts.LEAST_NEEDLE_MM, "needle"
    if case.needle.radius_mm < least:
        needle = f"needle (drawn ⌀ {2 * least:g} mm, is ⌀ {case.needle.diameter_mm:g} mm)"
    items = [("target", palette.TARGET_POINT), (needle, palette.NEEDLE)]
    if candidates.safe.any():
        items.append((f"{candidates.safe_text}: safe entry area and corridor (overview)", SAFE))
    items.append(("skin (see-through)", palette.SKIN))
    if arm:
        shown = f"arm ({plan.model.name})" if plan is not None else "arm, as the search reaches this direction"
        items += [(shown, palette.ARM), ("needle holder", palette.HOLDER), ("position of its base", palette.TABLE)]
    named = [(body, body.name + (" (see-through)" if body.alpha < 1 else "")) for body in bodies]
    items += [(name, body.colour) for body, name in named if body.group == "room"]
    below = annotate.legend(draw, items, 20, LEGEND_TOP, WIDTH - 20)
    names = [(name, body.colour) for body, name in named if body.group == "organ"]
    note = "research software, not a medical device"
    annotate.write(draw, (WIDTH - 18, 24), note, size=14, colour=annotate.FAINT, anchor="ra")
    return annotate.legend(draw, families(names), 20, below, WIDTH - 20)


def _path_text(scene: Scene, *, arm: bool) -> str:
    plan, pick, scan = scene.plan, scene.chosen, scene.anatomy.scan
    if plan is not None:
        theta, beta = np.degrees(plan.theta), np.degrees(plan.beta)
        length = float(np.linalg.norm(plan.entry_ct - plan.target_ct))
    else:
        assert pick is not None
        theta, beta = np.degrees(pick.candidates.theta[pick.row]), np.degrees(pick.candidates.beta[pick.row])
        length = float(pick.candidates.path.length[pick.row])
    text = f"θ {theta:g}°, β {beta:g}°, {length_text(length, scan)} in the body"
    if pick is not None:
        text += f"; {nearest_text(*pick, scan)}"
    if arm:
        return text
    failed = bool(scene.refusal)
    return text + ("  PLANNING FAILED: no arm is shown" if failed else "  (no plan was requested: no arm is shown)")


def families(names: list[tuple[str, Rgb]]) -> list[tuple[str, Rgb]]:
    """Legend entries, with numbered families (ribs, vertebrae) folded into one when there are many."""
    if len(names) <= MOST_ENTRIES:
        return names
    folded: dict[tuple[str, Rgb], int] = {}
    for name, colour in names:
        key = name.split("_")[0], colour
        folded[key] = folded.get(key, 0) + 1
    first = {(name.split("_")[0], colour): name for name, colour in reversed(names)}
    return [(f"{k[0]} ({n})" if n > 1 else first[k], k[1]) for k, n in folded.items()]
