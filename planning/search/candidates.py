"""The result of a search: one row per direction, with its verdict and the reason for each refusal."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Texts
from puncture_twin.planning.base.reasons import Reason

ARM_CHECKED = "checked"
"""What ``Candidates.arm`` says where a safe candidate is one that the arm can reach and insert along."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Every direction of the grid, column by column: mm, radians, points in the CT frame.

    Attributes:
        theta: Shape (n,), puncture angle.
        beta: Shape (n,), azimuth.
        outward_ct: Shape (n, 3), unit vectors from the target outward.
        reason: Shape (n,), values of `Reason`; the empty string where the candidate is safe.
        reason_structure: Shape (n,), the structure (or arm body and what it touches) that the reason names.
        reason_depth: Shape (n,), distance from the target along the needle, NaN where it means nothing.
        reason_amount: Shape (n,), the number that fell short: clearance for ``too_close``, path length for
            ``too_long``, the skin angle in degrees for ``skin_angle``; NaN otherwise.
        reason_detail: Shape (n,), what kept the arm, in one sentence; "" for the organs' reasons.
        entry_ct: Shape (n, 3), where the path crosses the skin, NaN without an entry.
        path_length: Shape (n,), target to entry.
        skin_angle: Shape (n,), between the path and the skin's inward normal, 0 is straight in.
        structures: The k names of the clearance columns.
        margins: Shape (k,), the clearance that each structure demands, NaN for one that demands none.
        clearance: Shape (n, k), axis distance minus needle radius.
        min_clearance: Shape (n,), smallest over the structures with a margin.
        tissue: Shape (n,), length of path inside structures that may be crossed.
        reachable: Shape (n,), 1 yes, 0 no, -1 not asked.
        safe_cone: Shape (n,), by how much one may be off in any direction and still be safe for the organs, rad; NaN
            where no certificate was asked for.
        reach_margin: Shape (n,), 0..1 distance from joint limits and singularities, NaN when not asked.
        cost: Shape (n,), NaN for rejected candidates.
        rank: Shape (n,), 1 is best, 0 for rejected candidates.
        pareto: Shape (n,), on the Pareto front of the cost's terms.
        arm: `ARM_CHECKED`, or "not checked: " and why: then a safe candidate is safe for the organs alone.
    """

    theta: Floats
    beta: Floats
    outward_ct: Floats
    reason: Texts
    reason_structure: Texts
    reason_depth: Floats
    reason_amount: Floats
    reason_detail: Texts
    entry_ct: Floats
    path_length: Floats
    skin_angle: Floats
    structures: tuple[str, ...]
    margins: Floats
    clearance: Floats
    min_clearance: Floats
    tissue: Floats
    reachable: NDArray[np.int8]
    reach_margin: Floats
    safe_cone: Floats
    cost: Floats
    rank: NDArray[np.int32]
    pareto: NDArray[np.bool_]
    arm: str = "not checked"

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def safe(self) -> NDArray[np.bool_]:
        """Which rows are not rejected, shape (n,)."""
        return self.reason == Reason.NONE.value

    @property
    def arm_checked(self) -> bool:
        """Whether "safe" includes the arm."""
        return self.arm == ARM_CHECKED

    @property
    def safe_text(self) -> str:
        """What a person reads for a safe candidate: never "safe" alone where the arm was not checked."""
        return "safe" if self.arm_checked else "safe for the organs"

    @property
    def ranked(self) -> NDArray[np.int64]:
        """Row numbers of the safe candidates, best first."""
        rows = np.flatnonzero(self.rank > 0)
        return rows[np.argsort(self.rank[rows], kind="stable")]

    def counts(self) -> dict[str, int]:
        """How many candidates fell to which reason, most frequent first; "safe" among them."""
        return dict(Counter(str(reason) or "safe" for reason in self.reason).most_common())

    def at(self, row: int) -> dict[str, float]:
        """The angles of one row, degrees, rounded to what a person types."""
        return {
            "theta_deg": round(float(np.degrees(self.theta[row])), 9),
            "beta_deg": round(float(np.degrees(self.beta[row])), 9),
        }
