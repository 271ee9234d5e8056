"""The number of structures that a case of schema 2 states, so that a cut is seen.

A TOML file that was cut between two tables is whole TOML with fewer organs, and an organ that is not there counts as
free. The number of structures stands once: in the file's last table, ``[end]``, which every cut loses, or at the top,
before the first table, where it tells lost structures but nothing that is lost after them.
"""

from __future__ import annotations

from typing import Any, get_args

from puncture_twin.planning.case.case_schema import Region

COUNT_KEY = "structures = N"
"""The name under which the count at the top reaches the model: TOML knows ``structures`` as an array of tables too."""


def with_count(data: Any) -> Any:
    """The file's content with a count at the top under `COUNT_KEY`."""
    if not isinstance(data, dict) or data.get("schema") != 2:
        return data
    count = data.get("structures")
    if isinstance(count, int) and not isinstance(count, bool):
        rest = {key: value for key, value in data.items() if key != "structures"}
        return {**rest, COUNT_KEY: count}
    return data


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
