"""Draw docs/frames.png: the frames and angles of the project, from the code that computes them."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse

from puncture_twin.planning.case.entry import outward

COLORS = ("#c0392b", "#1e8449", "#1f4e8c")
THETA, BETA = np.radians(40), np.radians(60)
LENGTH, STANDOFF, PATH = 2.1, 1.5, 1.0


def arrow(ax, start, vector, color, label, *, width=2.0):
    """An arrow with its name at the tip."""
    ax.quiver(*start, *vector, color=color, linewidth=width, arrow_length_ratio=0.12)
    ax.text(*(start + 1.12 * np.asarray(vector)), label, color=color, ha="center", va="center", fontsize=10)


def frame(ax, origin, R, names, *, size=1.0):
    """Three axes."""
    for axis, color, name in zip(R.T, COLORS, names, strict=True):
        arrow(ax, np.asarray(origin), size * axis, color, name)


def angles_panel(ax):
    """θ, β, standoff and needle in the entry frame."""
    ax.set_title("Entry frame at the target f: θ, β, r, l", fontsize=12)
    frame(ax, np.zeros(3), np.eye(3), ("x", "y", "z"), size=1.3)
    u = outward(THETA, BETA)
    tip, top = STANDOFF * u, (STANDOFF + LENGTH) * u
    ax.plot(*np.stack([np.zeros(3), tip], axis=1), "--", color="gray")
    ax.plot(*np.stack([tip, top], axis=1), color="black", linewidth=3)
    ax.scatter(*tip, color="black")
    ax.scatter(0, 0, 0, color="#c0392b", s=40)
    ax.scatter(*(PATH * u), color="#b9770e", s=40)
    ax.text(*(PATH * u + [0.1, 0.1, -0.25]), "entry point", color="#b9770e")
    ax.text(*(tip * 0.62 + [-0.55, 0, 0.1]), "standoff r", color="gray")
    ax.text(*((tip + top) / 2 + [0.15, 0.15, 0]), "needle, length l\n(tip to flange)")
    ax.text(*(top + [0, 0, 0.2]), "flange, its z = -u", ha="center")
    ax.text(0.08, -0.1, -0.35, "target f", color="#c0392b")
    turn = np.linspace(0, 1, 40)
    arc = 0.75 * outward(THETA * turn, np.full(40, BETA))
    ax.plot(*arc.T, color="#1f4e8c")
    ax.text(*(0.95 * outward(THETA / 2, BETA)), "θ", color="#1f4e8c", fontsize=13)
    flat = 0.6 * outward(np.full(40, np.pi / 2), BETA * turn)
    ax.plot(*flat.T, color="#c0392b")
    ax.text(*(0.8 * outward(np.pi / 2, BETA / 2)), "β", color="#c0392b", fontsize=13)
    foot = top * [1, 1, 0]
    ax.plot(*np.stack([np.zeros(3), foot], axis=1), ":", color="#c0392b")
    ax.set(xlim=(-0.4, 1.5), ylim=(-0.2, 2.1), zlim=(0, 2.6))
    ax.view_init(elev=22, azim=-35)


def patient_panel(ax):
    """LPS and the bed frame on an axial slice of a patient who lies on the back, seen from the feet."""
    ax.set_title("Axial slice seen from the feet, patient on the back", fontsize=12)
    ax.add_patch(Ellipse((0, 0), 3.2, 2.1, facecolor="#f3e6da", edgecolor="#b08d6a", linewidth=2))
    ax.add_patch(Ellipse((-0.75, 0.2), 1.1, 1.0, facecolor="#d9a08a", edgecolor="none"))
    ax.add_patch(Ellipse((0, -0.62), 0.5, 0.42, facecolor="#e9e2cf", edgecolor="#b08d6a"))
    ax.plot([-2, 2], [-1.15, -1.15], color="gray", linewidth=5)
    sides = {"front (anterior)": (0, 1.72), "back, on the table": (0, -1.36)}
    sides |= {"patient's\nright": (-2.05, -0.25), "patient's\nleft": (2.05, -0.25)}
    for text, (x, y) in sides.items():
        ax.text(x, y, text, ha="center", va="center", color="gray", weight="bold")
    target = np.array([-0.6, 0.25])
    ax.plot(*target, "o", color="#c0392b")
    flat_arrow(ax, target, (0, 1.0), COLORS[2], "z: front")
    flat_arrow(ax, target, (-1.0, 0), COLORS[1], "y: right")
    into_page(ax, target + [0.12, -0.14], COLORS[0], "x: head (into the page)")
    corner = np.array([1.15, 0.75])
    flat_arrow(ax, corner, (0.7, 0), COLORS[0], "L (x)")
    flat_arrow(ax, corner, (0, -0.7), COLORS[1], "P (y)")
    into_page(ax, corner + [0.0, 0.16], COLORS[2], "S (z)")
    ax.text(1.45, 1.25, "CT frame, LPS", ha="center", weight="bold")
    ax.text(-0.6, -0.16, "entry frame “bed”\nat the target", ha="center", va="top", weight="bold", fontsize=9)
    ax.set(xlim=(-2.5, 2.5), ylim=(-1.6, 1.9))


def flat_arrow(ax, start, vector, color, label):
    """An arrow in the page with its name at the tip."""
    end = np.asarray(start) + vector
    ax.annotate("", xy=end, xytext=start, arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 2.2})
    ax.text(*(end + 0.14 * np.asarray(vector)), label, color=color, ha="center", va="center", fontsize=10)


def into_page(ax, center, color, label):
    """The tail of an arrow that points away from the viewer."""
    ax.plot(*center, "o", markersize=12, markerfacecolor="white", markeredgecolor=color, markeredgewidth=2)
    ax.plot(*center, "x", markersize=7, color=color, markeredgewidth=2)
    ax.text(center[0] + 0.13, center[1], label, color=color, va="center", fontsize=9)


def main() -> None:
    """Write the picture beside this file."""
    figure = plt.figure(figsize=(13, 6.2), dpi=110)
    for place, panel, projection in ((121, angles_panel, "3d"), (122, patient_panel, None)):
        ax = figure.add_subplot(place, projection=projection)
        panel(ax)
        ax.set_axis_off()
        ax.set_aspect("equal")
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("frames.png"))


if __name__ == "__main__":
    main()
