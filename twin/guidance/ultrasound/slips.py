"""Calibration of a recording, with refusal of one written in another reading: inverse poses, swapped arms, metres.

Such a recording still has a best fit, with residuals of centimetres, and no pose stands out because all are wrong. So
where the reading as given does not fit, the slips that people make are undone one by one; the one that then fits is
named. A recording that fits in no reading is refused too: its calibration would send the needle anywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.geometry.rigid import inverse
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase


def held_length_mm(case: SelfcalCase | None) -> float | None:
    """The needle's length where the case holds it."""
    return case.content.needle.length_mm if case is not None and case.content.hold_needle_length else None


def calibrate_case(recording: Recording, case: SelfcalCase | None, *, hold: bool = True) -> Calibration:
    """Calibrate with the case's noise and, where it is to be held, the needle's length.

    Pixels are solved for where the recording has them.
    """
    noise = None if case is None or case.content.noise is None else case.content.noise.noise()
    length = held_length_mm(case) if hold else None
    arms = None if case is None or recording.q_probe is None else case.declared_arms
    return calibrate(recording, noise=noise, needle_length_mm=length, scale=recording.pixels, arms=arms)


Reading = Callable[[Recording], Recording]

SUSPECT_MM = 1.5
"""Residuals (rms) from which on other readings are tried: three times the usual ones."""

SOUND_MM = 5.0
"""Residuals (rms) beyond which nothing was calibrated, whatever the reason."""

BETTER = 1 / 3
"""A reading whose residuals are below this part of the given one's, and are not suspect, is the right one."""

LEAST_REACH_MM = 20.0
"""An arm whose flange never leaves this distance of its base was written in metres."""

ALLOWED = "A = T_base1_end1 and B = T_base2_end2 in mm, rotations by rows, P in mm"


def checked_calibration(
    recording: Recording, case: SelfcalCase | None, where: Path, *, hold: bool = True
) -> Calibration:
    """Calibration of a recording from outside; one that was read otherwise than meant is refused.

    Args:
        case: As `calibrate_case` takes it.
        hold: Whether the needle's length is held where the case says so.

    Raises:
        InputError: Another reading fits and this one does not, or none does; or what `calibrate_case` refuses.
    """
    _check_reach(recording, where)
    try:
        found = calibrate_case(recording, case, hold=hold)
    except InputError as error:
        rms_mm = _residual_mm(lambda r: _read(r, r.A, r.B, r.P), recording)
        if rms_mm > SUSPECT_MM:
            _refuse_slip(recording, rms_mm, where)
        raise error.at(where) from error
    if found.rms_mm > SUSPECT_MM:
        _refuse_slip(recording, found.rms_mm, where)
    if found.rms_mm > SOUND_MM:
        what = f"residuals of {found.rms_mm:.3g} mm (rms): the poses and the image do not belong together"
        refuse(what, where, f"residuals up to {SOUND_MM:g} mm; {ALLOWED}", "residuals_too_large")
    return found


def _check_reach(recording: Recording, where: Path) -> None:
    for name, T in (("A", recording.A), ("B", recording.B)):
        farthest = float(np.linalg.norm(T[:, :3, 3], axis=1).max())
        if farthest < LEAST_REACH_MM:
            what = f"the flange of {name} is never farther than {farthest:.3g} mm from its base: metres?"
            refuse(what, where, ALLOWED, "wrong_unit")


def _refuse_slip(recording: Recording, rms_mm: float, where: Path) -> None:
    for slip, undo in SLIPS.items():
        other = _residual_mm(undo, recording)
        if other < SUSPECT_MM and other < BETTER * rms_mm:
            as_given = f"residuals {rms_mm:.3g} mm" if np.isfinite(rms_mm) else "no fit"
            what = f"it does not fit as given ({as_given}), but it fits ({other:.2g} mm rms) if {slip}"
            refuse(what, where, ALLOWED, "recording_slip")


def _residual_mm(undo: Reading, recording: Recording) -> float:
    """Residuals (rms) of the other reading over all poses, mm; infinite where it cannot be calibrated."""
    try:
        return calibrate(undo(recording), scale=recording.pixels, direction=False).rms_mm
    except InputError:
        return float("inf")


def _read(recording: Recording, A: Floats, B: Floats, P: Floats) -> Recording:
    return Recording(A, B, P, None, recording.names, recording.pixels)


def _later(recording: Recording, rows: int) -> Recording:
    """The poses with the tip of the row that follows so many rows later."""
    first, last = (slice(0, -rows), slice(rows, None)) if rows > 0 else (slice(-rows, None), slice(0, rows))
    names = recording.names[first]
    return Recording(recording.A[first], recording.B[first], recording.P[last], None, names, recording.pixels)


def _transposed(T: Floats) -> Floats:
    found = np.array(T)
    found[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    return found


def _longer(T: Floats, factor: float) -> Floats:
    found = np.array(T)
    found[:, :3, 3] *= factor
    return found


SLIPS: Mapping[str, Reading] = MappingProxyType(
    {
        "A and B are inverse (base in flange)": lambda r: _read(r, inverse(r.A), inverse(r.B), r.P),
        "A is inverse (base in flange)": lambda r: _read(r, inverse(r.A), r.B, r.P),
        "B is inverse (base in flange)": lambda r: _read(r, r.A, inverse(r.B), r.P),
        "the arms A and B are swapped": lambda r: _read(r, r.B, r.A, r.P),
        "the arms are swapped and inverse": lambda r: _read(r, inverse(r.B), inverse(r.A), r.P),
        "the rotations of A and B are written by columns": lambda r: _read(r, _transposed(r.A), _transposed(r.B), r.P),
        "the rotations of A are written by columns": lambda r: _read(r, _transposed(r.A), r.B, r.P),
        "the rotations of B are written by columns": lambda r: _read(r, r.A, _transposed(r.B), r.P),
        "A and B are in cm": lambda r: _read(r, _longer(r.A, 10), _longer(r.B, 10), r.P),
        "P is in metres": lambda r: _read(r, r.A, r.B, r.P * 1000),
        "P is in cm": lambda r: _read(r, r.A, r.B, r.P * 10),
        "P_w has the other sign": lambda r: _read(r, r.A, r.B, r.P * np.array([1, 1, -1])[: r.P.shape[1]]),
        "each picture belongs to the row before it": lambda r: _later(r, 1),
        "each picture belongs to the row behind it": lambda r: _later(r, -1),
    }
)
"""What people write instead of `ALLOWED`, in words, and how it is undone."""
