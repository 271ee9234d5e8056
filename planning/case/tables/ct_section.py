"""``[ct]``: the CT beside the structures."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from puncture_twin.planning.case.toml_types import Margin, Number, Section

AIR_HU = -900.0
"""Air is -1000; its noise in a mean over 3 mm is some 15, so that 100 is more than six times that. Foam of a mattress
has -970 to -900: what is less dense than this is not told from air."""

DENSE_HU = 250.0
"""Cancellous bone starts at about 200; soft tissue with contrast in the venous phase ends at about 200."""


class CtSection(Section):
    """The CT beside the structures: what it shows that they do not name. Hounsfield units."""

    file: str | None = None
    air_hu: Annotated[Number, Field(ge=-990, le=-300)] = AIR_HU
    dense_hu: Annotated[Number, Field(ge=100, le=3000)] = DENSE_HU
    margin_mm: Margin = 2.0
