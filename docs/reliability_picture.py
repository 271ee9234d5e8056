"""Draw docs/pictures/reliability.png: predicted chances beside what happened in rooms drawn from the declaration.

    python docs/reliability_picture.py [--directions 40] [--rooms 1500]

Of the embedded abdomen with eight times its declared errors, and of the carton as it is, safe directions are drawn at
random and each is rehearsed in many rooms, with exact kinematics. Writes the expected calibration error (ECE).
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.rehearsal.distribution import rehearse_trials

ROOT = Path(__file__).parents[1]
CASES = {"abdomen, errors x 8": ("abdomen", 8.0), "carton": ("carton/case_m.toml", 1.0)}
BINS = 10
COLORS = {"hit": "#0072B2", "touch": "#D55E00"}


def rehearsed(path, factor, directions, rooms):
    """Predicted and realised share of hits and of touches, by structure, of random safe directions."""
    context = prepare(ROOT / "meshes" / path)
    if factor != 1.0:
        context = scaled(context, factor)
    found = context.search()
    rows = np.random.default_rng(0).permutation(found.ranked)[:directions]
    pairs = {"hit": [], "touch": []}
    for row in rows:
        done = rehearse_trials(context, found.outward_ct[row], found.arm.q_insertion[row], rooms, seed=int(row))
        pairs["hit"].append((done.p_hit, done.hit.mean()))
        pairs["touch"] += list(zip(done.p_touch, done.touched.mean(axis=0), strict=True))
    return {kind: np.array(values) for kind, values in pairs.items()}


def scaled(context, factor):
    """The context of a case whose errors are declared larger."""
    from puncture_twin.planning.registration import placement
    from puncture_twin.planning.search.chances import chance_model
    from puncture_twin.planning.uncertainty.pose_error import pose_error

    case = replace(load_case(context.case.path), errors=context.case.errors.scaled(factor))
    where = placement.load_placement(case)
    chance = chance_model(case, context.anatomy, context.engine, pose_error(case, where.registration))
    return replace(context, case=case, placement=where, chance=chance)


def calibration_error(pairs):
    """ECE of pairs of predicted and realised, in equal bins of the prediction, weighed by their number."""
    place = np.minimum((pairs[:, 0] * BINS).astype(int), BINS - 1)
    gaps = [abs(np.subtract(*pairs[place == k].mean(axis=0))) * np.mean(place == k) for k in set(place.tolist())]
    return float(sum(gaps))


def main():
    """Rehearse, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--directions", type=int, default=40)
    parser.add_argument("--rooms", type=int, default=1500)
    options = parser.parse_args()
    figure, axes = plt.subplots(1, 2, figsize=(9, 4.4), layout="constrained")
    for axis, (title, (path, factor)) in zip(axes, CASES.items(), strict=True):
        axis.plot([0, 1], [0, 1], color="#888888", linewidth=1)
        for kind, pairs in rehearsed(path, factor, options.directions, options.rooms).items():
            shown = (pairs.max(axis=1) > 1e-3) & (pairs.min(axis=1) < 1 - 1e-3)
            error = calibration_error(pairs)
            caption = (
                f"{title}: ECE of P({kind}) {error:.4f} over {len(pairs)} chances, {shown.sum()} of them not sure\n"
            )
            sys.stdout.write(caption)
            label = f"{kind}: ECE {error:.3f}"
            axis.scatter(*pairs[shown].T, s=14, color=COLORS[kind], alpha=0.6, label=label, linewidths=0)
        axis.set(title=title, xlabel="predicted chance", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        axis.legend(frameon=False, loc="upper left")
    axes[0].set_ylabel(f"share of {options.rooms} rooms")
    figure.savefig(ROOT / "docs" / "pictures" / "reliability.png", dpi=110)


if __name__ == "__main__":
    main()
