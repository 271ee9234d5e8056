"""Subject of the slices: one direction, its needle and the structures near it, or an image alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import ATTACHED_LIMB, OUTSIDE_BODY
from puncture_twin.planning.anatomy.unseen import BEYOND_IMAGE
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.search.bending import insertion_along
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.twin.report.numbers import clearance_text
from puncture_twin.twin.report.palette import OUTSIDE, organ_colours
from puncture_twin.twin.report.present import number

NEAR_MM = 30.0
"""A structure with a margin that lies nearer to the needle is drawn strongly and named."""
MOST_NEAR = 8
"""So many of them at most, the nearest."""

BESIDE: dict[str, tuple[str, Rgb]] = {
    OUTSIDE_BODY: ("beside the body: table, cloths, lines, and their unseen parts", (255, 170, 40)),
    ATTACHED_LIMB: ("what seems to be a limb", (255, 77, 240)),
    BEYOND_IMAGE: ("the body beyond the image", (120, 170, 255)),
}
"""Of an image alone: what no structure of the case names, by its name, for a person, and its colour."""


class Near(NamedTuple):
    """A structure near the needle."""

    name: str
    colour: Rgb
    clearance_mm: float
    margin_mm: float

    @property
    def text(self) -> str:
        """For a legend."""
        margin = f", margin {number(self.margin_mm, 0)}" if np.isfinite(self.margin_mm) else ""
        return f"{self.name.replace('_', ' ')}: {clearance_text(self.clearance_mm, 'mm')}{margin}"


@dataclass(frozen=True, eq=False)
class Subject:
    """One direction, as the slices show it.

    Attributes:
        anatomy: Structures, skin, and the CT where there is one.
        pick: The candidate; None for the image alone, in which nobody has proposed a needle yet.
        region_ct: Shape (3, 3), mm^2: the tip is expected within x' inv(region) x <= 1 in 95 of 100; None without
            declared errors.
    """

    case: Any
    anatomy: Any
    pick: Pick | None
    region_ct: Floats | None = None

    @property
    def outward_ct(self) -> Floats:
        """Unit vector from the target along the needle, shape (3,)."""
        assert self.pick is not None
        return np.asarray(self.pick.candidates.outward_ct[self.pick.row])

    @property
    def path_mm(self) -> float:
        """Target to skin, NaN without an entry."""
        return float("nan") if self.pick is None else float(self.pick.candidates.path.length[self.pick.row])

    @cached_property
    def colours(self) -> dict[str, Rgb]:
        """Colour of every structure, as in the other pictures; grey outside of the body."""
        inside = organ_colours(tuple(s.name for s in self.anatomy.structures))
        own = {} if self.pick is not None else {name: colour for name, (_, colour) in BESIDE.items()}
        return {**{s.name: OUTSIDE for s in self.anatomy.surroundings}, **inside, **own}

    @property
    def near(self) -> tuple[Near, ...]:
        """The structures with a margin that lie near the needle, nearest first."""
        return tuple(one for one in self._demanding if one.clearance_mm < NEAR_MM)[:MOST_NEAR]

    @property
    def named(self) -> tuple[Near, ...]:
        """Structures that a legend names: the near ones, or the nearest, however far it is."""
        return self.near or self._demanding[:1]

    @property
    def beside(self) -> list[tuple[str, Rgb]]:
        """Of an image alone, what was found that no structure names: for a legend."""
        names = {one.name for one in self.anatomy.checked}
        return [] if self.pick is not None else [line for name, line in BESIDE.items() if name in names]

    @property
    def has_unknown(self) -> bool:
        """Whether there is anything of which nobody knows what it is."""
        return any(str(one.role) == "unknown" for one in self.anatomy.checked)

    @cached_property
    def _demanding(self) -> tuple[Near, ...]:
        """All structures with a margin, nearest first."""
        if self.pick is None:
            return ()
        found, row = self.pick.candidates.clearance, self.pick.row
        rows = zip(found.structures, found.distance[row], found.margins, strict=True)
        demanding = [
            Near(name, self.colours.get(name, OUTSIDE), float(mm), float(margin))
            for name, mm, margin in rows
            if np.isfinite(margin)
        ]
        return tuple(sorted(demanding, key=lambda one: one.clearance_mm))

    @property
    def margin_mm(self) -> float:
        """The greatest margin of the structures near, 0 without any."""
        return max((one.margin_mm for one in self.near), default=0.0)

    @cached_property
    def bent_mm(self) -> Floats | None:
        """The shaft of a bevel that never turns, shape (m, 2): along the path from the target, and off it, mm.

        None where the case declares no tissue, or the path has no entry.
        """
        if self.case.bending is None or not np.isfinite(self.path_mm):
            return None
        found = insertion_along(
            self.case.bending, self.anatomy, self.case.target_ct, self.outward_ct, self.path_mm
        ).path
        return np.stack([self.path_mm - found.depth_mm, found.needle_mm], axis=1)

    @property
    def needle_radius_mm(self) -> float:
        """Half the needle's diameter."""
        return float(self.case.needle.radius_mm)

    @property
    def title(self) -> str:
        """The direction, or that there is none."""
        if self.pick is None:
            return "what the image shows; no needle is proposed here"
        angles = self.pick.candidates.at(self.pick.row)
        return f"θ {angles['theta_deg']:.4g}°, β {angles['beta_deg']:.4g}°"
