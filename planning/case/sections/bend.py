"""The needle that bends, as a case declares it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.tables.needle_section import NeedleSection, TissueSection
from puncture_twin.planning.formats.labels.naming import REST, ByName
from puncture_twin.planning.needle.deflection import Bending
from puncture_twin.planning.needle.shaft import GAUGES, STEEL_GPA, Shaft
from puncture_twin.planning.needle.tissue import Tissue

SAME_MM = 0.03
"""By which ``diameter_mm`` may differ from its gauge: twice the usual tolerance of the chart."""


def bending_of(needle: NeedleSection, tissue: Mapping[str, TissueSection], where: str | Path) -> Bending | None:
    """The bending of a case's needle; None where it declares no tissue.

    Raises:
        InputError: Half of what is needed, an unknown gauge, or one that is not the needle's diameter.
    """
    stated = [key for key in ("gauge", "solid", "bevel_deg", "modulus_gpa") if getattr(needle, key) is not None]
    if not tissue:
        if stated:
            message = f"needle.{stated[0]}: how far it bends depends on the tissue, and there is none"
            raise InputError(message, where=where, allowed="[tissue.PATTERN] for each pattern of names; or no such key")
        return None
    if needle.bevel_deg is None:
        raise InputError("[tissue] needs needle.bevel_deg", where=where, allowed="degrees; 0 for a symmetric tip")
    if REST not in tissue:
        message = f'[tissue."{REST}"] is missing: between the structures there is tissue too'
        raise InputError(message, where=where, allowed=f'a table for "{REST}", the rest of the body')
    tissues = {pattern: Tissue(**section.model_dump()) for pattern, section in tissue.items()}
    return Bending(_shaft(needle, where), float(np.radians(needle.bevel_deg)), ByName(tissues))


def _shaft(needle: NeedleSection, where: str | Path) -> Shaft:
    modulus = STEEL_GPA if needle.modulus_gpa is None else needle.modulus_gpa
    if needle.gauge is None:
        return Shaft(needle.shaft_mm, needle.diameter_mm, 0.0, modulus)
    if needle.gauge not in GAUGES:
        allowed = f"{min(GAUGES)} to {max(GAUGES)}"
        raise InputError(f"needle.gauge {needle.gauge} is not in the chart", where=where, allowed=allowed)
    gauge = GAUGES[needle.gauge]
    if abs(gauge.outer_mm - needle.diameter_mm) > SAME_MM:
        message = f"needle.gauge {needle.gauge} is {gauge.outer_mm:g} mm wide, diameter_mm says {needle.diameter_mm:g}"
        raise InputError(message, where=where, allowed=f"diameter_mm within {SAME_MM:g} of the gauge's")
    return Shaft(needle.shaft_mm, gauge.outer_mm, 0.0 if needle.solid else gauge.inner_mm, modulus)
