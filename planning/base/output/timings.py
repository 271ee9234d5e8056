"""``timings.json``: when each command ran and how long its stages took, kept apart: all else is reproducible."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.manifest import MAX_MANIFEST_BYTES, TIMINGS_NAME
from puncture_twin.planning.base.strict_json import read_json


def with_timings(
    folder: Path, kept: Iterable[str], command: str, started: datetime, seconds: Mapping[str, float]
) -> str:
    """The folder's timings with those of a command put in.

    Args:
        folder: The output folder.
        kept: Commands whose entries stay, and so their timings.
        command: The one that ran.
        started: When, with its time zone.
        seconds: How long each stage took.
    """
    before = _read(folder / TIMINGS_NAME)
    timings = {name: before[name] for name in kept if name in before}
    timings[command] = {
        "started": started.isoformat(timespec="seconds"),
        "seconds": {stage: round(float(spent), 3) for stage, spent in seconds.items()},
    }
    return json.dumps(timings, indent=1, allow_nan=False) + "\n"


def _read(path: Path) -> dict[str, Any]:
    """What is there; nothing where it cannot be read: no result depends on it."""
    try:
        document = read_json(path, max_bytes=MAX_MANIFEST_BYTES, allowed="timings")
    except InputError:
        return {}
    return document if isinstance(document, dict) else {}
