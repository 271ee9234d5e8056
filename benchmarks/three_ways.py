"""Eight ways to guide one needle, for the same patients: what was predicted beside what was realised.

python -m benchmarks.three_ways                200 rooms a way and situation, a minute
python -m benchmarks.three_ways --rooms 20000  for coverage and calibration: minutes
python -m benchmarks.three_ways --steps        the table of control scans alone; no picture
python -m benchmarks.three_ways --picture FILE the error clouds instead of docs/pictures/three_ways.png

The embedded abdomen, its best direction, with two cameras and a probe whose places the program proposes, and what they
see there. A hit is a tip within 2 mm of the true target. The calibration error is the mean difference of predicted
chance and realised fraction over radii from .25 to 4 mm.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.shared import REPOSITORY, options
from puncture_twin import api as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.budget.guidance import sight_of
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import Motion, Stereo, Ultrasound
from puncture_twin.planning.case.tables import ControlScanSection
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.planning.search.chances import chance_model
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.uncertainty.guided import WAYS
from puncture_twin.planning.uncertainty.hit import hit_in_ball
from puncture_twin.planning.uncertainty.pose_error import pose_error
from puncture_twin.twin.jobs.patient.guidance_job import COLOURS, rated
from puncture_twin.twin.rehearsal.distribution import Distribution, rehearse_trials
from puncture_twin.twin.report.error_pictures import draw_clouds

HIT_MM = 2.0
"""Radius of a hit."""
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


STEPS = (1, 2, 3, 5, 10)


def stepwise(context: CaseContext, plan: Plan, rooms: int, seed: int = 7) -> Iterator[str]:
    """Rows of a table: control scans after so many steps, the same patients in each situation."""
    yield "situation | steps | tip error | predicted | in region | hits | passes | scans | mSv | min | corrections"
    moving_min = (plan.approach.duration_s + plan.insertion.duration_s) / 60.0
    cases = situations(context.case)
    unseen = replace(
        cases[SHOWN], control_scan=ControlScanSection(slice_mm=2.0, target_seen=False, dose_msv=0.9, seconds=120.0)
    )
    shown = {name: cases[name] for name in ("as declared", SHOWN, "target moves 3 mm to any side")}
    for name, case in {**shown, f"{SHOWN}, unseen": unseen}.items():
        there = prepared(context, case)
        for steps in (None, *STEPS):
            found = rehearse_trials(there, plan.outward_ct, plan.insertion.q[-1], rooms, seed, "ct", steps=steps)
            said, one = found.summary(), found.stepwise
            cells = (f"{found.realised_rms_mm:.2f}", f"{found.predicted_rms_mm:.2f}", f"{said['coverage_95']:.3f}",
                     f"{said['hit_share']:.3f}")  # fmt: skip
            cost = ("0", "0", "0", f"{moving_min:.1f}", "-")
            if one is not None:
                sizes = ", ".join("-" if mm is None else f"{mm:.2f}" for mm in one.correction_mm)
                minutes = moving_min + one.seconds / 60.0
                cost = (f"{one.passes:.2f}", f"{one.scans:.2f}", f"{one.dose_msv:.1f}", f"{minutes:.1f}", sizes)
            yield " | ".join((name, str(steps or "open loop"), *cells, *cost))


def main() -> None:
    """Rehearse, print, draw."""
    stated = options(__doc__, rooms=200, picture=REPOSITORY / "docs" / "pictures" / "three_ways.png", steps=False)
    context = pt.prepare(folder() / "abdomen" / "case.toml")
    probe = Ultrasound(context.case.robot.model, None, (0.3, 0.5), (0.08, 0.5), 0.07, 150.0, 40.0)
    case = replace(context.case, hit_radius_mm=HIT_MM, stereo=Stereo(None, (80.0, 160.0), 0.03), ultrasound=probe)
    context = prepared(context, case)
    theta, beta = DIRECTION_DEG
    plan = pt.plan(context, theta_deg=theta, beta_deg=beta)
    if stated.steps:
        for line in stepwise(context, plan, stated.rooms):
            print(line, flush=True)
        return
    shown: dict[str, Distribution] = {}
    last = ""
    for row in rows(context, plan, stated.rooms):
        if row.situation != last:
            print(f"\n{row.situation}, {stated.rooms} rooms a way\n{'':10s} {HEAD}")
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
    drawn = [(one.distribution, one.rating, COLOURS[one.rating]) for one in rated(list(shown.values()))]
    draw_clouds(drawn, plan.outward_ct, stated.picture, HIT_MM, columns=4)


if __name__ == "__main__":
    main()
