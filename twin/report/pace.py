"""How fast a stage of a command is and how long it still takes, as text."""

from __future__ import annotations

import time

LEAST_TIME_S = 0.5
"""Of a rate: with less behind it, it says nothing."""

USUALLY_S = {"map": 1.0, "scene": 1.0, "slices": 1.0, "page": 1.0, "rehearsal": 2.0, "film": 3.0}
"""Stages that take about as long for every case, on two cores; others count, or depend on what there is to read."""


def rate_text(per_second: float) -> str:
    """A rate in the unit in which it is at least 1, if any is."""
    for seconds, unit in ((1.0, "s"), (60.0, "min")):
        if per_second * seconds >= 1.0:
            return f"{per_second * seconds:,.0f}/{unit}"
    return f"{per_second * 3600.0:,.1f}/h"


def duration_text(seconds: float) -> str:
    """How long something takes, in the unit that a person would choose."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


class Pace:
    """How fast a stage is, since its first count, or since it began anew."""

    def __init__(self) -> None:
        self._since: dict[str, tuple[float, int, int]] = {}
        self._last: dict[str, int] = {}

    def text(self, stage: str, done: int, total: int, failed: int) -> str:
        """How many are done of how many, how many of them failed; rate and time left, with time behind them."""
        began, first, of = self._since.get(stage, (0.0, 0, -1))
        if of != total or done < self._last[stage]:
            began, first = time.monotonic(), done
            self._since[stage] = began, first, total
        self._last[stage] = done
        failures = f", {failed} failed" if failed else ""
        return f"{done:,}/{total:,}{failures}{_rate_text(done - first, time.monotonic() - began, total - done)}"


def _rate_text(done: int, seconds: float, left: int) -> str:
    if done <= 0 or seconds < LEAST_TIME_S:
        return ""
    return f", {rate_text(done / seconds)}, {duration_text(left * seconds / done)} left"


def step_text(what: str) -> str:
    """A thing that a stage has come to, with what it usually takes where no count tells how far it is."""
    return f"{what}, usually {duration_text(USUALLY_S[what])}" if what in USUALLY_S else what
