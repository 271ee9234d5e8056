"""``[[structures]]``: many structures of one source, by name patterns."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from puncture_twin.planning.case.tables.structure_section import MAX_STRUCTURES
from puncture_twin.planning.case.toml_types import Margin, Section, Text

MAX_LABEL_MAPS = 100
"""Tables ``[[structures]]``, each with a label map of its own."""

Patterns = Annotated[tuple[Text, ...], Field(max_length=MAX_STRUCTURES)]


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
