"""Where one rehearsal stands among many: a film of the luckiest room must not pass for a typical one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.uncertainty.hit import hit_in_ball


@dataclass(frozen=True)
class Standing:
    """The place of a rehearsal's tip error among those of rooms, or in the predicted distribution.

    Attributes:
        percentile: 0 to 100; so many of 100 rooms end nearer to the target.
        rooms: So many rooms were drawn, and this is the median one; 0 where the percentile is the prediction's.
    """

    percentile: float
    rooms: int = 0

    @property
    def place(self) -> str:
        """The percentile in words."""
        return f"{ordinal(round(self.percentile))} percentile"

    @property
    def text(self) -> str:
        """For headlines and text."""
        if self.rooms == 0:
            return f"{self.place} of the tip errors that are predicted"
        return (
            f"median of {self.rooms:,} rooms ({self.place} of their tip errors)" if self.rooms > 1 else "the only room"
        )

    @property
    def short(self) -> str:
        """For a frame of the film."""
        if self.rooms == 0:
            return f"{self.place} by prediction"
        return f"median of {self.rooms:,} rooms" if self.rooms > 1 else "the only room"

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"percentile": self.percentile, "percentile_of": "rooms" if self.rooms else "prediction"}


@dataclass(frozen=True, eq=False)
class RoomScale:
    """The tip errors of rooms, of which one is rehearsed.

    Attributes:
        errors_mm: Shape (n,), of those in which the arm reached the pose.
        rooms: All.
    """

    errors_mm: Floats
    rooms: int

    def of(self, tip_error_mm: float) -> Standing:
        """Where an error stands among them."""
        below = np.mean(self.errors_mm < tip_error_mm) + np.mean(self.errors_mm <= tip_error_mm)
        return Standing(float(50 * below), self.rooms)


@dataclass(frozen=True, eq=False)
class PredictedScale:
    """The predicted distribution of the tip's error.

    Attributes:
        cov: Shape (1, 3, 3), mm^2.
        freedom: Of a spread that was found; None where it is stated.
    """

    cov: Floats
    freedom: int | None

    def of(self, tip_error_mm: float) -> Standing:
        """Where an error stands in it."""
        return Standing(100 * float(hit_in_ball(self.cov, tip_error_mm, self.freedom)[0]))


Scale = RoomScale | PredictedScale
"""What a tip error is held against."""


def ordinal(number: int) -> str:
    """1st, 2nd, 3rd, 4th ... 11th ... 21st."""
    last = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{last}"
