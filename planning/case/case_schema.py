"""The keys ``schema`` and ``region`` of a case file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator

Region = Literal["abdomen", "chest", "pelvis", "brain", "head", "neck", "spine", "limb", "phantom", "other"]
"""Which part of the body, or of what else, a case shows."""


def _known(value: object) -> object:
    if isinstance(value, bool) or value not in (1, 2):
        raise ValueError(f"schema {value!r} is not known; this version reads schema = 1 and schema = 2")
    return value


CaseSchema = Annotated[int, BeforeValidator(_known)]
"""The key ``schema``: 1 or 2."""
