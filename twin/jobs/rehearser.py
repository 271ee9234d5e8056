"""A case's plans, executed in the simulator and filmed: what a second process can do while pictures are drawn.

PyBullet and the film are loaded by whoever has a `Rehearser`, not by whoever only asks for one.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # nothing is loaded before it is needed
    from puncture_twin.planning.anatomy.anatomy import Anatomy
    from puncture_twin.planning.case.case import Case
    from puncture_twin.planning.plan.plan import Plan
    from puncture_twin.twin.plant.truth import Truth
    from puncture_twin.twin.rehearsal.result import Rehearsal, Scale


def get_ready() -> None:
    """Load what a `Rehearser` needs, its compiled kernels too."""
    from puncture_twin.twin.jobs.first_use import draw_once
    from puncture_twin.twin.rehearsal import rehearsal as _simulator
    from puncture_twin.twin.report.scene import film as _film

    del _simulator, _film
    draw_once()


class Rehearser:
    """Executes plans of one case, and films the last.

    Args:
        case: The case.
        anatomy: Its structures; trees for their distances are built here.
    """

    def __init__(self, case: Case, anatomy: Anatomy) -> None:
        from puncture_twin.planning.clearance.fcl_engine import FclEngine

        self._case, self._anatomy = case, anatomy
        self._engine = FclEngine([structure.mesh for structure in anatomy.structures])
        self._last: tuple[Rehearsal, Plan] | None = None

    def rehearse(self, plan: Plan, truth: Truth, scale: Scale | None) -> Rehearsal:
        """What `rehearse` measures, with the place of its error on a scale.

        Raises:
            InputError: See `rehearse`.
        """
        from puncture_twin.twin.rehearsal.rehearsal import rehearse

        done = rehearse(plan, self._case, self._anatomy, truth, self._engine)
        done = replace(done, standing=None if scale is None else scale.of(done.tip_error_mm))
        self._last = done, plan
        return done

    def film(self, path: Path) -> Path:
        """Film what was rehearsed last; the file that was written."""
        from puncture_twin.twin.report.scene.film import draw_film

        assert self._last is not None
        return draw_film(*self._last, self._case, self._anatomy, path)
