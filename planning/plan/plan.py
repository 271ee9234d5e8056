"""The chosen pose and its motion: what is rehearsed, exported and stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.speed_limits import DEFAULT_SPEEDS, SpeedLimits
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.brief import brief
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.html import plan_html


@dataclass(frozen=True, eq=False)
class Plan:
    """One puncture, ready to be rehearsed: mm, rad, s.

    Attributes:
        case_name: The case that it was made for.
        inputs: Every file of that case, with role and hash.
        seed: Of the approach's planner.
        model: The arm.
        T_base_ct: Shape (4, 4), the belief of where the patient is.
        expected_target_error_mm: Expected tip error (rms), in the insertion's configuration of the arm; without
            ``[errors]`` the registration's TRE alone; NaN for a stated mount or transform.
        theta: Puncture angle.
        beta: Azimuth.
        entry_ct: Shape (3,), skin entry.
        target_ct: Shape (3,).
        outward_ct: Shape (3,), unit, from the target along the needle.
        roll: About the needle.
        standoff_mm: Tip to target before the insertion.
        needle_length_mm: Tip to flange.
        approach: From home to standoff.
        insertion: From standoff to the target.
        clearance_mm: Per phase, the least distance that was found: ``approach`` and ``insertion`` of arm and holder
            to patient and workcell, ``needle`` to the nearest structure with a margin.
        speeds: What it keeps: the case's. A file that does not say so keeps the default.
        warnings: Of its case when it was made, one sentence each; None of a file that is older than their statement.
    """

    case_name: str
    inputs: tuple[Input, ...]
    seed: int
    model: UrModel
    T_base_ct: Floats
    expected_target_error_mm: float
    theta: float
    beta: float
    entry_ct: Floats
    target_ct: Floats
    outward_ct: Floats
    roll: float
    standoff_mm: float
    needle_length_mm: float
    approach: Trajectory
    insertion: Trajectory
    clearance_mm: Mapping[str, float]
    speeds: SpeedLimits = DEFAULT_SPEEDS
    warnings: tuple[str, ...] | None = None

    @brief
    def __repr__(self) -> str:
        return (
            f"case {self.case_name}, theta {np.degrees(self.theta):g} deg, beta {np.degrees(self.beta):g} deg, "
            f"{self.model.name}, approach {self.approach.duration_s:.1f} s, insertion {self.insertion.duration_s:.1f} s"
        )

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return plan_html(self)
