"""The whole case file: its tables, and what no single table can tell. See docs/reference/case.md for the keys.

A TOML file that was cut between two tables is whole TOML with fewer organs, and an organ that is not there counts as
free. So a case states the number of its structures once: in the file's last table, ``[end]``, which every cut loses, or
at the top, before the first table, where it tells lost structures but nothing that is lost after them.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Field, Strict, model_validator

from puncture_twin.planning.base.errors import SchemaError
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


def count_difference(stated: int, found: int) -> str:
    """Sentence on a case with another number of structures than it states; empty where they agree."""
    if stated == found:
        return ""
    return f"structures = {stated} is stated, but the case has {found}, the skin included; was the file cut?"


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
