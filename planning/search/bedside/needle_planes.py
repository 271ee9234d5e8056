"""The needle as axial slices see it: in-plane and out-of-plane angle, and the gantry tilt that brings it in plane.

With u the unit vector from the target outward, and l, a, h its parts toward the patient's left, front and head:

    out-of-plane = asin(h),  in-plane = atan2(l, a),  gantry tilt = atan(-h / a)

A slice tilted by t (top toward the feet where t > 0, as ``[gantry] tilt_deg``) has the normal (0, sin t, cos t) in the
axes (left, front, head); the needle lies in it where a sin t + h cos t = 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats

LEAST_IN_PLANE = 1e-6
"""Of a unit vector: a needle that runs along the patient has no angle within the slice."""

MOST_TILT = np.radians(30.0)
"""To which gantries of CT scanners tilt at most."""


class NeedlePlanes(NamedTuple):
    """Angles of one needle, rad.

    Attributes:
        in_plane: Between the patient's front and the needle as it is seen in the axial slice, -π..π; positive: the hub
            is on the patient's left. NaN for a needle along the patient.
        out_of_plane: Between the axial slice and the needle, -π/2..π/2; positive: the hub leans toward the head.
        gantry_tilt: At which the needle lies in the slice, -π/2..π/2; positive: the top leans toward the feet.
    """

    in_plane: float
    out_of_plane: float
    gantry_tilt: float

    def rows(self) -> tuple[tuple[str, str], ...]:
        """What it is, and how a person reads it."""
        beyond = f", more than the usual {np.degrees(MOST_TILT):.0f}" if abs(self.gantry_tilt) > MOST_TILT else ""
        seen = _angle(self.in_plane, " from the front", ", hub to the left", ", hub to the right")
        along = _angle(self.out_of_plane, "", ", hub toward the head", ", hub toward the feet")
        tilt = _angle(self.gantry_tilt, "", ", top toward the feet", ", top toward the head")
        return (
            ("in-plane angle", seen if np.isfinite(self.in_plane) else "none: the needle runs along the patient"),
            ("out-of-plane angle", along),
            ("gantry tilt", tilt + beyond),
        )

    def summary(self) -> dict[str, Any]:
        """Plain values: degrees; null where there is no angle."""
        angles = {f"{name}_deg": float(np.degrees(angle)) for name, angle in self._asdict().items()}
        return {name: angle if np.isfinite(angle) else None for name, angle in angles.items()}


def _angle(angle: float, of: str, positive: str, negative: str) -> str:
    """An angle with its side; none for what is shown as 0."""
    size = f"{abs(np.degrees(angle)):.1f}"
    side = "" if float(size) == 0.0 else positive if angle > 0 else negative
    return f"{size} deg{of}{side}"


def needle_planes(outward_ct: Floats) -> NeedlePlanes:
    """The angles of a direction from the target outward, shape (3,), unit, LPS."""
    left, front, head = float(outward_ct[0]), -float(outward_ct[1]), float(outward_ct[2])
    in_plane = np.arctan2(left, front) if np.hypot(left, front) > LEAST_IN_PLANE else np.nan
    tilt = np.arctan2(-head * np.copysign(1.0, front), abs(front))
    return NeedlePlanes(float(in_plane), float(np.arcsin(np.clip(head, -1.0, 1.0))), float(tilt) + 0.0)
