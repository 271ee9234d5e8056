"""A cohort as ``cohort.toml``: patterns of cases, and a grid of options that each of them is run with."""

from __future__ import annotations

import glob
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.toml_file import SchemaOne, parse_toml
from puncture_twin.planning.batch.cohort.cohort_case import MOST_CASES, CohortCase
from puncture_twin.planning.case.options import CaseOptions, case_options
from puncture_twin.planning.case.toml_types import Section, Text

ALLOWED = "a cohort.toml with cases = [patterns] and, if wanted, tables of options"
KEYS = "docs/how-to/cohorts.md"

Choices = dict[Text, dict[str, Any]] | tuple[Any, ...]
"""Options of one kind: by name, or as a list: texts are their own names, the rest is counted from 1."""

AXES = {
    "targets": "target",
    "margins": "margins",
    "mounts": "mount",
    "needles": "needle",
    "arms": "arm",
    "errors": "errors",
}
"""Table of the cohort to the kind of its options."""


class CohortFile(Section):
    """The whole file."""

    schema_: SchemaOne = Field(1, alias="schema")
    cases: Annotated[tuple[Text, ...], Field(min_length=1)]
    targets: Choices = ()
    margins: Choices = ()
    mounts: Choices = ()
    needles: Choices = ()
    arms: Choices = ()
    errors: Choices = ()


class _Choice(NamedTuple):
    """One option of an axis of the grid."""

    name: str
    kind: str
    values: Mapping[str, Any]


def toml_cases(content: bytes, path: Path) -> list[CohortCase]:
    """The cases that a cohort file describes: every match of its patterns with every combination of its options.

    Args:
        content: The whole file.
        path: Its name; patterns are relative to its folder.

    Raises:
        InputError: Not of this schema, a pattern that matches nothing, or too many combinations.
    """
    stated = parse_toml(content, path, CohortFile, allowed=ALLOWED, keys=KEYS)
    found = _matches(stated.cases, path)
    axes = [axis for name, kind in AXES.items() if (axis := _axis(getattr(stated, name), name, kind, path))]
    count = len(found) * math.prod(len(axis) for axis in axes)
    if count > MOST_CASES:
        raise InputError(f"makes {count} cases", where=path, allowed=f"at most {MOST_CASES}")
    combinations = [_combined(choices, path) for choices in product(*axes)]
    return [CohortCase(one, path.parent / one, name, options) for one in found for name, options in combinations]


def _matches(patterns: Sequence[str], path: Path) -> list[str]:
    """What the patterns match, each once, in the order of the patterns."""
    found: dict[str, None] = {}
    for pattern in patterns:
        matches = sorted(glob.glob(pattern, root_dir=path.parent, recursive=True))  # noqa: PTH207  # absolute ones too
        if not matches:
            raise InputError(f"cases '{pattern}' matches nothing", where=path, allowed="patterns of existing cases")
        found |= dict.fromkeys(matches)
    return list(found)


def _axis(stated: Any, axis: str, kind: str, path: Path) -> list[_Choice]:
    if isinstance(stated, Mapping):
        named = list(stated.items())
    else:
        named = [(one if isinstance(one, str) else str(number), one) for number, one in enumerate(stated, start=1)]
    return [_Choice(name, kind, _table(values, kind, f"{path}: {axis}.{name}")) for name, values in named]


def _table(values: Any, kind: str, where: str) -> Mapping[str, Any]:
    """A table as it stands; of a target a point, of an arm its model, without the key."""
    if isinstance(values, Mapping):
        return values
    if kind == "target" and isinstance(values, list | tuple):
        return {"position_mm": list(values)}
    if kind == "arm" and isinstance(values, str):
        return {"model": values}
    raise InputError(f"option '{kind}' is no table", where=where, allowed="keys and values, as in the case")


def _combined(choices: Sequence[_Choice], path: Path) -> tuple[str, CaseOptions]:
    name = ", ".join(_labels(choices))
    return name, case_options({one.kind: dict(one.values) for one in choices}, where=str(path))


def _labels(choices: Sequence[_Choice]) -> Iterator[str]:
    for one in choices:
        yield f"{one.kind} {one.name}"
