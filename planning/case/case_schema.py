"""Schema 2 of the case file: it states how many structures it has and which region it shows, so that a cut is seen.

A TOML file that was cut between two tables is whole TOML with fewer organs, and an organ that is not there counts as
free. The number of structures stands once: in the file's last table, ``[end]``, which every cut loses, or at the top,
before the first table, where it tells lost structures but nothing that is lost after them.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator

Region = Literal["abdomen", "chest", "pelvis", "brain", "head", "neck", "spine", "limb", "phantom", "other"]
"""Which part of the body, or of what else, a case shows."""

COUNT_KEY = "structures = N"
"""The name under which the count at the top reaches the model: TOML knows ``structures`` as an array of tables too."""

SCHEMA_ONE_NOTE = (
    "schema = 1 does not show whether the case file is whole: schema = 2 states its structures and its region "
    "(docs/how-to/case-schema-2.md)"
)
TOP_COUNT_NOTE = (
    "structures = N stands at the top of the case, so that a cut after its last structure would not be seen; "
    "state it in [end], the file's last table (docs/how-to/case-schema-2.md)"
)
NOT_LAST_NOTE = "[end] is not the last table of the case: what stands after it could be cut off unseen"

_HEADER = re.compile(r"^[ \t]*\[{1,2}[ \t]*([^\[\]\n]+?)[ \t]*\]{1,2}[ \t]*(?:#.*)?$", re.MULTILINE)
"""The header of a table, on a line of its own."""


def _known(value: object) -> object:
    if isinstance(value, bool) or value not in (1, 2):
        raise ValueError(f"schema {value!r} is not known; this version reads schema = 1 and schema = 2")
    return value


CaseSchema = Annotated[int, BeforeValidator(_known)]
"""The key ``schema``: 1 or 2."""


def with_count(data: Any) -> Any:
    """The file's content with a count at the top under `COUNT_KEY`."""
    if not isinstance(data, dict) or data.get("schema") != 2:
        return data
    count = data.get("structures")
    if isinstance(count, int) and not isinstance(count, bool):
        rest = {key: value for key, value in data.items() if key != "structures"}
        return {**rest, COUNT_KEY: count}
    return data


def ends_with_end(text: str) -> bool:
    """Whether the last table of a file is ``[end]``."""
    headers = _HEADER.findall(text)
    return bool(headers) and headers[-1] == "end"


def check_statement(schema: int, region: str | None, at_top: int | None, at_end: int | None) -> None:
    """Whether what schema 2 demands is there, once; and none of it in schema 1.

    Raises:
        ValueError: It is missing, or stated twice with two numbers.
    """
    if schema == 1:
        if region is not None or at_end is not None:
            raise ValueError("region and [end] belong to schema = 2")
        return
    if at_top is None and at_end is None:
        raise ValueError("schema = 2 needs its last table, [end] with structures = N; was the file cut?")
    if at_top is not None and at_end is not None and at_top != at_end:
        raise ValueError(f"structures = {at_top} at the top and {at_end} in [end]; keep one")
    if region is None:
        raise ValueError(f"schema = 2 needs region, one of {', '.join(get_args(Region))}")


def count_difference(stated: int, found: int) -> str:
    """What to say of a case that has another number of structures than it states; the empty string if it has not."""
    if stated == found:
        return ""
    return f"structures = {stated} is stated, and the case has {found}, the skin among them; was the file cut?"
