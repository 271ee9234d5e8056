"""What a check of configurations answers, and the names behind which one checker takes another's place."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np

from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision.bodies.body import BODY_NAMES
from puncture_twin.planning.collision.sweep import SweptBodies

PATIENT = "patient"


class Contact(NamedTuple):
    """Two bodies that touch, such as ``("forearm", "patient")``; a body of the arm first."""

    body: str
    other: str


NEEDLE_IN_PATIENT = Contact("needle", PATIENT)
"""What may happen while the needle goes in."""


class FirstContact(NamedTuple):
    """The first contact along a path: at which of its states, and of what."""

    at: int
    """Index of the state."""
    contact: Contact


class Nearest(NamedTuple):
    """The smallest distance between the arm and something else; infinite, with empty names, where there is nothing."""

    mm: float
    body: str
    other: str


class Distances(NamedTuple):
    """How close the arm is, 0 where it touches."""

    patient: Nearest
    """Moving links and holder to the skin."""
    needle: Nearest
    """Needle to the skin: 0 while it goes in."""
    boxes: Nearest
    """Moving links, holder and needle to the workcell's boxes."""


DISTANCE_PAIRS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"patient": BODY_NAMES[1:-1], "needle": BODY_NAMES[-1:], "boxes": BODY_NAMES[1:]}
)
"""The kinds of distance, by the fields of ``Distances``, and the bodies that each is measured from."""


class StateChecker(Protocol):
    """Checks configurations of one arm in one scene. A faster checker takes this one's place behind these names."""

    @property
    def model(self) -> UrModel:
        """The arm."""

    @property
    def tool(self) -> Tool:
        """What the flange carries."""

    @property
    def swept(self) -> SweptBodies:
        """The arm's moving bodies, to bound how far they move."""

    def contact(self, q: Floats, *, needle_may_touch_patient: bool) -> Contact | None:
        """The first contact found at ``q``, shape (6,), rad; None when the arm is clear."""

    def contacts(
        self, q: Floats, *, needle_may_touch_patient: bool, round_clear: Bools | None = None
    ) -> list[Contact | None]:
        """Of each of many states (n, 6), rad, by itself what ``contact`` says.

        Where ``round_clear`` (n,) says so, holder and needle are known to touch neither patient nor boxes.
        """

    def folded(self, q: Floats) -> Bools:
        """At which of many states (n, 6), rad, two links touch that come before the last joint: so at any q6."""

    def first_contact(self, q_path: Floats, *, needle_may_touch_patient: bool) -> FirstContact | None:
        """The first state of ``q_path`` (m, 6), rad, with a contact, and the contact; None when all are clear."""

    def nearest(self, q: Floats, pair: str, body: str | None = None) -> Nearest:
        """One of ``DISTANCE_PAIRS`` at ``q``, shape (6,), rad; of one body alone when named."""

    def distances(self, q: Floats) -> Distances:
        """All of them."""

    def sweep_mm(self, q_path: Floats) -> Floats:
        """Bound on every body's motion along each segment of ``q_path`` (m, 6): shape (m - 1,), mm."""

    def body_sweeps_mm(self, q_path: Floats) -> dict[str, Floats]:
        """Bound on each moving body's motion along each segment, by name."""


def require_finite(q: Floats) -> None:
    """Refuse joint angles that are not finite: FCL would call them free.

    Raises:
        InputError: If one is not.
    """
    if not np.isfinite(q).all():
        raise InputError(f"joint angles {q} are not finite", where="collision check", allowed="six angles in rad")
