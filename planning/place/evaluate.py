"""What a placement is worth: the search's own answer for the arm, for every organ-safe direction."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.state_checker import Contact
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.place.directions import WantedDirections
from puncture_twin.planning.reach.answer import ReachRequest
from puncture_twin.planning.reach.reach import assess_reach_all


@dataclass(frozen=True, eq=False)
class Verdict:
    """The exact answer for one placement.

    Attributes:
        fraction: Solid angle of the reached directions over that of all that are wanted, 0..1.
        reached: How many directions the arm can reach and insert along.
        count: How many directions are wanted.
        margin: Mean reach margin of the reached ones, 0..1; 0 for none.
        reasons: How many of the others fell to which reason.
        home_contact: What the arm touches in its home configuration, or "".
        q_insertion: Shape (reached, 6), rad, the tip on the target.
    """

    fraction: float
    reached: int
    count: int
    margin: float
    reasons: Mapping[str, int]
    home_contact: str
    q_insertion: Floats


@dataclass(frozen=True, eq=False)
class PlacementCheck:
    """Checks placements. Its values can be sent to another process.

    Attributes:
        model: The arm.
        tool: What its flange carries.
        skin: CT frame.
        outside: CT frame, what the CT shows outside of it, or None.
        fixed: Boxes that stand with the patient; their ``T_base_box`` is in the CT frame.
        carried: Boxes that stand with the arm, base frame.
        padding_mm: Of the arm.
        target_ct: Shape (3,), mm.
        wanted: The directions.
        home: Shape (6,), rad.
    """

    model: UrModel
    tool: Tool
    skin: TriangleMesh
    outside: TriangleMesh | None
    fixed: tuple[Box, ...]
    carried: tuple[Box, ...]
    padding_mm: float
    target_ct: Floats
    wanted: WantedDirections
    home: Floats

    @cached_property
    def patient(self) -> TriangleMesh:
        """CT frame: the skin, and what the CT shows outside of it."""
        return self.skin if self.outside is None else joined([self.skin, self.outside])

    def verdict(self, T_base_ct: Floats) -> Verdict:
        """Check every direction.

        Raises:
            InputError: The base stands in the patient.
        """
        checker = self._checker(T_base_ct)
        target = T_base_ct[:3, :3] @ self.target_ct + T_base_ct[:3, 3]
        requests = [
            ReachRequest(target, T_base_ct[:3, :3] @ outward, self.tool.needle_length_mm, float(standoff))
            for outward, standoff in zip(self.wanted.outward_ct, self.wanted.standoff_mm, strict=True)
        ]
        answers = assess_reach_all(checker, requests)
        reached = np.array([answer.reachable for answer in answers], bool)
        margins = [answer.margin for answer in answers if answer.reachable]
        ends = [answer.insertion_q[-1] for answer in answers if answer.reachable]
        return Verdict(
            fraction=float(self.wanted.weight[reached].sum()),
            reached=int(reached.sum()),
            count=len(reached),
            margin=float(np.mean(margins)) if margins else 0.0,
            reasons=dict(Counter(answer.reason.value for answer in answers if not answer.reachable).most_common()),
            home_contact=_contact_text(checker.contact(self.home, needle_may_touch_patient=False)),
            q_insertion=np.array(ends).reshape(-1, 6),
        )

    def _checker(self, T_base_ct: Floats) -> FastChecker:
        boxes = [Box(box.name, T_base_ct @ box.T_base_box, box.size_mm) for box in self.fixed]
        outside = None if self.outside is None else self.outside.transformed(T_base_ct)
        model, everything = self.model, (*boxes, *self.carried)
        skin, cache = self.skin.transformed(T_base_ct), user_cache()
        return FastChecker(model, self.tool, everything, skin, outside=outside, padding_mm=self.padding_mm, cache=cache)


def _contact_text(contact: Contact | None) -> str:
    return "" if contact is None else f"{contact.body} touches {contact.other}"
