"""What a command answers, as plain values for ``--json``, the pages and the text: mm and degrees."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.containment import inside_each
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.registration.fits import Distortion
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import finite
from puncture_twin.planning.search.windows import Window
from puncture_twin.planning.uncertainty.chance_model import touch_limit

if TYPE_CHECKING:  # they bring the simulator with them
    from puncture_twin.twin.rehearsal.distribution import Distribution
    from puncture_twin.twin.rehearsal.result import Rehearsal


def registration_summary(registration: Registration) -> dict[str, Any]:
    """A registration as plain values: mm."""
    uncertainty = registration.uncertainty
    test = registration.residual_test if uncertainty is None else uncertainty.test
    return {
        "method": registration.method,
        "T_base_ct": registration.T_base_ct.tolist(),
        "residual_mm": dict(zip(registration.markers.names, registration.residual_mm.tolist(), strict=True)),
        "fre_mm": registration.fre_mm,
        "mean_error_mm": registration.mean_error_mm,
        "fle_mm": registration.fle_mm,
        "fle_source": registration.fle_source,
        "fle_interval_mm": list(registration.fle_interval_mm),
        "chi_squared": finite(test.chi_squared),
        "degrees_of_freedom": test.freedom,
        "noise_scale": test.scale,
        **_declared(registration),
        "spread_ratio": registration.conditioning.spread_ratio,
        "altitude_mm": registration.conditioning.altitude_mm,
        "leverage": registration.conditioning.leverage,
        "distortion": _distortion(registration.distortion),
        "flags": [flag.sentence for flag in registration.flags],
        "findings": [flag.document() for flag in registration.flags],
    }


def _distortion(found: Distortion | None) -> dict[str, Any] | None:
    return None if found is None else {**vars(found), "doubted": found.significant, "text": found.text()}


def _declared(registration: Registration) -> dict[str, Any]:
    """What declared errors add."""
    if registration.uncertainty is None:
        return {}
    test = registration.uncertainty.test
    return {
        "declaration": {
            "holds": test.agrees,
            "probability": test.probability,
            "residuals_over_declared": test.estimate,
            "interval": list(test.interval),
            "text": test.text(),
        }
    }


def window_summary(candidates: Candidates, window: Window) -> dict[str, Any]:
    """A window by its best candidate, as plain values: mm and degrees."""
    row = window.best
    return {
        "rank": int(candidates.ranking.rank[row]),
        **candidates.at(row),
        "cost": finite(candidates.ranking.cost[row]),
        "min_clearance_mm": finite(candidates.least_clearance[row]),
        "path_length_mm": finite(candidates.path.length[row]),
        "skin_angle_deg": finite(np.degrees(candidates.path.skin_angle[row])),
        "tissue_mm": finite(candidates.path.tissue[row]),
        "reach_margin": finite(candidates.arm.margin[row]),
        "safe_cone_deg": finite(np.degrees(candidates.safe_cone[row])),
        "pareto": bool(candidates.ranking.pareto[row]),
        "window": window.number,
        "window_directions": window.directions,
        "window_square_deg": window.square_deg,
        "window_entry_cm2": window.entry_cm2,
        "window_wide_deg": window.wide_deg,
        "window_widest_cone_deg": finite(np.degrees(window.widest_cone)),
    }


def plan_summary(plan: Plan) -> dict[str, Any]:
    """A plan's main numbers as plain values."""
    return {
        "theta_deg": float(np.degrees(plan.theta)),
        "beta_deg": float(np.degrees(plan.beta)),
        "entry_ct_mm": plan.entry_ct.tolist(),
        "standoff_mm": plan.standoff_mm,
        "expected_target_error_mm": finite(plan.expected_target_error_mm),
        "approach_s": float(plan.approach.times_s[-1]),
        "insertion_s": float(plan.insertion.times_s[-1]),
        "clearance_mm": {phase: finite(value) for phase, value in plan.clearance_mm.items()},
        **({"guidance": [one.document() for one in plan.guidance]} if plan.guidance else {}),
    }


def rehearsal_summary(rehearsal: Rehearsal) -> dict[str, Any]:
    """A rehearsal's main numbers as plain values."""
    return {
        "seed": rehearsal.seed,
        "tip_error_mm": rehearsal.tip_error_mm,
        "lateral_mm": rehearsal.lateral_mm,
        "depth_mm": rehearsal.depth_mm,
        "predicted_error_mm": finite(rehearsal.predicted_error_mm),
        "contacts": [f"{c.link} touches {c.body} at {c.time_s:.2f} s" for c in rehearsal.contacts],
        "least_clearance_mm": {name: float(np.min(values)) for name, values in rehearsal.clearance_mm.items()},
        "control": rehearsal.control,
        "off_path_mm": rehearsal.off_path_mm,
        "tissue_n": None if rehearsal.tissue_force is None else rehearsal.tissue_force._asdict(),
        "needle_end": _needle_end(rehearsal),
        "max_joint_speed_deg_s": np.degrees(rehearsal.max_joint_speed).tolist(),
        "joint_speed_limit_deg_s": np.degrees(rehearsal.speed_limits).tolist(),
        **({} if rehearsal.standing is None else rehearsal.standing.summary()),
    }


def rehearsal_failures(context: CaseContext, rehearsal: Rehearsal) -> tuple[str, ...]:
    """How the needle of one room missed its target, and what it or the arm touched, one sentence each."""
    avoided = (one.name for one in context.anatomy.checked if one.demands_margin)
    touched = [name for name in avoided if np.min(rehearsal.clearance_mm.get(name, np.inf)) < 0.0]
    case, tip_ct = context.case, rehearsal.tip_true_ct[-1:]
    if case.hit_radius_mm is not None:
        hit = bool(np.linalg.norm(tip_ct[0] - rehearsal.target_true_ct) < case.hit_radius_mm)
    else:
        hit = bool(inside_each(context.anatomy.structure(case.target_structure).mesh, tip_ct)[0])
    return (
        *([] if hit else ["the tip missed the target"]),
        *(f"the needle touched {name}" for name in touched),
        *sorted({f"the arm's {one.link} touched {one.body}" for one in rehearsal.contacts}),
    )


def trial_failures(case: Case, found: Distribution) -> Iterator[str]:
    """Where more of many rooms missed or touched than the case's limits of the chances allow, one sentence each."""
    if not len(found):
        yield "in no trial did the needle reach the target"
        return
    least, hit, touched = case.search.min_hit or 0.0, found.hit_share or 0.0, found.touched.mean(axis=0)
    if hit < least:
        yield f"{100 * hit:.2f} % of the trials hit the target; search.min_hit demands {100 * least:.2f} %"
    for name, share in zip(found.structures, touched.tolist(), strict=True):
        if share > (most := touch_limit(case, name)):
            yield f"{100 * share:.2f} % of the trials touched {name}; the case allows {100 * most:.2f} %"


def _needle_end(rehearsal: Rehearsal) -> dict[str, list[float]]:
    """Where the needle truly ended in the patient, LPS (or the case's local frame), and the target that it was for."""
    forward = np.linalg.inv(rehearsal.T_base_ct_true)[:3, :3] @ rehearsal.T_base_flange_true[-1, :3, 2]
    return {
        "tip_ct_mm": rehearsal.tip_true_ct[-1].tolist(),
        "direction_ct": forward.tolist(),
        "target_ct_mm": rehearsal.target_true_ct.tolist(),
    }
