"""Draw the picture of breathing from the code that it explains: ``python docs/motion_pictures.py``."""

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from puncture_twin.meshes import folder
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.breathing.lujan import fraction_within, positions
from puncture_twin.planning.formats.labels.by_name import ByName
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.organs import organ_candidates
from puncture_twin.planning.search.search import case_directions

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
    directions = case_directions(context.case)

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


def main():
    """The picture."""
    figure = plt.figure(figsize=(11, 6))
    draw_curve(figure.add_subplot(1, 2, 1))
    draw_directions(figure.add_subplot(1, 2, 2, projection="polar"))
    figure.tight_layout()
    figure.savefig(PICTURES / "breathing.png", dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    main()
