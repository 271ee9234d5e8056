"""No slip passes in silence, and no true input is refused: a draw a kind, or as many in all as PUNCTURE_TWIN_SLIPS."""

import os

import pytest

from slips import devices, files, placements
from slips.kinds import SILENT
from slips.runner import KINDS, run

DRAWS = int(os.environ.get("PUNCTURE_TWIN_SLIPS", "0"))
SAMPLE = (*files.KINDS, *devices.KINDS, placements.KINDS[0], placements.KINDS[-5])
"""Draws of the other kinds of places take seconds each."""


@pytest.mark.parametrize("kind", KINDS if DRAWS else SAMPLE, ids=lambda kind: kind.name)
def test_a_slip_is_refused_or_said_and_its_true_twin_is_not_refused(kind):
    """The draws that are neither are listed; of the kinds with a known hole no more pass than were measured."""
    found = run(kind, DRAWS, seed=0)
    true = [line for line in found.wrong if SILENT not in line]
    assert not true
    assert found.slips[SILENT] <= kind.may_pass * found.slips.total(), found.wrong
