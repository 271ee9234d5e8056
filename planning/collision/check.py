"""One question to FCL, and its answer."""

from __future__ import annotations

from typing import NamedTuple

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies.body import FLANGE_FRAME, Body
from puncture_twin.planning.collision.bodies.shapes import touch
from puncture_twin.planning.collision.bodies.solid import Solid
from puncture_twin.planning.collision.patient import FclPatient
from puncture_twin.planning.collision.state_checker import Contact


class Check(NamedTuple):
    """One question to FCL: do two shapes touch."""

    contact: Contact
    """What it means if they do."""
    first: Solid | FclPatient
    """The patient, a box, or a piece of a body."""
    second: Solid
    first_body: Body | None
    """The body that ``first`` moves with; None for skin and boxes."""
    second_body: Body
    hulls: tuple[Floats | None, Floats] | None
    """Corners that enclose either, in the frames of their shapes; None for a box, and for the pair with the skin."""

    @property
    def before_last_joint(self) -> bool:
        """Whether it is of two bodies of the arm neither of which moves with the last joint."""
        return self.first_body is not None and max(self.first_body.frame, self.second_body.frame) < FLANGE_FRAME

    def contact_at(self, frames: Floats) -> Contact | None:
        """The contact, if the two shapes touch where ``link_poses`` (7, 4, 4) has them; see `contact_found`."""
        self.second.place(self.second_body.pose(frames))
        if self.first_body is not None:
            assert not isinstance(self.first, FclPatient)  # it belongs to no body
            self.first.place(self.first_body.pose(frames))
        return self.contact_found()

    def contact_found(self) -> Contact | None:
        """The contact, if the two shapes touch where they are: ``outside_body`` where that is all of the patient."""
        if not isinstance(self.first, FclPatient):
            return self.contact if touch(self.first.made, self.second.made) else None
        part = self.first.touched_part(self.second_body)
        return None if part is None else self.contact._replace(other=part)
