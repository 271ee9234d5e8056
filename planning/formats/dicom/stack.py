"""Slices in the order in which they lie, and whether they make one regular stack.

Order and steps come from each slice's own position and orientation. Names, instance numbers and slice locations are
not looked at: they are often wrong, and nothing in the patient depends on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.slices import Plane, Slice

AXES_TOLERANCE = 1e-3
"""By which the axes of two slices may differ: 0.25 mm at the corner of a slice, below a pixel; cosines are rounded."""
PLACE_TOLERANCE_MM = 0.1
"""By which a slice may lie off its place in the stack: positions that are rounded to a tenth are within 0.05."""
PLACE_TOLERANCE = 0.1
"""The same as a fraction of the step, where that is less."""
SPACING_TOLERANCE = 1e-4
"""By which the pixels of two slices may differ in size, as a fraction."""
SHOWN = 4
"""Slices that a message names."""


@dataclass(frozen=True, eq=False)
class Stack:
    """Slices at even steps.

    Attributes:
        slices: In the order in which they lie along the normal.
        plane: The first one's.
        step_ct: Shape (3,), from each slice to the next, LPS mm.
    """

    slices: tuple[Slice, ...]
    plane: Plane
    step_ct: Floats

    @property
    def T_ct_index(self) -> Floats:  # noqa: N802  a frame's name
        """Shape (4, 4), maps (column, row, slice) to LPS mm; sheared where the gantry was tilted."""
        T = np.eye(4)
        T[:3, :2] = self.plane.axes_ct * self.plane.spacing_mm
        T[:3, 2] = self.step_ct
        T[:3, 3] = self.plane.origin_ct
        return T


def stack_of(slices: Sequence[Slice], where: Path) -> Stack:
    """The stack that slices make.

    Raises:
        InputError: Fewer than two, other orientations or pixel sizes, several at one place, a step that is missing,
            or uneven steps; the slices are named.
    """
    if len(slices) < 2:
        raise InputError(f"{len(slices)} slice", where=where, allowed="a series of at least 2 slices")
    first = slices[0]
    for other in slices[1:]:
        _check_alike(first, other, where)
    normal = first.plane.normal_ct
    ordered = sorted(slices, key=lambda one: float(one.plane.origin_ct @ normal))
    origins = np.array([one.plane.origin_ct for one in ordered])
    steps = np.diff(origins @ normal)
    _check_one_place(ordered, steps, where)
    step = float(np.median(steps))
    _check_steps(ordered, steps, step, where)
    step_ct = (origins[-1] - origins[0]) / (len(ordered) - 1)
    off = np.linalg.norm(origins - origins[0] - np.arange(len(ordered))[:, None] * step_ct, axis=1)
    worst = int(np.argmax(off))
    if off[worst] > _tolerance(step):
        what = f"{ordered[worst].label} lies {off[worst]:.2f} mm off the line of the others"
        raise InputError(what, where=where, allowed=f"slices along one straight line, to {_tolerance(step):.2g} mm")
    return Stack(tuple(ordered), ordered[0].plane, step_ct)


def _check_alike(first: Slice, other: Slice, where: Path) -> None:
    difference = float(np.abs(first.plane.axes_ct - other.plane.axes_ct).max())
    if difference > AXES_TOLERANCE:
        angle = np.degrees(np.arccos(np.clip(first.plane.normal_ct @ other.plane.normal_ct, -1.0, 1.0)))
        what = f"{first.label} and {other.label} have other orientations (normals {angle:.1f} degrees apart)"
        raise InputError(what, where=where, allowed="slices of one orientation")
    ratios = np.array(first.plane.spacing_mm) / other.plane.spacing_mm
    if np.abs(ratios - 1.0).max() > SPACING_TOLERANCE:
        what = f"{first.label} and {other.label} have pixels of other sizes"
        raise InputError(
            f"{what}: {first.plane.spacing_mm} and {other.plane.spacing_mm} mm", where=where, allowed="one"
        )


def _check_one_place(ordered: Sequence[Slice], steps: Floats, where: Path) -> None:
    """Two slices nearer than a tenth of the step lie at one place."""
    near = steps < PLACE_TOLERANCE * np.max(steps, initial=0.0)
    near |= steps < 1e-3
    if not near.any():
        return
    named = [f"{ordered[k].label} and {ordered[k + 1].label}" for k in np.flatnonzero(near).tolist()]
    more = f" and {len(named) - SHOWN} pairs more" if len(named) > SHOWN else ""
    what = f"several slices at one place: {'; '.join(named[:SHOWN])}{more}"
    raise InputError(what, where=where, allowed="one slice at each place (one time point, no copies)")


def _check_steps(ordered: Sequence[Slice], steps: Floats, step: float, where: Path) -> None:
    wrong = np.flatnonzero(np.abs(steps - step) > _tolerance(step))
    if not len(wrong):
        return
    at = int(wrong[0])
    between = f"between {ordered[at].label} and {ordered[at + 1].label}"
    times = steps[at] / step
    if round(times) >= 2 and abs(times - round(times)) * step <= _tolerance(step):
        missing = round(times) - 1
        what = f"{missing} slice{' is' if missing == 1 else 's are'} missing {between}: {steps[at]:.4g} mm apart"
    else:
        what = f"uneven steps: {steps[at]:.4g} mm {between}"
    more = f", and at {len(wrong) - 1} places more" if len(wrong) > 1 else ""
    allowed = f"even steps; the usual one here is {step:.4g} mm (resample the series, or export it again)"
    raise InputError(f"{what}{more}", where=where, allowed=allowed)


def _tolerance(step: float) -> float:
    return min(PLACE_TOLERANCE_MM, PLACE_TOLERANCE * step)
