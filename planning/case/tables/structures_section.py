"""``[[structure]]``, ``[[structures]]``, ``[ct]``: one structure, many by name patterns, and the CT beside them."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from puncture_twin.planning.case.toml_types import Label, Margin, Number, Section, StructureName, Text
from puncture_twin.planning.geometry.spaces import Up

MAX_STRUCTURES = 1000
"""Structures, or obstacles, of a case: TotalSegmentator knows 117 classes, and each structure costs a tree."""

Stated = Literal["none", "present"]
"""What a person says of arms, or of a table, in an image."""

Role = Literal["avoid", "traverse", "target", "skin", "unknown"]

MAX_LABEL_MAPS = 100
"""Tables ``[[structures]]``, each with a label map of its own."""

Patterns = Annotated[tuple[Text, ...], Field(max_length=MAX_STRUCTURES)]

AIR_HU = -900.0
"""Air is -1000; its noise in a mean over 3 mm is some 15, so that 100 is more than six times that. Foam of a mattress
has -970 to -900: what is less dense than this is not told from air."""

DENSE_HU = 250.0
"""Cancellous bone starts at about 200; soft tissue with contrast in the venous phase ends at about 200."""


class StructureSection(Section):
    """One structure from one source."""

    name: StructureName
    role: Role
    margin_mm: Margin | None = None
    mesh: str | None = None
    unit: str | None = None
    space: str | None = None
    up: Up | None = None
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
        if self.mesh is None and (self.unit or self.space or self.up):
            raise ValueError(f"'{self.name}': unit, space and up belong to a mesh; a volume says its own")
        if self.ct is not None and self.role != "skin":
            raise ValueError(f"'{self.name}': ct finds the body's skin only; role must be \"skin\"")
        if self.cut is not None and self.role != "skin":
            raise ValueError(f"'{self.name}': cut belongs to the skin: it says where the body was cut")
        if self.margin_mm is not None and self.role not in {"avoid", "unknown"}:
            raise ValueError(f'\'{self.name}\': margin_mm belongs to role "avoid", not "{self.role}"')
        return self


class StructuresSection(Section):
    """Many structures of one label map, a folder of masks, a SEG (DICOM or Slicer) or RTSTRUCT, by name pattern."""

    labelmap: str | None = None
    masks: str | None = None
    seg: str | None = None
    rtstruct: str | None = None
    ct: str | None = None
    naming: str | None = None
    target: Patterns = ()
    avoid: Annotated[dict[Text, Margin], Field(max_length=MAX_STRUCTURES)] = Field(default_factory=dict)
    unknown: Annotated[dict[Text, Margin], Field(max_length=MAX_STRUCTURES)] = Field(default_factory=dict)
    traverse: Patterns = ()
    ignore: Patterns = ()

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = [key for key in ("labelmap", "masks", "seg", "rtstruct") if getattr(self, key) is not None]
        if len(sources) != 1:
            raise ValueError(
                "needs either labelmap (a file) or masks (a folder with one file a structure), not both; "
                f"or seg (DICOM, or Slicer's .seg.nrrd), or rtstruct; it has {' and '.join(sources) or 'none'}"
            )
        if self.labelmap is None and self.naming is not None:
            raise ValueError(
                "naming belongs to labelmap; masks are named after their files, SEG and RTSTRUCT state their names"
            )
        if self.ct is not None and self.seg is None and self.rtstruct is None:
            raise ValueError("ct belongs to seg and rtstruct: the DICOM series on which they were drawn")
        return self

    @property
    def source(self) -> str:
        """The file or the folder, as the case writes it."""
        return self.labelmap or self.mask_set or ""

    @property
    def mask_set(self) -> str | None:
        """The folder of masks, or the DICOM file that holds them; None for a label map."""
        return self.masks or self.seg or self.rtstruct


class CtSection(Section):
    """The CT beside the structures: what it shows that they do not name. Hounsfield units."""

    file: str | None = None
    air_hu: Annotated[Number, Field(ge=-990, le=-300)] = AIR_HU
    dense_hu: Annotated[Number, Field(ge=100, le=3000)] = DENSE_HU
    margin_mm: Margin = 2.0
    unnamed: Literal["unknown", "free"] = "unknown"
    arms: Stated | None = None
    table: Stated | None = None
    beyond_mm: Annotated[Number, Field(ge=0, le=1000)] | Literal["all"] | None = None
