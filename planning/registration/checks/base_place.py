"""Can the robot's base be where a case puts it? What physics excludes, and what hardly is so, however it is stated."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.registration.checks.patient_place import ALLOWANCE_MM, in_box, lying
from puncture_twin.planning.registration.checks.touching import out_of_reach, shoulder_within, stands_in_patient

OF_MOUNT = (
    "robot.mount: {what}; the usual causes are a position in other axes, from another origin or in another unit than "
    "the case's, and axes of another robot"
)
OF_MARKERS = (
    "registration: by the markers {what}; the usual causes are touches in other axes than the base's (a URDF's "
    "base_link is turned by half a turn), and lists of another patient or robot"
)


class BasePlace(NamedTuple):
    """What speaks against a place of the base."""

    impossible: str
    """Why nothing can be so, or empty."""
    unlikely: str
    """What hardly is so, or empty."""
    rests_on: str
    """The obstacle of frame ``base`` that the patient lies on, or empty."""


def base_place(case: Case, skin: TriangleMesh, T_base_ct: Floats) -> BasePlace:
    """What speaks against a place of the base.

    Args:
        case: For arm, needle, target and obstacles.
        skin: CT frame.
        T_base_ct: Shape (4, 4), mm.
    """
    impossible = ""
    if stands_in_patient(case, skin, T_base_ct):
        impossible = "the robot's base would stand in the patient"
    elif box := in_box(case, skin, T_base_ct):
        impossible = f"the patient would lie more than {ALLOWANCE_MM:g} mm deep in obstacle '{box}' or through it"
    bed = lying(case, skin, T_base_ct)
    far = "the target would be out of the arm's reach" if out_of_reach(case, T_base_ct) else ""
    within = shoulder_within(case, T_base_ct)
    shoulder = f"the robot's shoulder would be in obstacle '{within}'" if within else ""
    return BasePlace(impossible, " and ".join(filter(None, (far, shoulder, bed.off))), bed.on)


def place_warnings(case: Case, skin: TriangleMesh, T_base_ct: Floats, text: str) -> Iterator[str]:
    """One sentence where something speaks against the place of a mount or of markers.

    They say in words where the base is, and have no other reading that could be meant, so they are not refused: without
    an arm the verdicts are about the organs alone, and with one nothing is reached from there.

    Args:
        case: For arm, needle, target and obstacles.
        skin: CT frame.
        T_base_ct: Shape (4, 4), mm.
        text: `OF_MOUNT` or `OF_MARKERS`.
    """
    place = base_place(case, skin, T_base_ct)
    if what := place.impossible or place.unlikely:
        yield text.format(what=what)
