"""The result of a rehearsal: values alone, which images and pages read without the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.text import Shown, brief
from puncture_twin.twin.plant.true_needle import NO_TISSUE_FORCE, TissueForce

if TYPE_CHECKING:
    from puncture_twin.twin.rehearsal.distribution import Distribution
    from puncture_twin.twin.world.execution import ContactEvent


@dataclass(frozen=True)
class ErrorRank:
    """Percentile of a rehearsal's tip error among trials, or in the predicted distribution."""

    percentile: float
    trials: int = 0  # so many trials were drawn, and this is the median one; 0 where the percentile is the prediction's

    @property
    def place(self) -> str:
        """The percentile in words."""
        return f"{ordinal(round(self.percentile))} percentile"

    @property
    def text(self) -> str:
        """The rank for headlines and text."""
        if self.trials > 1:
            return f"median of {self.trials:,} trials ({self.place} of their tip errors)"
        return "the only trial" if self.trials else f"{self.place} of the predicted tip errors"

    @property
    def short(self) -> str:
        """The rank for a frame of the film."""
        if self.trials > 1:
            return f"median of {self.trials:,} trials"
        return "the only trial" if self.trials else f"{self.place} of the prediction"

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"percentile": self.percentile, "percentile_of": "rooms" if self.trials else "prediction"}


def ordinal(number: int) -> str:
    """A number as 1st, 2nd, 3rd, 4th ... 11th ... 21st."""
    last = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{last}"


CONTROLS = MappingProxyType(
    {
        "impedance": "with a spring at the tip (impedance)",
        "admittance": "with shifted motor setpoints (admittance)",
        "position": "with position control",
    }
)
"""How an insertion is followed, in words."""


@dataclass(frozen=True, eq=False)
class Rehearsal(Shown):
    """Measurements of a rehearsal; m records in time, k samples of clearance. Angles in rad, lengths in mm."""

    seed: int
    truth_source: str
    T_base_ct_true: Floats  # shape (4, 4), true pose of the patient
    times_s: Floats  # shape (m,), from the start of the approach
    q: Floats  # shape (m, 6), encoder angles
    q_command: Floats  # shape (m, 6), commanded joints
    phase: NDArray[np.str_]  # shape (m,), "approach", "settle", "insertion" or "hold"
    T_base_flange_true: Floats  # shape (m, 4, 4), true pose of the flange
    tip_true_ct: Floats  # shape (m, 3), the needle's true tip in the patient
    clearance_times_s: Floats  # shape (k,), moments of the insertion and its end
    clearance_mm: MappingProxyType[str, Floats]
    """Structure to shape (k,): true needle's axis to true structure, minus the needle's radius."""
    contacts: tuple[ContactEvent, ...]
    max_joint_speed: Floats  # shape (6,), rad/s
    speed_limits: Floats  # shape (6,), rad/s
    tip_error_mm: float  # true tip to true target at the end; `depth_mm` along the needle, positive when too deep
    lateral_mm: float
    depth_mm: float
    predicted_error_mm: float
    target_true_ct: Floats  # shape (3,), true target in the CT
    truth_is_belief: bool  # whether the patient lay exactly where it was believed, so that the error says little
    control: str
    off_path_mm: float  # the tip from its commanded path, by the encoders, at most from the insertion on
    tissue_force: TissueForce | None
    standing: ErrorRank | None = None  # where the error stands among others; None where the case declares no errors
    distribution: Distribution | None = None

    @brief
    def __repr__(self) -> str:
        touched = ", ".join(sorted({one.body for one in self.contacts})) or "nothing"
        return f"seed {self.seed}, the tip ended {self.tip_error_mm:.2f} mm from the target, touched {touched}"

    @property
    def followed_text(self) -> str:
        """Control of the insertion in words, for a person."""
        return f"{CONTROLS[self.control]}, at most {self.off_path_mm:.3f} mm off its commanded path"

    @property
    def force_text(self) -> str:
        """Forces of the tissue, for a person."""
        return NO_TISSUE_FORCE if self.tissue_force is None else self.tissue_force.text

    def __post_init__(self) -> None:
        for value in (*vars(self).values(), *self.clearance_mm.values()):
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
