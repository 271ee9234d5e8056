"""A case: a validated case file, in LPS (or local) mm and radians, with the hash of every input."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from puncture_twin.planning.arm.tool_body import ToolBody
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.near_names import did_you_mean
from puncture_twin.planning.base.provenance import CASE_ROLE, Input, InputFiles
from puncture_twin.planning.base.toml_file import find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.case_volumes import CaseVolumes
from puncture_twin.planning.case.entry import Directions, direction, entry_frame, grid, view_frame
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.case.html import case_html
from puncture_twin.planning.case.named_files import MASK_ROLE, read_named_files
from puncture_twin.planning.case.options import NO_OPTIONS, OPTIONS_ROLE, CaseOptions
from puncture_twin.planning.case.sections.bend import bending_of
from puncture_twin.planning.case.sections.breath import breathing_of
from puncture_twin.planning.case.sections.robot import robot_of
from puncture_twin.planning.case.sections.stated_errors import errors_of
from puncture_twin.planning.case.sections.tool_section import tool_of
from puncture_twin.planning.case.settings import (
    CtSettings,
    Gantry,
    Needle,
    Obstacle,
    RobotSettings,
    SearchSettings,
    gantry_of,
    obstacle_of,
    search_of,
)
from puncture_twin.planning.case.tables.errors_section import RehearsalSection
from puncture_twin.planning.case.tables.place_section import PlaceSection
from puncture_twin.planning.case.tables.registration_section import MarkerSection
from puncture_twin.planning.case.tables.search_section import RankingSection
from puncture_twin.planning.case.tables.structures_section import StructureSection, StructuresSection
from puncture_twin.planning.case.whole_case import robot_warnings, wholeness_warnings
from puncture_twin.planning.formats.labels.mask_folder import structure_name
from puncture_twin.planning.formats.points.point_files import parse_points
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.needle.deflection import Bending

ALLOWED_CASE = "a TOML case file with schema = 1 or 2, or a folder with case.toml"


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


def load_case(path: Path | str, options: CaseOptions = NO_OPTIONS) -> Case:
    """Read and validate a case file, or a folder that holds ``case.toml``.

    Args:
        path: The file or the folder.
        options: What is stated in place of what the file states; they are an input of their own.

    Raises:
        InputError: Anything unreadable, unknown, missing or contradictory; names the key.
    """
    path = find_toml(path, "case.toml")
    files = InputFiles(path.parent)
    case_volumes = CaseVolumes(files, path)
    stated = files.add(CASE_ROLE, path.name, read_toml_bytes(path, ALLOWED_CASE))
    if options.sections:
        files.state(OPTIONS_ROLE, options.text.encode())
    change = partial(options.applied, where=path)
    content = parse_toml(stated, path, CaseFile, allowed=ALLOWED_CASE, keys="docs/reference/case.md", change=change)
    read_named_files(content, path, files, case_volumes)
    return _case_of(content, path, files, case_volumes)


def _case_of(content: CaseFile, path: Path, files: InputFiles, case_volumes: CaseVolumes) -> Case:
    """What a case file and the files that it names state, in LPS (or local) mm and radians."""
    space = Space(content.space)
    target = target_of(content, path, space, files)
    robot = robot_of(content, space, path, files)
    tool = tool_of(content.tool, files, path)
    settings, placed = content.search, content.registration
    return Case(
        path=path,
        name=content.name,
        space=space,
        target_ct=target,
        target_name=content.target.name,
        target_structure=content.target.structure or content.target.name,
        own_target=content.target.structure is None,
        needle=Needle(**content.needle.model_dump(include={*Needle.__dataclass_fields__})),
        search=search_of(settings),
        obstacles=tuple(obstacle_of(one, space) for one in content.obstacle),
        ranking=content.ranking,
        T_ct_entry=view_frame(entry_frame(settings.frame, space, where=path), target),
        structure=content.structure,
        structures=content.structures,
        registration=None if placed is None or placed.transform else MarkerSection(**placed.model_dump()),
        robot=robot,
        tool=tool,
        rehearsal=content.rehearsal,
        files=files,
        volumes=case_volumes,
        ct=CtSettings(**content.ct.model_dump(), trust_labels=settings.trust_labels),
        gantry=None if content.gantry is None else gantry_of(content.gantry, space, path),
        place=content.place,
        stated_structures=content.stated_structures,
        region=content.region,
        warnings=(*wholeness_warnings(content, files, path), *robot_warnings(content, robot)),
        hit_radius_mm=content.target.hit_radius_mm,
        errors=errors_of(content, content.errors, case_volumes, path),
        truth_errors=errors_of(content, content.rehearsal.errors, case_volumes, path, truth=True),
        breathing=breathing_of(content.breathing, space, path),
        bending=bending_of(content.needle, content.tissue, path),
    )


def target_of(content: CaseFile, path: Path, space: Space, files: InputFiles) -> Floats:
    """The point to reach, shape (3,), LPS (or the case's local frame) mm, read-only.

    Args:
        content: The case file.
        path: Where it is, for errors.
        space: The case's.
        files: What it names, read.

    Raises:
        InputError: A list of points that cannot be read, or that lacks the target's name.
    """
    target = content.target
    if target.position_mm is not None:
        return read_only(to_lps(np.asarray([target.position_mm]), space)[0])
    assert target.points is not None  # held by the schema
    listed = parse_points(files.content(target.points), path.parent / target.points, default_space=space)
    if target.name not in listed.names:
        names = ", ".join(listed.names)
        what = f"target.name '{target.name}' is not in {target.points}{did_you_mean(target.name, listed.names)}"
        raise InputError(what, where=path, allowed=names)
    return read_only(listed.points[listed.names.index(target.name)].copy())
