"""``[[structure]]``: one structure from one source."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from puncture_twin.planning.case.toml_types import Label, Margin, Number, Section, StructureName

MAX_STRUCTURES = 1000
"""Structures, or obstacles, of a case: TotalSegmentator knows 117 classes, and each structure costs a tree."""

Role = Literal["avoid", "traverse", "target", "skin", "unknown"]


class StructureSection(Section):
    """One structure from one source."""

    name: StructureName
    role: Role
    margin_mm: Margin | None = None
    mesh: str | None = None
    unit: str | None = None
    space: str | None = None
    labelmap: str | None = None
    label: Label | None = None
    ct: str | None = None
    cut: tuple[Literal["right", "left", "front", "back", "feet", "head"], ...] | None = None
    hu: Annotated[Number, Field(ge=-1024, le=30_000)] | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = [key for key in ("mesh", "labelmap", "ct") if getattr(self, key) is not None]
        if len(sources) != 1:
            raise ValueError(f"'{self.name}' needs exactly one of mesh, labelmap, ct; it has {sources or 'none'}")
        if (self.labelmap is None) != (self.label is None):
            raise ValueError(f"'{self.name}': labelmap and label go together")
        if self.mesh is not None and self.unit is None:
            raise ValueError(f'\'{self.name}\': a mesh needs unit = "mm", "cm" or "m"; no mesh file says it')
        if self.mesh is None and (self.unit or self.space):
            raise ValueError(f"'{self.name}': unit and space belong to a mesh; a volume says its own")
        if self.ct is not None and self.role != "skin":
            raise ValueError(f"'{self.name}': ct finds the body's skin only; role must be \"skin\"")
        if self.cut is not None and (self.role != "skin" or self.mesh is None):
            raise ValueError(f"'{self.name}': cut belongs to a skin mesh; a volume shows where it cuts the body")
        if self.margin_mm is not None and self.role not in {"avoid", "unknown"}:
            raise ValueError(f'\'{self.name}\': margin_mm belongs to role "avoid", not "{self.role}"')
        return self
