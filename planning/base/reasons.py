"""Reason codes of rejected candidates, as the candidates table has them, with their texts and colours.

The colours follow Okabe and Ito's palette for colour-blind readers ("Color Universal Design", 2008), filled up with
three dark tones of Paul Tol's ("Colour Schemes", SRON technical note, 2021); none of them is near the greens that mean
safe.
"""

from enum import StrEnum
from types import MappingProxyType


class Reason(StrEnum):
    """A reason code. ``NONE`` (the empty string) stands for a candidate that is not rejected."""

    NONE = ""
    NO_SKIN_ENTRY = "no_skin_entry"
    REENTERS_SKIN = "reenters_skin"
    TOO_LONG = "too_long"
    SKIN_ANGLE = "skin_angle"
    TOO_CLOSE = "too_close"
    HIT_UNLIKELY = "hit_unlikely"
    TOUCH_LIKELY = "touch_likely"
    UNSAFE_WHEN_BREATHING = "unsafe_when_breathing"
    NEEDLE_BENDS = "needle_bends"
    UNKNOWN_REGION = "unknown_region"
    UNREACHABLE = "unreachable"
    ARM_COLLISION = "arm_collision"
    INSERTION_BLOCKED = "insertion_blocked"
    APPROACH_NOT_FOUND = "approach_not_found"


Rgb = tuple[int, int, int]
SAFE: Rgb = (0, 158, 115)
"""Colour of safe directions where no shade is meant: legends, the corridor in 3D."""
UNSEEN_AIR: Rgb = (190, 190, 196)
"""Colour of an unknown region outside of the body; one within it is darker, as `REASON_COLOURS` has it."""
UNSEEN_AIR_TEXT = "unknown outside the body (image ends, or no air)"
NOT_SEARCHED_TEXT = "outside the grid, not searched"
_SHOWN: dict[Reason, tuple[Rgb, str]] = {
    Reason.NO_SKIN_ENTRY: ((221, 221, 221), "no skin entry"),
    Reason.REENTERS_SKIN: ((240, 228, 66), "leaves and re-enters the skin"),
    Reason.TOO_LONG: ((86, 180, 233), "path longer than the needle's shaft"),
    Reason.SKIN_ANGLE: ((230, 159, 0), "too oblique at the skin"),
    Reason.TOO_CLOSE: ((213, 94, 0), "hits a structure or its margin"),
    Reason.HIT_UNLIKELY: ((153, 153, 51), "too unlikely to hit the target"),
    Reason.TOUCH_LIKELY: ((204, 51, 17), "too likely to touch a structure"),
    Reason.UNSAFE_WHEN_BREATHING: ((102, 17, 0), "unsafe at a phase of the breath"),
    Reason.NEEDLE_BENDS: ((170, 68, 153), "may bend into a structure's margin"),
    Reason.UNKNOWN_REGION: ((110, 110, 110), "unknown in the body (image ends, or not named)"),
    Reason.UNREACHABLE: ((0, 90, 178), "arm cannot reach the pose"),
    Reason.ARM_COLLISION: ((204, 121, 167), "arm would collide"),
    Reason.INSERTION_BLOCKED: ((136, 34, 85), "straight insertion not possible"),
    Reason.APPROACH_NOT_FOUND: ((51, 34, 136), "no approach found"),
}
REASON_COLOURS = MappingProxyType({reason: colour for reason, (colour, _) in _SHOWN.items()})
REASON_TEXT = MappingProxyType({Reason.NONE: "safe"} | {reason: text for reason, (_, text) in _SHOWN.items()})


def css(colour: Rgb) -> str:
    """The colour as ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
