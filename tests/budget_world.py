"""Chains of markers, arm and insertion of embedded cases, as the error budget has them, and trials of them."""

from functools import cache

from places import ROOT

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.budget.chain import chain_of
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.registration.marker_noise import reading_noise
from puncture_twin.planning.registration.placement import load_placement, reached_insertion
from puncture_twin.twin.rehearsal.trials import Puncture, draw_trials


@cache
def chain(name):
    """Of a case file below the embedded meshes."""
    case = load_case(ROOT / "meshes" / name)
    placement = load_placement(case)
    return chain_of(case, placement.registration, reached_insertion(case, placement.T_base_ct))


def drawn_trials(one, errors, count, rng, bend=None):
    """Whole nonlinear chains with these errors: those that reached."""
    noise = reading_noise(one.errors, one.model, one.tip_mm, one.q_touch, known=True)
    outward_ct = -(one.T_base_ct[:3, :3].T @ flange_pose(one.model, one.q_insertion)[:3, 2])
    puncture = Puncture(
        one.model, one.tip_mm, one.method, noise, one.points_ct, one.q_touch, one.T_base_ct, one.target_ct, outward_ct,
        one.q_insertion, bend,
    )  # fmt: skip
    trials = draw_trials(puncture, errors, count, rng)
    return trials.of(trials.reached)
