"""Why a candidate is rejected: the reason codes of the candidates table."""

from __future__ import annotations

from enum import StrEnum


class Reason(StrEnum):
    """A reason code. ``NONE`` (the empty string) stands for a candidate that is not rejected."""

    NONE = ""
    NO_SKIN_ENTRY = "no_skin_entry"
    REENTERS_SKIN = "reenters_skin"
    TOO_LONG = "too_long"
    SKIN_ANGLE = "skin_angle"
    TOO_CLOSE = "too_close"
    UNKNOWN_REGION = "unknown_region"
    UNREACHABLE = "unreachable"
    ARM_COLLISION = "arm_collision"
    INSERTION_BLOCKED = "insertion_blocked"
    APPROACH_NOT_FOUND = "approach_not_found"
