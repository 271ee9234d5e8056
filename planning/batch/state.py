"""What has become of a cohort: done, failed with reasons, missing, stale."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.batch.plan import PlannedCase, identified, read_plan_table
from puncture_twin.planning.batch.result import read_row


@dataclass
class CohortState:
    """Cases of a plan, each counted once.

    Attributes:
        planned: Cases in all.
        safe: Done, with a safe direction.
        no_safe: Done, without one.
        reasons: Failed, by reason: refused inputs, and failures of the program.
        missing: Not run.
        stale: Their inputs have changed since the plan: `batch plan` again.
        stale_cases: As the cohort writes them.
    """

    planned: int = 0
    safe: int = 0
    no_safe: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    missing: int = 0
    stale_cases: list[str] = field(default_factory=list)

    @property
    def done(self) -> int:
        """Cases with a verdict."""
        return self.safe + self.no_safe

    @property
    def failed(self) -> int:
        """Cases whose row is a refusal or a failure."""
        return sum(self.reasons.values())

    @property
    def stale(self) -> int:
        """Cases whose inputs have changed."""
        return len(self.stale_cases)

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "cases": self.planned,
            "done": self.done,
            "safe": self.safe,
            "no_safe": self.no_safe,
            "failed": self.failed,
            "reasons": [{"reason": reason, "count": count} for reason, count in self.reasons.most_common()],
            "missing": self.missing,
            "stale": self.stale,
            "stale_cases": self.stale_cases,
        }

    def add(self, planned: PlannedCase, out: Path) -> None:
        """Count one more; its files are read and hashed."""
        self.planned += 1
        row = read_row(out, planned.id)
        if identified(planned).id != planned.id:
            self.stale_cases.append(planned.case)
        elif row is None:
            self.missing += 1
        elif row["exit_code"] > 1:
            self.reasons[str(row["reason"])] += 1
        elif row["exit_code"] == 1:
            self.no_safe += 1
        else:
            self.safe += 1


def cohort_state(out: Path, progress: Count) -> CohortState:
    """Look at every case of a plan.

    Args:
        out: The cohort's folder.
        progress: Called with (cases looked at, cases).

    Raises:
        InputError: The folder has no plan.
    """
    plan, state = read_plan_table(out), CohortState()
    for number, one in enumerate(plan.cases, start=1):
        state.add(one, out)
        progress(number, len(plan.cases))
    return state
