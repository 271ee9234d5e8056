"""``calibration.json``, and in the twin the first seed's ``recording.csv``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.twin.guidance.ultrasound.recording_file import FILE_NAME, write_recording
from puncture_twin.twin.guidance.ultrasound.summaries import calibration_summary
from puncture_twin.twin.jobs.selfcal.selfcal import SelfcalRun

VERSION = 2
"""Of ``calibration.json``. 2: ``inputs`` lists each file with its role."""


def write_run(run: SelfcalRun, out: Path) -> SelfcalRun:
    """Write ``calibration.json`` and, in the twin, the first seed's ``recording.csv``."""
    written = [_write_json(calibration_file(run), out / "calibration.json")]
    if run.trials:
        write_recording(run.recording, out / FILE_NAME)
        written.append(out / FILE_NAME)
    return run.with_files(*written)


def calibration_file(run: SelfcalRun) -> dict[str, Any]:
    """What ``calibration.json`` holds."""
    found = run.calibration
    return {
        "version": VERSION,
        "name": run.name,
        "seed": run.trials[0].seed if run.trials else None,
        "inputs": inputs_document(run.inputs),
        **calibration_summary(found, run.recording),
        "residuals_mm": dict(zip(run.recording.names, found.residuals.tolist(), strict=True)),
        "parameters": list(found.parameters),
        "covariance": found.covariance_counts.tolist(),
        "region_limit_95": found.region_limit(),
    }


def _write_json(content: dict[str, Any], path: Path) -> Path:
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path
