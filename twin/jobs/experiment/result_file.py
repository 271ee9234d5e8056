"""The JSON of an experiment beside its other files: the same bytes wherever the folder lies."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.files import atomic


def write_result(summary: Mapping[str, Any], path: Path, out: Path) -> None:
    """Write what ``--json`` prints, its files named as the folder holds them.

    Args:
        summary: With ``files``, where they lie in the end.
        path: The JSON to write.
        out: The folder in which they lie.
    """
    document = {**summary, "files": [os.path.relpath(file, out) for file in summary["files"]]}
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
