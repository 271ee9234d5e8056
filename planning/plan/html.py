"""How a plan shows itself in a notebook."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

from puncture_twin.planning.base.html import Facts, card, never_raises

CLEARANCE_TEXT = MappingProxyType(
    {
        "approach": "arm's least clearance, approach",
        "insertion": "arm's least clearance, insertion",
        "needle": "needle's least clearance to a structure",
    }
)
"""What each of a plan's clearances is of."""


@never_raises
def plan_html(plan: Any) -> str:
    """A table of facts: direction, entry and target, motion, and the least distances that were found."""
    return card(f"Plan of {plan.case_name}", _facts(plan))


def _facts(plan: Any) -> Facts:
    yield "direction", f"θ {np.degrees(plan.theta):g}°, β {np.degrees(plan.beta):g}°"
    yield "skin entry, CT (LPS or local)", _point(plan.entry_ct)
    yield "target, CT", _point(plan.target_ct)
    yield "depth, skin to target", f"{np.linalg.norm(plan.entry_ct - plan.target_ct):.1f} mm"
    yield "standoff", f"{plan.standoff_mm:g} mm, tip to target"
    error = plan.expected_target_error_mm
    yield (
        "expected tip error",
        f"{error:.2f} mm (rms)" if np.isfinite(error) else "not known: no markers",
    )
    yield "robot", plan.model.name
    for name in ("approach", "insertion"):
        phase = getattr(plan, name)
        yield name, f"{phase.times_s[-1]:.1f} s, {len(phase.times_s):,} samples"
    for phase, millimetres in plan.clearance_mm.items():
        yield CLEARANCE_TEXT[phase], f"{millimetres:.1f} mm"
    yield "seed", str(plan.seed)
    yield "warnings", "not known: an older file" if plan.warnings is None else "; ".join(plan.warnings) or "none"


def _point(point: Any) -> str:
    return "({:.1f}, {:.1f}, {:.1f}) mm".format(*point)
