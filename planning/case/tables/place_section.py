"""``[place]``: where ``place`` may stand the arm."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from puncture_twin.planning.case.toml_types import Anatomical, Coordinate, Name, Number, Section, Vector

Range = tuple[Coordinate, Coordinate]

MountName = Literal["floor", "rail", "ceiling", "side"]


class MountBounds(Section):
    """Where a base of one kind may stand, seen from the target; what is left out follows from the arm's length."""

    along_mm: Range | None = None
    across_mm: Range | None = None
    height_mm: Range | None = None

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        for key in ("along_mm", "across_mm", "height_mm"):
            bounds = getattr(self, key)
            if bounds is not None and bounds[0] > bounds[1]:
                raise ValueError(f"{key} [{bounds[0]:g}, {bounds[1]:g}] descends; it is [lowest, highest]")
        return self


class PlaceSection(Section):
    """Where ``place`` may stand the arm."""

    mounts: tuple[MountName, ...] | None = None
    step_mm: Annotated[Number, Field(ge=20, le=500)] = 150.0
    table: Name = "table"
    rail_gap_mm: Annotated[Number, Field(ge=0, le=1000)] = 110.0
    up: Anatomical | Vector | None = None
    along: Anatomical | Vector | None = None
    floor: MountBounds = MountBounds()
    rail: MountBounds = MountBounds()
    ceiling: MountBounds = MountBounds()
    side: MountBounds = MountBounds()

    @model_validator(mode="after")
    def _mounts_make_sense(self) -> Self:
        if self.mounts is not None and (not self.mounts or len(set(self.mounts)) < len(self.mounts)):
            raise ValueError(f"mounts {list(self.mounts)}: at least one, each once")
        if self.rail.across_mm is not None:
            raise ValueError("rail.across_mm: a rail lies beside the table; rail_gap_mm says how far")
        return self
