"""The error budget of a case: what each source costs, what would win the next millimetre, what a corrected aim wins."""

from collections.abc import Callable
from typing import Any

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.budget.chain import Chain, bent_path, chain_of
from puncture_twin.planning.budget.what_if import Change, best_change, changes, source_costs
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import angles
from puncture_twin.planning.geometry.rigid import apply, log_rotation
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.registration.fits import INTERVAL
from puncture_twin.planning.registration.placement import default_method, reached_insertion
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.uncertainty.hit import radius_for_chance
from puncture_twin.planning.uncertainty.pose_error import expected_error_mm, pose_error
from puncture_twin.planning.uncertainty.sources import SOURCES, not_modelled

POLE = 1e-6  # puncture angle below which an azimuth says nothing, rad
AnatomyOf = Callable[[], Anatomy]  # of a case; called only where structures bend a needle


def budget_facts(
    case: Case, registration: Registration, places_ct: Floats, anatomy: AnatomyOf, q_insertion: Floats | None = None
) -> dict[str, Any] | None:
    """The budget of one insertion, mm; None where the arm reaches none, or no errors are declared.

    A further marker could sit at the places (n, 3), mm; `q_insertion`, (6,), rad, has the tip on the target, and None
    takes one that the arm reaches.
    """
    chain = budget_chain(case, registration, anatomy, q_insertion)
    if chain is None:
        return None
    values, axes = np.linalg.eigh(chain.errors.marker_cov_ct)
    bed = None if case.space is Space.LOCAL else np.array([0.0, 0.0, 1.0])
    if values[2] > values[1] * (1 + 1e-9):  # across the slices a marker is read worst
        bed = np.asarray(axes[:, 2])
    options, square = changes(chain, places_ct, bed), chain.tip_mean_square()
    along_base = flange_pose(chain.model, chain.q_insertion)[:3, 2]
    depth = float(along_base @ square @ along_base)
    counted = {"breathing": chain.breathing, "bending": chain.path, "motion": chain.motion_base}
    return {
        **needle_angles(case, registration, chain.q_insertion),
        "expected_mm": chain.expected_mm(),
        "limit_95_mm": radius_for_chance(square, INTERVAL, registration.freedom),
        "expected_lateral_mm": float(np.sqrt(max(float(np.trace(square)) - depth, 0.0))),
        "expected_depth_mm": float(np.sqrt(depth)),
        "sources": [
            {"text": SOURCES[one.source].text, "alone_mm": one.alone_mm, "without_mm": one.without_mm}
            for one in source_costs(chain)
        ],
        "changes": [_change(case, one) for one in options],
        "best": _change(case, best_change(options)),
        "not_modelled": not_modelled(case, counted=[name for name, one in counted.items() if one is not None]),
    }


def budget_chain(
    case: Case, registration: Registration, anatomy: AnatomyOf, q_insertion: Floats | None = None
) -> Chain | None:
    """The chain of one insertion; arguments as of `budget_facts`."""
    if registration.uncertainty is None:
        return None
    q = q_insertion if registration.aim is None or q_insertion is not None else registration.aim.q
    q = reached_insertion(case, registration.T_base_ct) if q is None else q
    if q is None:
        return None
    outward_ct = -(registration.T_base_ct[:3, :3].T @ flange_pose(case.robot.model, q)[:3, 2])
    path = None if case.bending is None else bent_path(case, anatomy(), outward_ct)
    return chain_of(case, registration, q, path)


def needle_angles(case: Case, registration: Registration, q: Floats) -> dict[str, Any]:
    """Angles of the direction from which the needle comes in a configuration (6,), rad."""
    outward_ct = -(registration.T_base_ct[:3, :3].T @ flange_pose(case.robot.model, q)[:3, 2])
    theta, beta = angles(outward_ct @ case.T_ct_entry[:3, :3])
    return {"theta_deg": float(np.degrees(theta)), "beta_deg": float(np.degrees(beta)) if theta > POLE else 0.0}


def _change(case: Case, one: Change) -> dict[str, Any]:
    facts = {"group": one.group, "text": one.what, "expected_mm": one.rms_mm}
    if one.point_ct is None:
        return facts
    point = to_lps(one.point_ct[None], case.space)[0]  # its own inverse
    place = ", ".join(f"{mm:.0f}" for mm in point)
    return {**facts, "text": f"{one.what}, the last at ({place}) mm {case.space}", "last_mm": point.tolist()}


def correction_facts(case: Case, registration: Registration) -> dict[str, Any] | None:
    """Gain by a corrected aim at its own insertion, mm; None where the case corrects none."""
    aim, plain = registration.aim, registration.uncertainty
    if aim is None or plain is None or case.errors is None:
        return None
    method = default_method(case.errors)
    other = register(
        registration.markers, method=method, target_ct=aim.target_ct, noise=plain.noise,
        noise_found=case.errors.found, accept_residuals=True,
    )  # fmt: skip
    shift = apply(registration.T_base_ct, aim.target_ct) - apply(other.T_base_ct, aim.target_ct)
    rotation = registration.T_base_ct[:3, :3] @ other.T_base_ct[:3, :3].T
    return {
        **needle_angles(case, registration, aim.q),
        "joints_deg": np.degrees(aim.q).tolist(),
        "moved_mm": float(np.linalg.norm(shift)),
        "turned_deg": float(np.degrees(np.linalg.norm(log_rotation(rotation)))),
        "expected_mm": _expected_mm(case, registration, aim.q),
        "uncorrected_method": method,
        "uncorrected_mm": _expected_mm(case, other, aim.q),
    }


def _expected_mm(case: Case, registration: Registration, q: Floats) -> float:
    error = pose_error(case, registration)
    assert error is not None  # the caller has looked
    return expected_error_mm(error, q)
