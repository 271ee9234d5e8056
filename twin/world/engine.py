"""PyBullet itself, imported without the line that it writes to standard error each time."""

from __future__ import annotations

import os
import sys
from typing import Any


def _imported() -> Any:
    """Import PyBullet while file descriptor 2 leads nowhere: the line comes from C, past Python's `sys.stderr`."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        import pybullet  # here, while it cannot be heard
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    return pybullet


pybullet: Any = _imported()
"""The module; whoever needs it takes it from here."""
