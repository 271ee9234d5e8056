"""The search for the first clear motion of one request."""

from __future__ import annotations

from puncture_twin.planning.reach.answer import ReachAnswer
from puncture_twin.planning.reach.survey import Surveyed
from puncture_twin.planning.reach.trial import Blocked


class FirstClear:
    """What is tried next, and what came of those before.

    Attributes:
        surveyed: The motions that kinematics allows.
        next: Which of them is to be tried; None when the search is over.
        answer: The first motion that touches nothing; None as long as there is none.
        blocks: What blocked the others, the best margin first.
    """

    def __init__(self, surveyed: Surveyed) -> None:
        self.surveyed = surveyed
        self.answer: ReachAnswer | None = None
        self.blocks: list[Blocked] = []
        self._hopeless: set[int] = set()
        self._insertions = surveyed.insertions(without=self._hopeless)
        self.next = next(self._insertions, None)

    def take(self, tried: ReachAnswer | Blocked) -> None:
        """What came of the next motion: it is the answer, or there is another next one."""
        assert self.next is not None  # it was tried
        if isinstance(tried, ReachAnswer):
            self.answer, self.next = tried, None
            return
        self.blocks.append(tried)
        if tried.at_any_roll:
            self._hopeless.add(self.next.branch)
        self.next = next(self._insertions, None)
