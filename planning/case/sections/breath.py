"""The breathing that a case declares, in mm and in the CT's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.entry import ANATOMICAL_LPS
from puncture_twin.planning.case.tables.breathing_section import BreathingSection
from puncture_twin.planning.case.toml_types import Vector
from puncture_twin.planning.formats.labels.naming import ByName
from puncture_twin.planning.geometry.spaces import Space, to_lps


def breathing_of(section: BreathingSection | None, space: Space, where: str | Path) -> Breathing | None:
    """The breathing of a case; None where it declares none.

    Args:
        section: As the case states it.
        space: Of the case, in which a direction is meant.
        where: For errors.

    Raises:
        InputError: A direction without length, or an anatomical one in a space that knows no patient.
    """
    if section is None:
        return None
    return Breathing(
        amplitude_mm=section.amplitude_mm,
        direction_ct=_unit(section.direction, space, where),
        weights=ByName(section.weights),
        phases=section.phases,
        exponent=section.exponent,
        scanned_at=section.scanned_at,
        gate=section.gate,
    )


def _unit(direction: str | Vector, space: Space, where: str | Path) -> Floats:
    """Shape (3,), unit, LPS (or the case's local frame)."""
    if isinstance(direction, str):
        if space is Space.LOCAL:
            message = f'breathing.direction: space "local" has no {direction}'
            raise InputError(message, where=where, allowed="direction = [x, y, z]")
        return np.array(ANATOMICAL_LPS[direction], dtype=np.float64)
    vector = to_lps(np.array([direction], dtype=np.float64), space)[0]
    length = float(np.linalg.norm(vector))
    if length == 0:
        raise InputError("breathing.direction is zero", where=where, allowed="a direction of any length")
    return np.asarray(vector / length)
