"""``placements.png``: the fraction that the arm reaches from each position, each way of mounting it seen from above."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MultipleLocator
from scipy.spatial import ConvexHull

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.collision.workcell import case_boxes
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.place.mounts import Region
from puncture_twin.planning.place.search import PlaceSearch, RatedPlacement
from puncture_twin.twin.report.figures import halo, write_png
from puncture_twin.twin.report.numbers import direction_text, mounting_text, needle_text, target_text

DPI = 110
PANEL_INCHES = 4.3
MOST_COLUMNS = 4
SHADES = colormaps["viridis"]
NOTHING: tuple[float, float, float] = (0.9, 0.9, 0.9)  # where nothing is reached, or the base is in something
SEEN_FROM_ABOVE = (1, 0)  # the bed's axes to the right and up: across (to the left from above), along
EDGE_CELLS = 1.6  # white about the cells of the widest panel, for the body directions
TICKS_MM = 500.0
ALL_OF_IT = 1.0 - 5e-4  # a fraction that is printed as the whole
HALO = halo(2.5)
SAME_AXIS = 0.94  # cosine from which the case's own base axis is a panel's (20 degrees)
LABELS_ALONG_MM, LABELS_ACROSS_MM = 200.0, 900.0  # nearer marks have the upper one's label above it


def draw_placements(search: PlaceSearch, case: Any, skin: TriangleMesh, path: Path) -> None:
    """Write the map of the fractions reached over the position of the base."""
    of_panel: dict[str, list[Region]] = defaultdict(list)  # the two rails share one
    for region in dict.fromkeys(site.region for site, _ in search.coarse):
        of_panel["rail" if region.mount == "rail" else region.name].append(region)
    panels = list(of_panel.values())
    columns = min(MOST_COLUMNS, len(panels) + 1)
    rows = -(-(len(panels) + 1) // columns)
    figure = Figure(figsize=(columns * PANEL_INCHES, rows * PANEL_INCHES + 1.0), dpi=DPI, facecolor="white")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    top = max((e.fraction for _, e in search.coarse), default=0.0)
    scale = Normalize(0.0, max(top, max((one.verdict.fraction for one in search.rated), default=0.0), 0.01))
    points = np.array([site.position for site, _ in search.coarse])[:, SEEN_FROM_ABOVE]
    edge = EDGE_CELLS * float(case.place.step_mm)
    low, high = (points.min(axis=0) - edge).tolist(), (points.max(axis=0) + edge).tolist()
    for axes, regions in zip(grid, panels, strict=False):
        _panel(axes, regions, search, case, scale)
        _bed(axes, search, case, skin)
        axes.set(xlim=(high[0], low[0]), ylim=(low[1], high[1]))
    _legend(grid[len(panels)], figure, search, case, scale)
    for axes in grid[len(panels) + 1 :]:
        axes.set_axis_off()
    title = f"{case.name}: where to stand the {case.robot.model.name.upper()} for {target_text(case)}"
    figure.suptitle(f"{title}\n{needle_text(case)}", fontsize=14, fontweight="bold")
    figure.tight_layout(rect=(0, 0.02, 1, 0.98))
    figure.text(0.99, 0.006, "research software, not a medical device", fontsize=9, color="0.4", ha="right")
    write_png(figure, path)


def _panel(axes: Axes, regions: Sequence[Region], search: PlaceSearch, case: Any, scale: Normalize) -> None:
    best: dict[tuple[float, float], float] = {}
    for site, estimate in search.coarse:
        if site.region in regions:
            key = site.position[:2]
            best[key] = max(best.get(key, 0.0), estimate.fraction)
    step = float(case.place.step_mm)
    for (y, x), fraction in best.items():
        colour = SHADES(scale(fraction)) if fraction > 0 else NOTHING
        axes.add_patch(Rectangle((x - step / 2, y - step / 2), step, step, facecolor=colour, edgecolor="none"))
    space = str(case.space)
    text = mounting_text(regions[0], search.T_ct_bed, space) if len(regions) == 1 else regions[0].mount
    axes.set_title(text, fontsize=10.5, fontweight="bold")
    axes.set_aspect("equal")
    axes.tick_params(labelsize=8)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(TICKS_MM))
    axes.set_xlabel("across, mm", fontsize=8)
    axes.set_ylabel("along, mm", fontsize=8)
    _directions(axes, search, space)
    _marks(axes, regions, search, case)


def _directions(axes: Axes, search: PlaceSearch, space: str) -> None:
    R = search.T_ct_bed[:3, :3]
    look: dict[str, Any] = {"fontsize": 9, "path_effects": HALO, "zorder": 8, "transform": axes.transAxes}
    for direction, x, y, ha, va, text_angle in (
        (R[:, 0], 0.5, 0.985, "center", "top", 0),
        (-R[:, 0], 0.5, 0.015, "center", "bottom", 0),
        (R[:, 1], 0.015, 0.5, "left", "center", 90),
        (-R[:, 1], 0.985, 0.5, "right", "center", -90),
    ):
        axes.text(x, y, direction_text(direction, space), ha=ha, va=va, rotation=text_angle, **look)


def _marks(axes: Axes, regions: Sequence[Region], search: PlaceSearch, case: Any) -> None:
    marks = [
        (*one.site.position, rank, one)
        for rank, one in enumerate(search.rated, start=1)
        if one.site is not None and one.site.region in regions
    ]
    marked: list[tuple[float, float]] = []
    for along, across, height, rank, one in sorted(marks, key=lambda mark: mark[0]):
        crowded = any(along - a < LABELS_ALONG_MM and abs(across - b) < LABELS_ACROSS_MM for a, b in marked)
        text = f"{rank}: {_worth(one, search)}, h {height:+.0f}"
        _mark(axes, across, along, "*" if rank == 1 else "o", text, above=crowded)
        marked.append((along, across))
    if search.own is None:
        return
    T = np.linalg.inv(mount_pose(search.own.mount, case.space, case.path) @ search.T_ct_bed)
    if any(float(T[:3, 2] @ np.array(region.axis)) > SAME_AXIS for region in regions if region.mount != "rail"):
        _mark(axes, float(T[1, 3]), float(T[0, 3]), "D", f"now: {_worth(search.own, search)}, h {T[2, 3]:+.0f}")


def _worth(one: RatedPlacement, search: PlaceSearch) -> str:
    estimated = "~" if one.verdict.count < search.directions else ""
    return f"{estimated}{100 * one.verdict.fraction:.0f} %"


def _mark(axes: Axes, x: float, y: float, shape: str, text: str, *, above: bool = False) -> None:
    size = 230 if shape == "*" else 60
    axes.scatter([x], [y], s=size, marker=shape, c="white", edgecolors="black", linewidths=1.3, zorder=9)
    offset, align = ((0, 8 if above else -15), "center") if shape != "D" else ((8, -3), "left")
    look: dict[str, Any] = {"ha": align, "fontsize": 8.5, "path_effects": HALO, "zorder": 10}
    axes.annotate(text, (x, y), offset, textcoords="offset points", **look)


def _bed(axes: Axes, search: PlaceSearch, case: Any, skin: TriangleMesh) -> None:
    T_bed_ct = np.linalg.inv(search.T_ct_bed)
    carried = {obstacle.name for obstacle in case.obstacles if obstacle.frame == "base"}
    parts: dict[str, list[Floats]] = defaultdict(list)
    for box in case_boxes(case, np.eye(4)):
        if box.name not in carried:
            parts["gantry" if box.name.startswith("gantry_") else box.name].append(box.corners)
    things = [(np.concatenate(corners), {"ls": "--", "lw": 0.9}) for corners in parts.values()]
    for corners, look in [*things, (skin.vertices, {"ls": "-", "lw": 1.6})]:
        flat = (apply(T_bed_ct, corners))[:, SEEN_FROM_ABOVE]
        outline = flat[ConvexHull(flat).vertices]
        axes.add_patch(Polygon(outline, closed=True, fill=False, edgecolor="black", zorder=7, **look))
    axes.plot([0], [0], marker="+", color="red", ms=11, mew=2.0, zorder=8)


def _legend(axes: Axes, figure: Figure, search: PlaceSearch, case: Any, scale: Normalize) -> None:
    axes.set_axis_off()
    up = direction_text(search.T_ct_bed[:3, 2], str(case.space))
    text = (
        "HOW TO READ\n"
        f"Every panel looks down on the bed (toward you: {up or 'place.up'}).\n"
        "Ticks are mm from the target (red +). A cell is the middle\n"
        "of the base. Its colour is the ESTIMATED fraction of the\n"
        "organ-safe directions that the arm reaches, at the best height.\n"
        "Grey: none, or the base would be inside something.\n\n"
        "* best, o others: checked by the arm's own collision check;\n"
        "~ in some directions only. Rank, fraction, and height h of\n"
        "the base above the target, mm."
        + ("\nDiamond: the arm's present position in the case." if search.own is not None else "")
        + "\n\nSolid line: the patient from above. Dashed: table, gantry,\nother boxes.\n\n"
    )
    if search.possible < ALL_OF_IT:
        text += (
            f"No position reaches more than {100 * search.possible:.0f} %: in the other\n"
            "directions the needle would start too near the skin."
        )
    axes.text(0.0, 1.0, text, transform=axes.transAxes, fontsize=9.5, va="top", linespacing=1.35)
    bar = axes.inset_axes((0.0, 0.06, 0.95, 0.05))
    figure.colorbar(ScalarMappable(scale, SHADES), cax=bar, orientation="horizontal")
    bar.set_xlabel("estimated fraction of the organ-safe solid angle, 0..1", fontsize=9)
    bar.tick_params(labelsize=8)
