"""What decides a result about convex pieces, for the cache."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.collision.enclosures.settings import settings


def made_from(what: str, pieces: Sequence[NDArray[Any]]) -> dict[str, object]:
    """What decides a result about some convex pieces, for the cache: their corners and how they are enclosed."""
    digest = hashlib.sha256()
    for corners in pieces:
        digest.update(f"{corners.shape}".encode())
        digest.update(np.ascontiguousarray(corners).tobytes())
    return {"what": what, "pieces": digest.hexdigest(), **settings()}
