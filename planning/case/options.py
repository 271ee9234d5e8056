"""Options in place of what a case file states: another target, margins, mount, needle, arm or errors.

The case file is not changed: its tables are, before they are validated, so that an option is held to the same rules as
a line of the file. Options are an input of their own: no result of a case with options passes for one without.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from puncture_twin.planning.base.errors import refuse, refusing

OPTIONS_ROLE = "options"
"""Of the input that options are."""
TABLES = {"target": "target", "needle": "needle", "arm": "robot", "errors": "errors", "search": "search"}
"""Options that are laid over a table of the case, key by key, and that table."""
MOUNT, MARGINS, ADDED = "mount", "margins", "add_mm"
"""Options that are more than that, and the key of `margins` that adds to all."""
SECTIONS = (*TABLES, MARGINS, MOUNT)
"""Every kind of option."""
ALTERNATIVES = (
    *(("position_mm", "points"), ("points", "position_mm")),
    *(("model", "urdf"), ("model", "flange"), ("model", "limits"), ("urdf", "model"), ("urdf", "limits")),
)
"""Keys of a table of which the first takes the place of the second: a target's, and an arm's."""


@dataclass(frozen=True)
class CaseOptions:
    """Options of one case: kind (`SECTIONS`) to its keys and values, as TOML gives them; mm and degrees."""

    sections: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def text(self) -> str:
        """The options as JSON: the same options give the same text; of margins the order counts, so it is kept."""
        tables = []
        for kind, values in sorted(self.sections.items()):
            text = json.dumps(dict(values), sort_keys=kind != MARGINS, allow_nan=False, default=_plain)
            tables.append(f"{json.dumps(kind)}: {text}")
        return f"{{{', '.join(tables)}}}"

    def applied(self, data: dict[str, Any], *, where: Path | str) -> dict[str, Any]:
        """A case file's tables with the options in place, unvalidated. Raises InputError: a margin of what has none."""
        changed = copy.deepcopy(data)
        for kind, values in self.sections.items():
            if kind == MOUNT:
                changed.pop("registration", None)
                _table(changed, "robot")["mount"] = dict(values)
            elif kind == MARGINS:
                _set_margins(changed, values, where)
            else:
                _overlay(_table(changed, TABLES[kind]), values)
        return changed

    def with_(self, other: CaseOptions) -> CaseOptions:
        """These options with others over them: a mount takes the place of a mount, in all else a key that of a key.

        A margin that is stated again comes last again, so that no earlier pattern is laid over it.
        """
        sections = {kind: dict(values) for kind, values in self.sections.items()}
        for kind, values in other.sections.items():
            before = {} if kind == MOUNT else sections.get(kind, {})
            sections[kind] = {key: value for key, value in before.items() if key not in values}
            _overlay(sections[kind], values)
        return CaseOptions(sections)


def _plain(value: object) -> Any:
    """An array of NumPy as lists."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no value of a case file")


NO_OPTIONS = CaseOptions()
"""Everything as the case file states it."""


def case_options(sections: Mapping[str, Any], *, where: str) -> CaseOptions:
    """Options from plain values: kind of option to a table of keys and values.

    Raises InputError: an unknown kind, something that is no table, or a value that is no number, text or list of them.
    """
    for kind, values in sections.items():
        if kind not in SECTIONS:
            refuse(f"'{kind}' is not a kind of option", where, ", ".join(SECTIONS), "unknown_key")
        if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
            refuse(f"option '{kind}' is not a table", where, "keys and values, as in the case", "not_a_table")
    allowed = "finite numbers, texts, lists, tables"
    with refusing((TypeError, ValueError), "an option cannot be used", where, allowed, "bad_value"):
        plain = json.loads(CaseOptions({kind: values for kind, values in sections.items() if values}).text)
    if MARGINS in plain:  # of one statement: a pattern before the names that it fits
        plain[MARGINS] = dict(sorted(plain[MARGINS].items()))
    return CaseOptions(plain)


def _table(data: dict[str, Any], name: str) -> dict[str, Any]:
    """A table of the case, made where it is missing; what is no table is left to the schema's refusal."""
    table = data.setdefault(name, {})
    return table if isinstance(table, dict) else {}


def _overlay(table: dict[str, Any], values: Mapping[str, Any]) -> None:
    for one, other in ALTERNATIVES:
        if one in values:
            table.pop(other, None)
    table.update(values)


def _set_margins(data: dict[str, Any], values: Mapping[str, Any], where: Path | str) -> None:
    """Set the margins of structures by name or pattern, then add to all."""
    stated = list(_margins(data))
    for pattern, margin in values.items():
        if not isinstance(margin, int | float) or isinstance(margin, bool):
            refuse(f"margins '{pattern}' is not a number", where, "mm", "not_a_number")
        if pattern == ADDED:
            continue
        fitting = [one for one in stated if fnmatchcase(one[0], pattern)]
        if not fitting:
            known = ", ".join(name for name, _, _ in stated) or "none"
            refuse(f"margins '{pattern}' matches no structure with a margin", where, known, "no_match")
        for _, table, key in fitting:
            table[key] = margin
    for _, table, key in stated if ADDED in values else ():
        before = table.get(key, 0.0)
        table[key] = before + values[ADDED] if isinstance(before, int | float) else before


def _margins(data: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Every margin of a case: the name or pattern that it is stated for, its table and its key there."""
    for one in _tables(data.get("structure")):
        if one.get("role") in ("avoid", "unknown"):
            yield str(one.get("name")), one, "margin_mm"
    for many in _tables(data.get("structures")):
        avoid = many.get("avoid")
        if isinstance(avoid, dict):
            yield from ((pattern, avoid, pattern) for pattern in list(avoid))


def _tables(found: Any) -> list[dict[str, Any]]:
    return [one for one in found if isinstance(one, dict)] if isinstance(found, list) else []
