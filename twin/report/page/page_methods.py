"""A paragraph that says how a result was found, to be cited."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np

from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.map_view import step_of
from puncture_twin.twin.report.numbers import needle_text
from puncture_twin.twin.report.page.page_tables import PROJECT


def methods_text(case: Any, anatomy: Any, candidates: Candidates) -> str:
    """What was checked, by what, and what was not."""
    theta, step = np.degrees(candidates.theta), np.degrees(step_of(candidates))
    checked = sum(1 for one in anatomy.checked if str(one.role) in {"avoid", "unknown"})
    arm_name = case.robot.model.name.upper()
    arm = (
        f"For each remaining direction it was checked whether a {arm_name} reaches it and inserts the "
        "needle without contact."
        if candidates.arm_checked
        else "The arm was not checked."
    )
    chances = (
        "Chances to hit and to touch were propagated from the declared errors of markers, touches and arm."
        if candidates.chances is not None
        else "No errors were declared, so that no chances were computed."
    )
    return (
        f"Straight needle paths to the target were searched with {PROJECT} {version(PROJECT)} over {len(candidates):,} "
        f"entry directions, θ {theta.min():g}° to {theta.max():g}° and every azimuth β of the case, in steps of "
        f"{step:g}° (angles as in Chen et al. 2019, Eq. 10-15; {needle_text(case)}). For each direction the distance "
        f"between the needle and each of {checked} structures to keep away from was computed exactly on their triangle "
        f"meshes and compared with the structure's margin; a direction through a region that the images or labels do "
        f"not show was refused as unknown. {arm} {chances} Every input is listed below with its SHA-256. "
        + _left_out(case)
    )


def _left_out(case: Any) -> str:
    """What was not modelled, and what was of breath and needle."""
    if case.breathing is None and case.bending is None:
        return "Breathing, needle bending and tissue motion were not modelled."
    return " ".join([_breath(case.breathing), _needle(case.bending), "The deformation of tissue was not modelled."])


def _breath(breath: Any) -> str:
    if breath is None:
        return "Breathing was not modelled."
    return (
        f"Breathing was taken as a motion of {breath.amplitude_mm:g} mm along one line after Lujan et al. 1999 "
        f"(exponent {breath.exponent}, {len(breath.positions)} positions), each structure with a weight of its own: a "
        f"safe direction is safe {breath.window_text}; a needle in place moves with the organ and bends."
    )


def _needle(bending: Any) -> str:
    if bending is None:
        return "Needle bending was not modelled."
    return (
        f"The needle was taken as a beam in an elastic foundation whose bevel cuts {np.degrees(bending.alpha):g}° off "
        "its direction (Webster et al. 2006); its greatest deflection to any side was kept as clearance."
    )
