"""The robot's base must not stand in the patient."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.arm.links import collision_links
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision.bodies.body import Body
from puncture_twin.planning.collision.patient import FclPatient
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.winding import winding_number


class BaseInPatientError(InputError):
    """The robot's base stands where the patient is, or their table."""


def refuse_base_in(
    model: UrModel, base: Body, placed: FclPatient, patient: TriangleMesh, surface: TriangleMesh
) -> None:
    """Refuse a base that stands in the patient, or in what the CT shows outside of the body.

    Args:
        model: The arm.
        base: Its first body.
        placed: Both surfaces for FCL.
        patient: The skin, base frame, mm.
        surface: The skin, and behind it what the CT shows besides, likewise; the same where that is nothing.

    Raises:
        BaseInPatientError: It does.
    """
    centre = collision_links(model)[0].mesh.bounds.mean(axis=0)
    met = placed.skin.touches(base.bare.surface, base.box) or placed.skin.has_part_within(base)
    if met or _encloses(patient, centre):
        what = "the robot's base stands in the patient"
        raise BaseInPatientError(what, where="workcell", allowed="a base outside the skin")
    if surface is not patient and _encloses(surface, centre):
        what = "the robot's base stands in what is not known to be free: the table that a CT shows, or beyond its end"
        allowed = 'a base outside of it; where no body lies there, [ct] arms = "none" or beyond_mm'
        raise BaseInPatientError(what, where="workcell", allowed=allowed, code="base_in_unseen")


def _encloses(mesh: TriangleMesh, point: Floats) -> bool:
    """Whether a point lies inside a surface; more than half around an open one counts too."""
    low, high = mesh.bounds
    if not np.all((point >= low) & (point <= high)) and abs(winding_number(mesh, point)) <= 0.5:
        return False  # outside, or an open surface that goes less than half around: whether it is open need not be told
    side = side_of(mesh, point)
    return side is Side.INSIDE or (side is Side.UNKNOWN and abs(winding_number(mesh, point)) > 0.5)
