"""The chosen pose and its motion: the value that is rehearsed, exported and stored, its contacts and clearances."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS, SpeedLimits
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.text import Facts, Shown, brief
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.motion.path_check import FINER, RESOLUTION_RAD, dense_states, least_clearance
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.uncertainty.guided import WayChance


@dataclass(frozen=True, eq=False)
class Plan(Shown):
    """One puncture, ready to be rehearsed: mm, rad, s."""

    case_name: str
    inputs: tuple[Input, ...]
    seed: int
    model: UrModel
    T_base_ct: Floats
    """Shape (4, 4), the belief of where the patient is."""
    expected_target_error_mm: float
    """Expected tip error (rms), in the insertion's configuration of the arm; without ``[errors]`` the registration's
    TRE alone; NaN for a stated mount or transform."""
    theta: float
    beta: float
    entry_ct: Floats  # shape (3,), skin entry
    target_ct: Floats  # shape (3,)
    outward_ct: Floats  # shape (3,), unit, from the target along the needle
    roll: float
    standoff_mm: float  # tip to target before the insertion
    needle_length_mm: float
    approach: Trajectory
    insertion: Trajectory
    clearance_mm: Mapping[str, float]
    """Per phase, the least distance that was found: ``approach`` and ``insertion`` of arm and holder to patient and
    workcell, ``needle`` to the nearest structure with a margin."""
    warnings: tuple[str, ...]
    speeds: SpeedLimits = DEFAULT_SPEEDS
    guidance: tuple[WayChance, ...] = ()
    """What each way of guidance would leave; empty where the case declares no devices."""

    @property
    def theta_deg(self) -> float:
        """Puncture angle, degrees."""
        return float(np.degrees(self.theta))

    @property
    def beta_deg(self) -> float:
        """Azimuth, degrees."""
        return float(np.degrees(self.beta))

    @brief
    def __repr__(self) -> str:
        return (
            f"case {self.case_name}, theta {self.theta_deg:g} deg, beta {self.beta_deg:g} deg, "
            f"{self.model.name}, approach {self.approach.duration_s:.1f} s, insertion {self.insertion.duration_s:.1f} s"
        )

    def _title(self) -> str:
        return f"Plan of {self.case_name}"

    def _facts(self) -> Facts:
        point = "({:.1f}, {:.1f}, {:.1f}) mm".format
        yield "direction", f"θ {self.theta_deg:g}°, β {self.beta_deg:g}°"
        yield "skin entry, CT (LPS or local)", point(*self.entry_ct)
        yield "target, CT", point(*self.target_ct)
        yield "depth, skin to target", f"{np.linalg.norm(self.entry_ct - self.target_ct):.1f} mm"
        yield "standoff", f"{self.standoff_mm:g} mm, tip to target"
        error = self.expected_target_error_mm
        yield ("expected tip error", f"{error:.2f} mm (rms)" if np.isfinite(error) else "unknown: no markers")
        yield "robot", self.model.name
        for name, phase in (("approach", self.approach), ("insertion", self.insertion)):
            yield name, f"{phase.times_s[-1]:.1f} s, {len(phase.times_s):,} samples"
        for name, millimetres in self.clearance_mm.items():
            yield CLEARANCE_TEXT[name], f"{millimetres:.1f} mm"
        yield "seed", str(self.seed)
        yield "warnings", "; ".join(self.warnings) or "none"


CLEARANCE_TEXT = MappingProxyType(
    {
        "approach": "arm's least clearance, approach",
        "insertion": "arm's least clearance, insertion",
        "needle": "needle's least clearance to a structure",
    }
)
"""What each of a plan's clearances is of."""


def phase_clearances(plan: Plan, checker: CellChecker) -> dict[str, float]:
    """Least distance of arm and holder from patient and workcell in each phase of the motion; mm."""
    clearances = {}
    for phase, part in (("approach", plan.approach), ("insertion", plan.insertion)):
        least = least_clearance(checker, dense_states(checker, part.q, RESOLUTION_RAD / FINER))
        clearances[phase] = min(least.patient.mm, least.boxes.mm)
    return clearances


def motion_contact(plan: Plan, checker: CellChecker) -> str | None:
    """The contact of a plan's motion, in words, or None: by FCL at ten times the planner's resolution."""
    for phase, q, needle_free in (("approach", plan.approach.q, False), ("insertion", plan.insertion.q, True)):
        for state in dense_states(checker, q, RESOLUTION_RAD / FINER):
            contact = CellChecker.contact(checker, state, needle_may_touch_patient=needle_free)  # FCL alone, no bounds
            if contact is not None:
                return f"{phase} is not free: {contact.body} touches {contact.other}"
    return None
