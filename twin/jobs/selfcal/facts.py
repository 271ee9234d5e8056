"""What ``selfcal`` found, as one table of plain values: ``--json``, the text and the page read nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.twin.guidance.ultrasound.summaries import (
    calibration_summary,
    choice_summary,
    puncture_summary,
    trial_summary,
)
from puncture_twin.twin.jobs.selfcal.selfcal import SelfcalRun

Facts = Mapping[str, Any]
"""What `selfcal_facts` returns: mm and degrees."""


def selfcal_facts(run: SelfcalRun) -> dict[str, Any]:
    """Poses, calibration, trials, punctures, and what was written."""
    return {
        **calibration_summary(run.calibration, run.recording),
        "name": run.name,
        "inputs": inputs_document(run.inputs),
        "candidates": None if run.candidates is None else run.candidates.counts,
        "choice": None if run.choice is None else choice_summary(run.choice),
        "trials": [trial_summary(trial) for trial in run.trials],
        "punctures": puncture_summary(run.punctures),
        "seconds": {stage: round(seconds, 3) for stage, seconds in run.stages.seconds.items()},
        "files": [str(path) for path in run.files],
        "warnings": list(run.warnings),
    }
