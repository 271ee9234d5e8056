"""What the tables of a case file are made of: numbers with bounds, names, and a table that knows its keys."""

from __future__ import annotations

import difflib
import re
import unicodedata
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    ConfigDict,
    Field,
    Strict,
    StringConstraints,
    model_validator,
)

from puncture_twin.planning.base.errors import SchemaError
from puncture_twin.planning.base.text import MAX_NAME
from puncture_twin.planning.formats.points import plainly_radians


def _plain_name(value: str) -> str:
    if not re.fullmatch(r"[^\W_]([\w .\-]*[\w.\-])?", unicodedata.normalize("NFC", value)):
        raise SchemaError("must be letters, digits, spaces and . _ -, a letter or digit first", "bad_name")
    return value


def _degrees(value: tuple[float, ...]) -> tuple[float, ...]:
    if plainly_radians(value):
        raise SchemaError(f"all six are within {max(map(abs, value)):g} of zero: not in degrees?", "wrong_unit")
    return value


Number = Annotated[float, Strict(), AllowInfNan(False)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Coordinate = Annotated[Number, Field(ge=-100_000, le=100_000)]
Length = Annotated[Number, Field(gt=0, le=100_000)]
Margin = Annotated[Number, Field(ge=0, le=1000)]
Weight = Annotated[Number, Field(ge=0, le=1000)]
JointDegrees = Annotated[Number, Field(ge=-360, le=360)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Sextuple = Annotated[
    tuple[JointDegrees, JointDegrees, JointDegrees, JointDegrees, JointDegrees, JointDegrees], AfterValidator(_degrees)
]
Text = Annotated[str, StringConstraints(min_length=1, max_length=MAX_NAME)]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$", max_length=80)]
CaseName = Annotated[str, StringConstraints(max_length=80), AfterValidator(_plain_name)]
"""Of any alphabet: a patient may be called Müller. What must be ASCII (exports to robots) writes it plainly."""
StructureName = Annotated[str, StringConstraints(pattern=r"^\S(.*\S)?$", max_length=MAX_NAME)]
"""As other programs name structures, such as "right lung"; that it is printable is checked for the whole file."""
Degrees360 = Annotated[Number, Field(ge=0, le=360)]
Degrees180 = Annotated[Number, Field(ge=0, le=180)]
Yes = Annotated[bool, Strict()]
Label = Annotated[int, Strict(), Field(ge=1, le=65535)]
Anatomical = Literal["left", "right", "anterior", "posterior", "head", "feet"]


class Section(BaseModel):
    """A table of the file: frozen, and an unknown key is an error that names the nearest valid one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        if isinstance(data, dict):
            known = [field.alias or name for name, field in cls.model_fields.items()]
            for key in data:
                if key not in known:
                    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
                    hint = f"did you mean '{near[0]}'? " if near else ""
                    raise SchemaError(f"unknown key '{key}'; {hint}keys here: {', '.join(known)}", "unknown_key")
        return data
