"""Draw the pictures of breathing and of the needle in tissue from the code: ``python docs/motion_pictures.py``."""

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from puncture_twin.meshes import folder
from puncture_twin.planning.breathing.breathing import Breathing, fraction_within, positions
from puncture_twin.planning.formats.labels.naming import ByName
from puncture_twin.planning.needle.deflection import GAUGES, Layer, Shaft, Tissue, bevel_path
from puncture_twin.planning.needle.insertion_force import insertion_force
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates

PICTURES = Path(__file__).parent / "pictures"
BLUE, ORANGE, GREEN, RED, GREY = "#1f4e8c", "#b9770e", "#1e8449", "#c0392b", "#d9d9d9"

WEIGHTS = {
    "*": 0.0,
    "skin": 0.3,
    "liver": 1.0,
    "gallbladder": 1.0,
    "portal_vein": 0.9,
    "hepatic_veins": 1.0,
    "kidney_*": 0.7,
    "spleen": 0.9,
    "pancreas": 0.6,
    "stomach": 0.8,
    "duodenum": 0.5,
    "colon": 0.5,
    "small_bowel": 0.4,
    "heart": 0.3,
    "lung_*": 0.8,
    "vena_cava_inferior": 0.3,
}
"""Invented, as every weight that nobody has measured in the patient."""

GATE = 0.25


def abdomen_breath(gate: float | None) -> Breathing:
    """Twelve millimetres to the feet, cos^4, eight phases, scanned at exhale."""
    return Breathing(12.0, np.array([0.0, 0.0, -1.0]), ByName(WEIGHTS), 8, 2, 0.0, gate)


def draw_curve(axes):
    """Position over a period for three exponents, the phases, and the gate."""
    t = np.linspace(0, 1, 400)
    for exponent, colour in ((1, ORANGE), (2, BLUE), (4, GREEN)):
        part = fraction_within(GATE, exponent)
        label = f"cos$^{2 * exponent}$: {100 * part:.0f} % of the time in the gate"
        axes.plot(t, np.sin(np.pi * t) ** (2 * exponent), color=colour, label=label)
    phases = np.arange(8) / 8
    axes.plot(phases, np.sin(np.pi * phases) ** 4, "o", color=BLUE)
    axes.axhspan(0, GATE, color=BLUE, alpha=0.12)
    axes.text(0.5, GATE - 0.02, "gate", color=BLUE, ha="center", va="top")
    axes.set(xlabel="time over period", ylabel="position s: 0 exhale, 1 full inhale", xlim=(0, 1), ylim=(0, 1.04))
    axes.set_yticks(positions(8, 2)[[0, 2, 3, 4]].round(2))
    axes.legend(loc="upper left", fontsize=8, bbox_to_anchor=(0, -0.14), frameon=False)


def draw_directions(axes):
    """What the breath leaves of the abdomen's directions: safe for the organs, without the arm."""
    context = prepare(folder() / "abdomen", arm=False)
    directions = context.case.directions()

    def searched(breath):
        return organ_candidates(replace(context.case, breathing=breath), context.anatomy, context.engine, directions)

    static, gated = searched(None).safe, searched(abdomen_breath(GATE))
    every = gated.breathing.safe_all_phases
    kinds = (
        (~static, GREY, "rejected there"),
        (static, RED, "safe where the CT shows the body"),
        (gated.safe, ORANGE, f"safe when gated to s $\\leq$ {GATE:g}"),
        (every, GREEN, "safe at each phase if inserted at that phase"),
    )
    for rows, colour, words in kinds:
        label = f"{words}: {int(rows.sum()):,}"
        axes.scatter(directions.beta[rows], np.degrees(directions.theta[rows]), s=5, color=colour, label=label)
    axes.set_rlabel_position(45)
    axes.set_title(" ")  # room for the label at the top
    axes.legend(loc="upper center", fontsize=8, bbox_to_anchor=(0.5, -0.07), frameon=False, markerscale=3)


def draw_bevel(axes):
    """The needle in tissues of three stiffnesses, and a turned one."""
    shaft, count = Shaft(200.0, *GAUGES[18]), 120
    for k, colour in ((0.01, GREEN), (0.1, BLUE), (0.4, ORANGE)):
        path = bevel_path(shaft, np.full(count, k), np.full(count, np.radians(1.0)), 1.0)
        axes.plot(path.depth_mm, path.cut_mm, color=colour, label=f"path cut, k = {k:g} N/mm²")
        axes.plot(path.depth_mm, path.needle_mm, "--", color=colour, linewidth=1)
    rotated = np.radians(np.where(np.arange(count) < 30, 1.0, -1.0))
    path = bevel_path(shaft, np.full(count, 0.1), rotated, 1.0)
    axes.plot(path.depth_mm, path.cut_mm, color=RED, label="turned by 180° at 30 mm, k = 0.1")
    axes.plot([], [], "--", color="grey", linewidth=1, label="the shaft, once all is in")
    axes.set(xlabel="depth in tissue, mm", ylabel="off the straight line, mm", title="18G tube, bevel 1°")
    axes.legend(fontsize=8, frameon=False)


def draw_force(axes):
    """The axial force through skin, fat and liver, by its terms."""
    layers = (
        Layer(0.0, 25.0, Tissue(0.03, 0.4, 0.01, 4.0, 5.0)),
        Layer(25.0, 80.0, Tissue(0.1, 0.9, 0.02, 1.5, 3.0)),
    )
    found = insertion_force(layers)
    parts = (found.friction_n, found.cutting_n, found.capsule_n)
    axes.stackplot(found.depth_mm, *parts, colors=(GREY, BLUE, ORANGE), labels=("friction", "cutting", "capsule"))
    free = Shaft(150.0, *GAUGES[18]).buckling_n(pinned=False)
    axes.axhline(free, color=RED, linewidth=1, label=f"18G tube of 150 mm buckles, tip free: {free:.1f} N")
    axes.set(xlabel="depth of the tip, mm", ylabel="axial force, N", xlim=(0, 80), ylim=(0, 5.2))
    axes.set_title("skin at 0, liver from 25 mm; numbers invented")
    axes.legend(fontsize=8, frameon=False, loc="upper right")


def save(figure, name):
    """Write one picture."""
    figure.tight_layout()
    figure.savefig(PICTURES / name, dpi=100)
    plt.close(figure)


def main():
    """Both pictures."""
    figure = plt.figure(figsize=(11, 6))
    draw_curve(figure.add_subplot(1, 2, 1))
    draw_directions(figure.add_subplot(1, 2, 2, projection="polar"))
    save(figure, "breathing.png")
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6))
    draw_bevel(left)
    draw_force(right)
    save(figure, "needle_and_tissue.png")


if __name__ == "__main__":
    main()
