"""A case: a validated case file, in LPS (or local) mm and radians, with the hash of every input."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.brief import brief
from puncture_twin.planning.base.provenance import Input, InputFiles
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case_volumes import CaseVolumes
from puncture_twin.planning.case.entry import Directions, direction, grid
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.case.html import case_html
from puncture_twin.planning.case.named_files import MASK_ROLE
from puncture_twin.planning.case.settings import (
    CtSettings,
    Gantry,
    Needle,
    Obstacle,
    RobotSettings,
    SearchSettings,
)
from puncture_twin.planning.case.tables.errors_section import RehearsalSection
from puncture_twin.planning.case.tables.place_section import PlaceSection
from puncture_twin.planning.case.tables.registration_section import MarkerSection
from puncture_twin.planning.case.tables.search_section import RankingSection
from puncture_twin.planning.case.tables.structures_section import StructureSection, StructuresSection
from puncture_twin.planning.formats.labels.mask_folder import structure_name
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.needle.deflection import Bending


@dataclass(frozen=True, eq=False)
class Case:
    """What a search, a plan and a rehearsal start from. A `Case` has been validated.

    Attributes:
        target_ct: Shape (3,), the point to reach.
        T_ct_entry: Shape (4, 4), the entry frame, its origin on the target.
        files: The case file and all that it names, read once.
        volumes: Those of them that are volumes: the CT and the label maps.
        stated_structures: How many structures the case says that it has, the skin among them; None in schema 1.
        region: Which part of the body it shows; None in schema 1.
        warnings: What the case file itself leaves open, one sentence each.
        hit_radius_mm: Within which of the target the tip hits; None counts the target's own mesh.
        errors: What is declared to err, or None.
        truth_errors: From what a rehearsal's truth is drawn instead, to test a wrong belief; None draws from `errors`.
        breathing: How the body moves with the breath, or None where the case does not say.
        bending: How the needle bends, and in what, or None where the case does not say.
        own_target: Whether the target lies in no structure: its own is then the ball of the hit radius about it, which
            has its name.
        tool: What the flange carries beside needle and holder, or None.
    """

    path: Path
    name: str
    space: Space
    target_ct: Floats
    target_name: str
    target_structure: str
    needle: Needle
    search: SearchSettings
    ranking: RankingSection
    T_ct_entry: Floats
    structure: tuple[StructureSection, ...]
    structures: tuple[StructuresSection, ...]
    registration: MarkerSection | None
    robot: RobotSettings
    obstacles: tuple[Obstacle, ...]
    rehearsal: RehearsalSection
    files: InputFiles
    volumes: CaseVolumes
    ct: CtSettings = field(default_factory=CtSettings)
    gantry: Gantry | None = None
    place: PlaceSection = field(default_factory=PlaceSection)
    stated_structures: int | None = None
    region: str | None = None
    warnings: tuple[str, ...] = ()
    hit_radius_mm: float | None = None
    errors: ErrorModel | None = None
    truth_errors: ErrorModel | None = None
    breathing: Breathing | None = None
    bending: Bending | None = None
    own_target: bool = False
    tool: ToolBody | None = None

    @brief
    def __repr__(self) -> str:
        return f"{self.name}, {self.path}: target {self.target_name} in {self.target_structure}"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return case_html(self)

    def aimed_at(self, target_ct: Floats) -> Case:
        """This case with another target, shape (3,), mm: in the same structure, with the entry frame about it."""
        target = read_only(target_ct)
        return replace(self, target_ct=target, T_ct_entry=view_frame(self.T_ct_entry[:3, :3], target))

    def directions(self) -> Directions:
        """The grid of the case."""
        return grid(self.search.theta, self.search.beta, self.search.step, self.T_ct_entry[:3, :3])

    def direction(self, theta: float, beta: float) -> Directions:
        """A single direction (rad) of the case's entry frame."""
        return direction(theta, beta, self.T_ct_entry[:3, :3])

    @property
    def folder(self) -> Path:
        """The folder to which every path of the case is relative."""
        return self.path.parent

    @property
    def skin_section(self) -> StructureSection:
        """The one structure that is the skin."""
        return next(section for section in self.structure if section.role == "skin")

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The case file and all that it names, each with its role and hash."""
        return self.files.inputs

    def masks(self, folder: str) -> dict[str, str]:
        """The masks of a folder or a DICOM file that the case names: structure to the name of its volume."""
        if parts := self.volumes.masks(folder):
            return parts
        inside = PurePosixPath(folder)
        files = [one.path for one in self.inputs if one.role.startswith(MASK_ROLE)]
        return {structure_name(file): file for file in files if PurePosixPath(file).parent == inside}


def view_frame(R_ct_entry: Floats, target_ct: Floats) -> Floats:
    """T_ct_entry: the entry frame with its origin on the target, shape (4, 4), read-only."""
    T = pose(R_ct_entry, target_ct)
    T.setflags(write=False)
    return T
