"""The whole case file: its tables, and what no single table can tell. See docs/reference/case.md for the keys."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any, Literal, Self

from pydantic import Field, Strict, model_validator

from puncture_twin.planning.base.text_names import unprintable_texts
from puncture_twin.planning.case.case_schema import CaseSchema, Region
from puncture_twin.planning.case.sections.tool_section import ToolSection
from puncture_twin.planning.case.stated_count import check_statement, count_difference, with_count
from puncture_twin.planning.case.tables.breathing_section import BreathingSection
from puncture_twin.planning.case.tables.ct_section import CtSection
from puncture_twin.planning.case.tables.errors_section import ErrorsSection
from puncture_twin.planning.case.tables.needle_section import NeedleSection
from puncture_twin.planning.case.tables.place_section import PlaceSection
from puncture_twin.planning.case.tables.ranking_section import RankingSection
from puncture_twin.planning.case.tables.registration_section import RegistrationSection
from puncture_twin.planning.case.tables.rehearsal_section import RehearsalSection
from puncture_twin.planning.case.tables.robot_section import RobotSection
from puncture_twin.planning.case.tables.search_section import SearchSection
from puncture_twin.planning.case.tables.structure_section import MAX_STRUCTURES, StructureSection
from puncture_twin.planning.case.tables.structures_section import MAX_LABEL_MAPS, StructuresSection
from puncture_twin.planning.case.tables.surroundings_section import GantrySection, ObstacleSection
from puncture_twin.planning.case.tables.target_section import TargetSection
from puncture_twin.planning.case.tables.tissue_section import TissueSection
from puncture_twin.planning.case.toml_types import Name, Section, Text


class EndSection(Section):
    """The last table of the file, which every cut loses."""

    structures: Annotated[int, Strict(), Field(ge=1)]


class CaseFile(Section):
    """The whole file."""

    schema_: CaseSchema = Field(alias="schema")
    structure_count: Annotated[int, Strict(), Field(ge=1)] | None = Field(None, alias="structures = N")
    region: Region | None = None
    name: Name
    space: Literal["LPS", "RAS", "local"]
    target: TargetSection
    needle: NeedleSection
    search: SearchSection = SearchSection()
    ranking: RankingSection = RankingSection()
    structure: Annotated[tuple[StructureSection, ...], Field(max_length=MAX_STRUCTURES)] = ()
    structures: Annotated[tuple[StructuresSection, ...], Field(max_length=MAX_LABEL_MAPS)] = ()
    ct: CtSection = CtSection()
    registration: RegistrationSection | None = None
    robot: RobotSection = RobotSection()
    tool: ToolSection | None = None
    obstacle: Annotated[tuple[ObstacleSection, ...], Field(max_length=MAX_STRUCTURES)] = ()
    gantry: GantrySection | None = None
    place: PlaceSection = PlaceSection()
    errors: ErrorsSection | None = None
    breathing: BreathingSection | None = None
    tissue: Annotated[dict[Text, TissueSection], Field(max_length=MAX_STRUCTURES)] = Field(default_factory=dict)
    rehearsal: RehearsalSection = RehearsalSection()
    end: EndSection | None = None

    @property
    def stated_structures(self) -> int | None:
        """How many structures the file says that it has, the skin among them; None in schema 1."""
        return self.structure_count if self.end is None else self.end.structures

    @property
    def ct_name(self) -> str | None:
        """The CT that the skin comes from, or the one that stands beside it."""
        return next((one.ct for one in self.structure if one.ct is not None), self.ct.file)

    @model_validator(mode="before")
    @classmethod
    def _with_count(cls, data: Any) -> Any:
        return with_count(data)

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        at_end = None if self.end is None else self.end.structures
        check_statement(self.schema_, self.region, self.structure_count, at_end)
        stated = self.stated_structures
        wrong = "" if stated is None or self.structures else count_difference(stated, len(self.structure))
        if wrong:
            raise ValueError(wrong)
        return self

    @model_validator(mode="before")
    @classmethod
    def _refuse_unprintable(cls, data: Any) -> Any:
        for text in unprintable_texts(data):
            raise ValueError(f"{text[:60]!a} holds a control or format character; names and paths are plain text")
        return data

    @model_validator(mode="after")
    def _no_contradiction(self) -> Self:
        if self.registration is not None and self.robot.mount is not None:
            raise ValueError("[registration] and [robot.mount] both say where the base is; keep one")
        if self.errors is None and self.rehearsal.errors is not None:
            raise ValueError("[rehearsal.errors] is a truth that differs from [errors], which is not there")
        if self.errors is None and self.registration is not None and self.registration.correct:
            raise ValueError(
                "registration.correct needs [errors]: it tells the arm's errors by what is declared of them"
            )
        chances = (self.search.min_hit, self.search.max_touch, self.search.max_touch_of or None)
        if self.errors is None and any(chance is not None for chance in chances):
            raise ValueError("search.min_hit and max_touch need [errors]: without declared errors there is no chance")
        if self.space == "local" and self.registration is not None and self.registration.transform is not None:
            raise ValueError('registration.transform: a transform file speaks of patient space; space "local" has none')
        if self.space == "local" and self.ct.file is not None:
            raise ValueError('ct.file: a CT says its own patient space; space "local" has none')
        if self.space == "local" and any(s.cut for s in self.structure):
            raise ValueError('cut names sides of a patient; space "local" has none')
        if self.space == "local" and self.search.frame not in {None, "ct"}:
            raise ValueError('search.frame must be "ct" for space "local": it has no head and no front')
        for name, count in Counter(s.name for s in self.structure).items():
            if count > 1:
                raise ValueError(f"structure '{name}' stands twice; names are unique")
        skins = [s.name for s in self.structure if s.role == "skin"]
        if len(skins) != 1:
            raise ValueError(f'one structure has role "skin"; here {skins or "none"}')
        return self

    @model_validator(mode="after")
    def _local_has_no_head(self) -> Self:
        if self.space != "local":
            return self
        gantry = self.gantry
        if gantry is not None and not (isinstance(gantry.axis, tuple) and isinstance(gantry.up, tuple)):
            raise ValueError('gantry: space "local" has no head and no front; give axis and up as vectors')
        if isinstance(self.place.up, str) or isinstance(self.place.along, str):
            raise ValueError('place: space "local" has no head and no front; give up and along as vectors')
        return self
