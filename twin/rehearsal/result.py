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


@dataclass(frozen=True)
class ErrorRank:
    """Percentile of a rehearsal's tip error among trials, or in the predicted distribution.

    Attributes:
        percentile: 0 to 100; so many of 100 trials end nearer to the target.
        trials: So many trials were drawn, and this is the median one; 0 where the percentile is the prediction's.
    """

    percentile: float
    trials: int = 0

    @property
    def place(self) -> str:
        """The percentile in words."""
        return f"{ordinal(round(self.percentile))} percentile"

    @property
    def text(self) -> str:
        """The rank for headlines and text."""
        if self.trials == 0:
            return f"{self.place} of the predicted tip errors"
        return (
            f"median of {self.trials:,} trials ({self.place} of their tip errors)"
            if self.trials > 1
            else "the only trial"
        )

    @property
    def short(self) -> str:
        """The rank for a frame of the film."""
        if self.trials == 0:
            return f"{self.place} of the prediction"
        return f"median of {self.trials:,} trials" if self.trials > 1 else "the only trial"

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


@dataclass(frozen=True)
class RehearsalContact:
    """A body of the arm that touched something.

    Attributes:
        time_s: When it was first seen.
        link: The arm's body.
        body: What it touched: ``patient``, a box, or another body of the arm.
        depth_mm: Deepest overlap in the physics; NaN where only FCL saw it (it says whether, not how deep).
    """

    time_s: float
    link: str
    body: str
    depth_mm: float


@dataclass(frozen=True, eq=False)
class Rehearsal(Shown):
    """Measurements of a rehearsal; m records in time, k samples of clearance. Angles in rad, lengths in mm.

    Attributes:
        seed: What the truth was drawn from.
        T_base_ct_true: Shape (4, 4), true pose of the patient.
        times_s: Shape (m,), from the start of the approach.
        q: Shape (m, 6), encoder angles.
        q_command: Shape (m, 6), commanded joints.
        phase: Shape (m,), "approach", "settle", "insertion" or "hold".
        T_base_flange_true: Shape (m, 4, 4), true pose of the flange.
        tip_true_ct: Shape (m, 3), the needle's true tip in the patient.
        clearance_times_s: Shape (k,), moments of the insertion and its end.
        clearance_mm: Structure to shape (k,): true needle's axis to true structure, minus the needle's radius.
        contacts: One for each pair of bodies that touched, in the order of time.
        max_joint_speed: Shape (6,), rad/s.
        speed_limits: Shape (6,), rad/s.
        tip_error_mm: True tip to true target at the end.
        lateral_mm: Its part across the needle.
        depth_mm: Its part along the needle, positive when too deep.
        predicted_error_mm: What the plan expected (rms), NaN without markers.
        target_true_ct: Shape (3,), true target in the CT.
        truth_is_belief: Whether the patient lay exactly where it was believed, so that the error says little.
        control: How the insertion was followed: "impedance", "admittance" or "position".
        off_path_mm: The tip from its commanded path, by the encoders, at most from the insertion on.
        tissue_force: The greatest forces of the tissue on the needle; None where the case declares none.
        standing: Where the error stands among others; None where the case declares no errors.
        distribution: Over many rooms; None where the plan was executed in one.
    """

    seed: int
    truth_source: str
    T_base_ct_true: Floats
    times_s: Floats
    q: Floats
    q_command: Floats
    phase: NDArray[np.str_]
    T_base_flange_true: Floats
    tip_true_ct: Floats
    clearance_times_s: Floats
    clearance_mm: MappingProxyType[str, Floats]
    contacts: tuple[RehearsalContact, ...]
    max_joint_speed: Floats
    speed_limits: Floats
    tip_error_mm: float
    lateral_mm: float
    depth_mm: float
    predicted_error_mm: float
    target_true_ct: Floats
    truth_is_belief: bool
    control: str
    off_path_mm: float
    tissue_force: TissueForce | None
    standing: ErrorRank | None = None
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
