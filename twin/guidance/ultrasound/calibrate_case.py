"""The calibration of a recording, with what a case says of its noise, its needle and the arms' errors."""

from __future__ import annotations

from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase


def calibrate_case(recording: Recording, case: SelfcalCase | None) -> Calibration:
    """Calibrate with what the case says of noise and needle; pixels are solved for where the recording has them."""
    noise = None if case is None or case.content.noise is None else case.content.noise.noise()
    length = case.content.needle.length_mm if case is not None and case.content.hold_needle_length else None
    arms = None if case is None or recording.q_probe is None else case.declared_arms
    return calibrate(recording, noise=noise, needle_length_mm=length, scale=recording.pixels, arms=arms)
