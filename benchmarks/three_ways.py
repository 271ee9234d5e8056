"""Eight ways to guide one needle, for the same patients: what was predicted beside what was realised.

python -m benchmarks.three_ways                200 rooms a way and situation, a minute
python -m benchmarks.three_ways --rooms 20000  for coverage and calibration: minutes
python -m benchmarks.three_ways --picture FILE the error clouds instead of docs/pictures/three_ways.png

The embedded abdomen, its best direction, with two cameras and a probe whose places the program proposes, and what they
see there. A hit is a tip within 2 mm of the true target. The calibration error is the mean difference of predicted
chance and realised fraction over radii from .25 to 4 mm.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from benchmarks.shared import REPOSITORY
from puncture_twin import api as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.budget.guidance import sight_of
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import Motion, Stereo, Ultrasound
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.uncertainty.chance_model import chance_model
from puncture_twin.planning.uncertainty.guided import WAYS
from puncture_twin.planning.uncertainty.hit import hit_in_ball
from puncture_twin.planning.uncertainty.pose_error import pose_error
from puncture_twin.twin.rehearsal.distribution import Distribution, rehearse_trials

HIT_MM, SHOWN_MM = 2.0, 4.0
"""Radius of a hit, and half the side of a picture's panel."""

DIRECTION_DEG = (64.0, 98.0)
RADII_MM = np.geomspace(0.25, 4.0, 9)
SLICES = np.diag([0.7**2, 0.7**2, 5.0**2]) / 12.0
SHOWN = "target moves 1.1 mm along the feet"
HEAD = "predicted realised  ratio region   hits p_hit touch stops   calibration"


def moved(case: Case, *deviations_mm: float) -> Case:
    """The case with other motion of the target since the scan, mm per axis."""
    return replace(case, motion=Motion(np.diag(np.square(deviations_mm))))


def situations(case: Case) -> dict[str, Case]:
    """What the case may be like, by name."""
    assert case.errors is not None and case.ultrasound is not None
    arm = replace(case.errors.arm, link_mm=0.5, twist=np.radians(0.05), joint=np.radians(0.1))
    coarse = replace(case.ultrasound, target_sd_mm=(0.6, 1.0), tip_sd_mm=(0.3, 1.0))
    return {
        "as declared": case,
        "nominal arm": replace(case, errors=replace(case.errors, arm=arm)),
        "CT slices of 5 mm": replace(case, errors=replace(case.errors, marker_cov_ct=SLICES, target_cov_ct=SLICES)),
        SHOWN: moved(case, 0.0, 0.0, 1.1),
        "target moves 3 mm to any side": moved(case, *(3.0 / np.sqrt(3.0),) * 3),
        "pictures read half as well": replace(case, ultrasound=coarse),
    }


def prepared(context: CaseContext, case: Case) -> CaseContext:
    """The context of a case that differs in errors, devices or motion alone."""
    placement = load_placement(case)
    error = None if placement is None else pose_error(case, placement.registration)
    chance = chance_model(case, context.anatomy, context.engine, error)
    return replace(context, case=case, placement=placement, chance=chance)


class Row(NamedTuple):
    """One way in one situation."""

    situation: str
    way: str
    found: Distribution

    @property
    def calibration(self) -> float:
        """Mean difference of the chance to be within a radius and the fraction of trials that were."""
        chances = [hit_in_ball(self.found.cov_ct[None], mm)[0] for mm in RADII_MM]
        return float(np.mean(np.abs(chances - (self.found.tip_error_mm[:, None] < RADII_MM).mean(axis=0))))

    def __str__(self) -> str:
        found, said = self.found, self.found.summary()
        return (
            f"{found.predicted_rms_mm:9.2f} {found.realised_rms_mm:8.2f} "
            f"{found.predicted_rms_mm / found.realised_rms_mm:6.3f} {said['coverage_95']:6.3f} "
            f"{said['hit_share']:6.3f} {said['mean_p_hit']:5.3f} {said['touch_share']:5.3f} "
            f"{said['stopped']:5d} {self.calibration:13.4f}"
        )


def rows(context: CaseContext, plan: Plan, rooms: int, seed: int = 7) -> Iterator[Row]:
    """All ways in all situations, the same patients in each situation."""
    sight = sight_of(context, plan, "all")
    for name, case in situations(context.case).items():
        there = prepared(context, case)
        for way in WAYS:
            q = plan.insertion.q[-1]
            yield Row(name, way, rehearse_trials(there, plan.outward_ct, q, rooms, seed, way, sight))


def draw(shown: dict[str, Distribution], outward_ct: Floats, path: Path) -> None:
    """The error clouds of the ways in the needle's axes, each with its predicted 95 % ellipse, and the hit's circle."""
    across = np.array([0.0, 0.0, 1.0]) - outward_ct[2] * outward_ct
    R = np.stack([across / np.linalg.norm(across), outward_ct], axis=1)
    figure = Figure(figsize=(11, 6.2), layout="constrained")
    for axis, (way, found) in zip(figure.subplots(2, 4, sharex=True, sharey=True).flat, shown.items(), strict=True):
        axis.scatter(*(found.error_ct @ R).T, s=5, color="#0072B2", alpha=0.5, linewidths=0)
        values, axes = np.linalg.eigh(R.T @ found.cov_ct @ R)
        width, height = 2.0 * np.sqrt(5.991 * values)  # chi-squared of two degrees, 95 %
        lean = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
        axis.add_patch(Ellipse((0, 0), width, height, angle=lean, fill=False, edgecolor="#D55E00", linewidth=1.6))
        axis.add_patch(Ellipse((0, 0), 2 * HIT_MM, 2 * HIT_MM, fill=False, edgecolor="#666666", linestyle=":"))
        axis.set(xlim=(-SHOWN_MM, SHOWN_MM), ylim=(-SHOWN_MM, SHOWN_MM), aspect="equal")
        hits = f"{100 * (found.hit_share or 0.0):.1f} % within {HIT_MM:g} mm"
        axis.set_title(f"{way}: {found.realised_rms_mm:.2f} mm rms\n{hits}", fontsize=10)
    figure.supxlabel("across the needle, toward the head, mm")
    figure.supylabel("out along the needle, mm")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Rehearse, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=200)
    parser.add_argument("--picture", type=Path, default=REPOSITORY / "docs" / "pictures" / "three_ways.png")
    options = parser.parse_args()
    context = pt.prepare(folder() / "abdomen" / "case.toml")
    probe = Ultrasound(context.case.robot.model, None, (0.3, 0.5), (0.08, 0.5), 0.07, 150.0, 40.0)
    case = replace(context.case, hit_radius_mm=HIT_MM, stereo=Stereo(None, (80.0, 160.0), 0.03), ultrasound=probe)
    context = prepared(context, case)
    theta, beta = DIRECTION_DEG
    plan = pt.plan(context, theta_deg=theta, beta_deg=beta)
    shown: dict[str, Distribution] = {}
    last = ""
    for row in rows(context, plan, options.rooms):
        if row.situation != last:
            print(f"\n{row.situation}, {options.rooms} rooms a way\n{'':10s} {HEAD}")
            last = row.situation
        print(f"{row.way:10s} {row}", flush=True)
        if row.situation == SHOWN:
            shown[row.way] = row.found
    print("\nfrom where, of the variance:")
    for way, found in shown.items():
        parts = sorted(found.budget.fraction.items(), key=lambda part: -part[1])
        print(f"{way:10s} {', '.join(f'{name} {100 * part:.0f} %' for name, part in parts if part >= 0.05)}")
        for lost in found.hidden:
            print(f"{'':10s} {lost}")
    draw(shown, plan.outward_ct, options.picture)


if __name__ == "__main__":
    main()
