"""FCL's answer to one check."""

from __future__ import annotations

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.checker import Check, Contact
from puncture_twin.planning.collision.patient import FclPatient


def fcl_contact(check: Check, frames: Floats) -> Contact | None:
    """The contact, if the shapes of a check touch where ``link_poses`` (7, 4, 4) has them."""
    check.second.setTransform(check.second_body.pose(frames))
    if check.first_body is not None:
        assert not isinstance(check.first, FclPatient)  # it belongs to no body
        check.first.setTransform(check.first_body.pose(frames))
    return check.contact_found()
