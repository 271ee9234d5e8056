"""How a case shows itself in a notebook."""

from __future__ import annotations

from typing import Any

import numpy as np

from puncture_twin.planning.base.html import Facts, card, never_raises


@never_raises
def case_html(case: Any) -> str:
    """A table of facts: target, needle, structures, grid, robot, and what the case leaves open."""
    return card(f"Case {case.name}", _facts(case))


def _facts(case: Any) -> Facts:
    x, y, z = case.target_ct
    axes = "the local frame" if str(case.space) == "local" else "LPS"
    yield "target", f"{case.target_name} in {case.target_structure}: ({x:.1f}, {y:.1f}, {z:.1f}) mm in {axes}"
    needle = case.needle
    yield "needle", f"⌀ {needle.diameter_mm:g} mm, shaft {needle.shaft_mm:g} mm, tip to flange {needle.length_mm:g} mm"
    if case.tool is not None:
        size = " × ".join(f"{edge:.0f}" for edge in np.ptp(case.tool.mesh.bounds, axis=0))
        yield "tool", f"{case.tool.file.name}, {size} mm along the flange's axes"
    stated = [one.name for one in case.structure] + [f"those of {one.source}" for one in case.structures]
    yield "structures", ", ".join(stated) or "none"
    (low, high), (first, last) = np.degrees(case.search.theta), np.degrees(case.search.beta)
    step = np.degrees(case.search.step)
    yield "search", f"θ {low:g}° to {high:g}°, β {first:g}° to {last:g}°, every {step:g}°"
    yield "robot", case.robot.model.name
    yield "its base", _base(case)
    yield "inputs", f"{len(case.inputs)} files, {case.path}"
    for warning in case.warnings:
        yield "warning", warning


def _base(case: Any) -> str:
    if case.registration is not None:
        return f"by registration of markers ({case.registration.method})"
    if case.robot.transform is not None:
        return f"by the stated transform {case.robot.transform}: no residuals"
    return "not stated" if case.robot.T_base_ct_mount is None else "by a stated mount"
