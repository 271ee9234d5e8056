"""The whole case file: its tables, and what no single table can tell. See docs/reference/case.md for the keys.

A TOML file that was cut between two tables is whole TOML with fewer organs, and an organ that is not there counts as
free. So a case states the number of its structures once: in the file's last table, ``[end]``, which every cut loses, or
at the top, before the first table, where it tells lost structures but nothing that is lost after them.

Options stand in place of what a file states: another target, margins, mount, needle, arm or errors. The file is not
changed: its tables are, before they are validated, so that an option is held to the same rules as a line of the file.
Options are an input of their own: no result of a case with options passes for one without.
"""

from __future__ import annotations

import copy
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BeforeValidator, Field, Strict, model_validator

from puncture_twin.planning.base.errors import SchemaError, refuse, refusing
from puncture_twin.planning.base.text import unprintable_texts
from puncture_twin.planning.case import tables
from puncture_twin.planning.case.tables import CaseName, Section, Text

COUNT_KEY = "structures = N"
"""The name under which the count at the top reaches the model: TOML knows ``structures`` as an array of tables too."""
Region = Literal["abdomen", "chest", "pelvis", "brain", "head", "neck", "spine", "limb", "phantom", "other"]
"""Which part of the body, or of what else, a case shows."""


def _known_schema(value: object) -> object:
    if isinstance(value, bool) or value != 2:
        said = "not stated" if value is None else f"schema {value!r} is not known"
        what = f'{said}; write schema = 2, region = "...", and last [end] with structures = N'
        raise SchemaError(what, "unknown_version")
    return value


def _stated_region(value: object) -> object:
    if value is None:
        raise SchemaError(f"schema = 2 needs region, one of {', '.join(get_args(Region))}", "missing_key")
    return value


def count_difference(stated: int, actual: int) -> str:
    """Sentence on a case with another number of structures than it states; empty where they agree."""
    if stated == actual:
        return ""
    return f"structures = {stated} is stated, but the case has {actual}, the skin included; was the file cut?"


class EndSection(Section):
    """The last table of the file, which every cut loses."""

    structures: Annotated[int, Strict(), Field(ge=1)]


class CaseFile(Section):
    """The whole file."""

    schema_: Annotated[Literal[2], BeforeValidator(_known_schema)] = Field(alias="schema")
    structure_count: Annotated[int, Strict(), Field(ge=1)] | None = Field(None, alias="structures = N")
    region: Annotated[Region, BeforeValidator(_stated_region)]
    name: CaseName
    space: Literal["LPS", "RAS", "local"]
    target: tables.TargetSection
    needle: tables.NeedleSection
    search: tables.SearchSection = tables.SearchSection()
    ranking: tables.RankingSection = tables.RankingSection()
    structure: Annotated[tuple[tables.StructureSection, ...], Field(max_length=tables.MAX_STRUCTURES)] = ()
    structures: Annotated[tuple[tables.StructuresSection, ...], Field(max_length=tables.MAX_LABEL_MAPS)] = ()
    ct: tables.CtSection = tables.CtSection()
    registration: tables.RegistrationSection | None = None
    robot: tables.RobotSection = tables.RobotSection()
    tool: tables.ToolSection | None = None
    obstacle: Annotated[tuple[tables.ObstacleSection, ...], Field(max_length=tables.MAX_STRUCTURES)] = ()
    gantry: tables.GantrySection | None = None
    place: tables.PlaceSection = tables.PlaceSection()
    errors: tables.ErrorsSection | None = None
    breathing: tables.BreathingSection | None = None
    motion: tables.MotionSection | None = None
    stereo: tables.StereoSection | None = None
    ultrasound: tables.UltrasoundSection | None = None
    control_scan: tables.ControlScanSection | None = None
    tissue: Annotated[dict[Text, tables.TissueSection], Field(max_length=tables.MAX_STRUCTURES)] = Field(
        default_factory=dict
    )
    rehearsal: tables.RehearsalSection = tables.RehearsalSection()
    end: EndSection | None = None

    @property
    def stated_structures(self) -> int:
        """How many structures the file says that it has, with the skin. Raises SchemaError: none, or two."""
        at_top, at_end = self.structure_count, None if self.end is None else self.end.structures
        stated = at_top if at_end is None else at_end
        if stated is None:
            what = "schema = 2 needs its last table, [end] with structures = N; was the file cut?"
            raise SchemaError(what, "file_cut")
        if at_top not in {None, stated}:
            raise SchemaError(f"structures = {at_top} at the top but {at_end} in [end]; keep one", "stated_twice")
        return stated

    @property
    def ct_name(self) -> str | None:
        """The CT that the skin comes from, or the one that stands beside it."""
        return next((one.ct for one in self.structure if one.ct is not None), self.ct.file)

    @model_validator(mode="before")
    @classmethod
    def _as_stated(cls, data: Any) -> Any:
        """A count at the top comes under `COUNT_KEY`, and None for what is not stated and must be."""
        for text in unprintable_texts(data):
            what = f"{text[:60]!a} has a control or format character; names and paths are plain text"
            raise SchemaError(what, "bad_name")
        if not isinstance(data, dict):
            return data
        count = data.get("structures")
        if isinstance(count, int) and not isinstance(count, bool):
            data = {**{key: value for key, value in data.items() if key != "structures"}, COUNT_KEY: count}
        return {"schema": None, "region": None, **data}

    def _problems(self) -> Iterator[SchemaError]:
        stated = self.stated_structures
        if wrong := "" if self.structures else count_difference(stated, len(self.structure)):
            yield SchemaError(wrong, "structures_miscounted")
        if self.registration is not None and self.robot.mount is not None:
            yield SchemaError("[registration] and [robot.mount] both place the base; keep one", "stated_twice")
        if self.errors is None and self.rehearsal.errors is not None:
            yield SchemaError("[rehearsal.errors] differs from [errors], and [errors] is missing", "missing_errors")
        if self.errors is None and self.registration is not None and self.registration.correct:
            what = "registration.correct needs [errors]: it estimates the arm's errors from the declared ones"
            yield SchemaError(what, "missing_errors")
        chances = (self.search.min_hit, self.search.max_touch, self.search.max_touch_of or None)
        if self.errors is None and any(chance is not None for chance in chances):
            what = "search.min_hit and max_touch need [errors]: without declared errors there are no chances"
            yield SchemaError(what, "missing_errors")
        if self.stereo is not None and self.stereo.balls_mm[-1] >= self.needle.length_mm:
            far, length = self.stereo.balls_mm[-1], self.needle.length_mm
            what = f"stereo.balls_mm: {far:g} is not on the needle, whose length_mm is {length:g}"
            yield SchemaError(what, "out_of_range")
        if self.space == "local" and self.registration is not None and self.registration.transform is not None:
            what = 'registration.transform: a transform file is in patient space; space "local" has none'
            yield SchemaError(what, "local_space")
        if self.space == "local" and self.ct.file is not None:
            yield SchemaError('ct.file: a CT is in patient space; space "local" has none', "local_space")
        if self.space == "local" and any(s.cut for s in self.structure):
            yield SchemaError('cut names sides of a patient; space "local" has none', "local_space")
        if self.space == "local" and self.search.frame not in {None, "ct"}:
            yield SchemaError('search.frame must be "ct" for space "local": it has no head and no front', "local_space")
        for name, count in Counter(s.name for s in self.structure).items():
            if count > 1:
                yield SchemaError(f"structure '{name}' appears twice; names are unique", "duplicate_name")
        skins = [s.name for s in self.structure if s.role == "skin"]
        if len(skins) != 1:
            yield SchemaError(f'exactly one structure must have role "skin"; here {skins or "none"}', "not_one_skin")
        if self.space != "local":
            return
        gantry = self.gantry
        if gantry is not None and not (isinstance(gantry.axis, tuple) and isinstance(gantry.up, tuple)):
            what = 'gantry: space "local" has no head and no front; give axis and up as vectors'
            yield SchemaError(what, "local_space")
        if isinstance(self.place.up, str) or isinstance(self.place.along, str):
            what = 'place: space "local" has no head and no front; give up and along as vectors'
            yield SchemaError(what, "local_space")


def case_schema() -> dict[str, Any]:
    """The JSON Schema of a case file, by which an editor completes keys and marks wrong ones."""
    schema = CaseFile.model_json_schema()
    keys = schema["properties"]
    keys["structures"] = {"anyOf": [keys["structures"], keys.pop(COUNT_KEY)]}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


OPTIONS_ROLE = "options"
"""Role of the options among the inputs of a case."""
TABLES = {"target": "target", "needle": "needle", "arm": "robot", "errors": "errors", "search": "search"}
"""Options that are laid over a table of the case, key by key, and that table."""
MOUNT, MARGINS, ADDED = "mount", "margins", "add_mm"
"""Options that are more than an overlay of a table, and the key of `margins` that adds to all margins."""
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
    """An array of NumPy as lists. Raises TypeError: anything else that JSON does not know."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else json.JSONEncoder().default(value)


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


def _tables(value: Any) -> list[dict[str, Any]]:
    return [one for one in value if isinstance(one, dict)] if isinstance(value, list) else []
