"""What whoever reads a result of a case that breathes must know, one sentence each."""

from __future__ import annotations

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.breathing.lujan import fraction_within
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.search.phases.moving_weights import moving_weights

SAFE_WHEN = (
    "breathing: a safe direction is safe {when}: checked at {count} positions, and clearances between them; a needle "
    "in place moves with the organ and bends"
)
PLANS = "breathing: plans and rehearsals go to the target where the CT shows it (s = {s:g}), the patient at rest there"
OPEN = "breathing: the gate is open {part:.0%} of the time, if the breath follows the curve"
OUTSIDE_GATE = "breathing: the CT shows the body at s = {s:g}, outside of the gate (s <= {gate:g})"


def breath_warnings(case: Case, anatomy: Anatomy) -> tuple[str, ...]:
    """The warnings of a case; none where it declares no breathing.

    Raises:
        InputError: See `moving_weights`.
    """
    breathing = case.breathing
    if breathing is None:
        return ()
    moving_weights(case, breathing, anatomy)
    count = int(breathing.in_window.sum())
    said = [SAFE_WHEN.format(when=breathing.window_text, count=count)]
    if breathing.gate is not None:
        said.append(OPEN.format(part=fraction_within(breathing.gate, breathing.exponent)))
    said.append(PLANS.format(s=breathing.scanned_at))
    if breathing.gate is not None and breathing.scanned_at > breathing.gate:
        said.append(OUTSIDE_GATE.format(s=breathing.scanned_at, gate=breathing.gate))
    return tuple(said)
