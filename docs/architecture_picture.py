"""Draw docs/pictures/architecture.png: the rooms of the house and who imports whom, from the imports in the sources.

An arrow is left out where a chain of other arrows says the same, so each one that is drawn is needed.
"""

import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.path import Path as Curve

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from walls.house import arrows, is_package, modules  # noqa: E402  (the walls that the tests hold read the same imports)

COLORS = {"planning": ("#dbe9f6", "#1f4e8c"), "twin": ("#fbe5d0", "#a65e12"), "": ("#e8e8e8", "#444444")}
WIDTH, STEP = 2.5, 1.9
"""Distance of two columns, and of two levels."""
COLUMNS = {
    "run_twin": 1.15, "api": 2.3, "twin/jobs": 1.15,
    "twin/experiment": -3.8, "twin/guidance/ultrasound": -2.7, "twin/guidance/stereo": -1.6, "twin/rehearsal": -0.5,
    "twin/report": 0.6, "twin/guidance/ct": 1.7, "twin/plant": -1.6, "twin/world": -0.5,
    "planning/export": 1.7, "planning/touch": 2.8, "planning/collision_cases": 3.9,
    "planning/place": 0.6, "planning/plan": 1.7, "planning/certify": 2.8, "planning/batch": 3.9,
    "planning/budget": 5.0, "planning/sweep": 6.1, "planning/visibility": 5.0,
    "planning/search": 2.8, "planning/uncertainty": 2.8,
    "planning/registration": 0.6, "planning/motion": 1.7, "planning/reach": 2.8,
    "planning/collision": 1.7, "planning/clearance": 3.5, "planning/init": 4.6,
    "planning/anatomy": 2.3, "planning/case": 2.3, "planning/arm": 1.2, "planning/breathing": 2.3,
    "planning/needle": 3.4, "planning/formats": 2.3, "planning/geometry": 2.3, "planning/base": 2.3, "meshes": 1.2,
}  # fmt: skip
"""Where each room stands from left to right; a room that is not listed goes to the far right of its level."""


def room_of(name):
    """The room, such as ``planning/search``, in which a module lies; None for what only groups rooms."""
    parts = name.split(".")[1:]
    if not parts or parts[0] not in ("planning", "twin"):
        return parts[0] if parts else None
    apart = parts[:2] == ["twin", "guidance"]
    depth = 3 if apart else 2
    return "/".join(parts[:depth]) if len(parts) >= depth else None


def room_graph():
    """Room to the rooms that it imports, and room to its number of modules."""
    graph, sizes = defaultdict(set), defaultdict(int)
    for name, targets in arrows().items():
        room = room_of(name)
        if room is None:
            continue
        sizes[room] += not is_package(name)
        graph[room] |= {other for target in targets if (other := room_of(target)) not in (None, room)}
    return dict(graph), dict(sizes)


def levels(graph):
    """Room to its height: just above what it imports; in the twin, just below what imports it."""

    @cache
    def low(room):
        return 1 + max((low(other) for other in graph[room]), default=-1)

    @cache
    def high(room):
        users = [other for other in graph if room in graph[other]]
        hangs = users and not room.startswith("planning")
        return min(high(other) for other in users) - 1 if hangs else low(room)

    return {room: high(room) for room in graph}


def needed(graph):
    """The arrows that no chain of others implies."""

    @cache
    def below(room):
        return frozenset(graph[room]).union(*(below(other) for other in graph[room]))

    return {
        (room, other)
        for room, others in graph.items()
        for other in others
        if not any(other in below(between) for between in others)
    }


def places(graph):
    """Room to its (x, y)."""
    height = levels(graph)
    new = sorted(set(graph) - set(COLUMNS))
    column = COLUMNS | {room: 5.6 + index for index, room in enumerate(new)}
    return {room: (WIDTH * column[room], STEP * height[room]) for room in graph}


def draw(graph, sizes):
    """The figure."""
    edges, at = needed(graph), places(graph)
    figure, ax = plt.subplots(figsize=(22, 20), dpi=72)
    for room, other in sorted(edges):
        arrow(ax, at[room], at[other], room)
    for room in graph:
        box(ax, *at[room], room, sizes[room])
    total = sum(map(len, graph.values()))
    title = f"{len(graph)} rooms and {total} arrows between them, none in a circle: from a room to what it imports."
    ax.set_title(f"{title}\nDrawn are the {len(edges)} that no chain of others implies", fontsize=14)
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_axis_off()
    figure.tight_layout()
    return figure


def colors(room):
    """Fill and line."""
    return COLORS[room.split("/")[0] if "/" in room else ""]


def box(ax, x, y, room, size):
    """A room with its name and its number of modules."""
    fill, line = colors(room)
    style = {"boxstyle": "round,pad=0.02,rounding_size=0.12", "facecolor": fill, "edgecolor": line, "linewidth": 1.4}
    ax.add_patch(FancyBboxPatch((x - 1.18, y - 0.5), 2.36, 1.0, zorder=3, **style))
    name = (room.partition("/")[2] or room).replace("guidance/", "guidance/\n").replace("collision_", "collision_\n")
    middle = {"ha": "center", "va": "center", "zorder": 4}
    ax.text(x, y + 0.13, name, fontsize=12, weight="bold", color=line, linespacing=0.85, **middle)
    count = "data" if size == 0 else f"{size} module{'s' * (size > 1)}"
    ax.text(x, y - 0.35, count, fontsize=10, **middle)


def arrow(ax, start, end, room):
    """A curve that leaves a room downward and comes to the other from above."""
    (x, y), (to_x, to_y) = start, end
    y, to_y = y - 0.52, to_y + 0.54
    bend = 0.45 * (y - to_y)
    curve = Curve([(x, y), (x, y - bend), (to_x, to_y + bend), (to_x, to_y)], [Curve.MOVETO, *[Curve.CURVE4] * 3])
    style = {"arrowstyle": "-|>", "mutation_scale": 13, "linewidth": 1.4, "color": colors(room)[1], "alpha": 0.8}
    ax.add_patch(FancyArrowPatch(path=curve, zorder=2, **style))


def main() -> None:
    """Write the picture."""
    assert modules()
    draw(*room_graph()).savefig(Path(__file__).parent / "pictures" / "architecture.png", bbox_inches="tight")


if __name__ == "__main__":
    main()
