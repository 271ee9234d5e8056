"""A case: a validated case file, in LPS (or local) mm and radians, with the hash of every input."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.arm.speed_limits import SpeedLimits
from puncture_twin.planning.arm.tool_body import ToolBody
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.provenance import CASE_ROLE, Input, InputFiles
from puncture_twin.planning.base.toml_file import find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case_file import (
    CaseFile,
    GantrySection,
    ObstacleSection,
    PlaceSection,
    RankingSection,
    RehearsalSection,
    SearchSection,
    StructureSection,
    StructuresSection,
)
from puncture_twin.planning.case.case_volumes import VOLUME_ROLES, CaseVolumes
from puncture_twin.planning.case.entry import entry_frame, view_frame
from puncture_twin.planning.case.errors import Cells, ErrorModel, error_model
from puncture_twin.planning.case.errors_section import ErrorsSection
from puncture_twin.planning.case.html import case_html
from puncture_twin.planning.case.mount import axes_frame, mount_pose
from puncture_twin.planning.case.named_files import MASK_ROLE, named_files
from puncture_twin.planning.case.options import NO_OPTIONS, OPTIONS_ROLE, CaseOptions
from puncture_twin.planning.case.registration_section import (
    NO_RESIDUALS,
    MarkerSection,
    RegistrationSection,
    stated_base_ct,
)
from puncture_twin.planning.case.sections.arm import arm_of
from puncture_twin.planning.case.sections.bend import bending_of
from puncture_twin.planning.case.sections.breath import breathing_of
from puncture_twin.planning.case.sections.tool_section import tool_of
from puncture_twin.planning.case.settings import (
    CtSettings,
    Gantry,
    Needle,
    Obstacle,
    RobotSettings,
    SearchSettings,
)
from puncture_twin.planning.case.whole_case import wholeness_warnings
from puncture_twin.planning.formats import itk_transform
from puncture_twin.planning.formats.labels.mask_folder import structure_name
from puncture_twin.planning.formats.points.point_files import parse_points
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.needle.bending import Bending

ALLOWED_CASE = "a TOML case file with schema = 1 or 2, or a folder with case.toml"


ROBOT_NOWHERE = (
    "the case names a robot ({robot}), but not where its base is: the arm is not checked "
    "([registration] or [robot.mount] says it)"
)


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
        target = _read_only(target_ct)
        return replace(self, target_ct=target, T_ct_entry=view_frame(self.T_ct_entry[:3, :3], target))

    @property
    def folder(self) -> Path:
        """The folder to which every path of the case is relative."""
        return self.path.parent

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
    _read_files(content, path, files, case_volumes)
    space = Space(content.space)
    target = _target(content, path, space, files)
    settings, robot, tool = content.search, _robot(content, space, path, files), tool_of(content.tool, files, path)
    return Case(
        path=path,
        name=content.name,
        space=space,
        target_ct=target,
        target_name=content.target.name,
        target_structure=content.target.structure or content.target.name,
        own_target=content.target.structure is None,
        needle=Needle(**content.needle.model_dump(include={*Needle.__dataclass_fields__})),
        search=_search(content.search),
        ranking=content.ranking,
        T_ct_entry=view_frame(entry_frame(settings.frame, space, where=path), target),
        structure=content.structure,
        structures=content.structures,
        registration=_markers(content.registration),
        robot=robot,
        tool=tool,
        obstacles=tuple(_obstacle(one, space) for one in content.obstacle),
        rehearsal=content.rehearsal,
        files=files,
        volumes=case_volumes,
        ct=CtSettings(**content.ct.model_dump(), trust_labels=settings.trust_labels),
        gantry=None if content.gantry is None else _gantry(content.gantry, space, path),
        place=content.place,
        stated_structures=content.stated_structures,
        region=content.region,
        warnings=(*wholeness_warnings(content, files, path), *_of_transform(content), *_of_robot(content, robot)),
        hit_radius_mm=content.target.hit_radius_mm,
        errors=_errors(content, content.errors, case_volumes, path),
        truth_errors=_errors(content, content.rehearsal.errors, case_volumes, path, truth=True),
        breathing=breathing_of(content.breathing, space, path),
        bending=bending_of(content.needle, content.tissue, path),
    )


def _read_files(content: CaseFile, path: Path, files: InputFiles, case_volumes: CaseVolumes) -> None:
    """Read and hash whatever the case names, each file once."""
    for one in named_files(content, path):
        if one.role in VOLUME_ROLES or one.role.startswith(MASK_ROLE):
            case_volumes.read(one.role, one.name, key=one.key)
        else:
            files.read(one.role, one.name, max_bytes=one.max_bytes, key=one.key, where=path)
    for many in content.structures:
        case_volumes.read_masks(many, _ct_name(content))


def _search(section: SearchSection) -> SearchSettings:
    return SearchSettings(
        theta=(np.radians(section.theta_deg[0]), np.radians(section.theta_deg[1])),
        beta=(np.radians(section.beta_deg[0]), np.radians(section.beta_deg[1])),
        step=np.radians(section.step_deg),
        max_skin_angle=np.radians(section.max_skin_angle_deg),
        min_hit=section.min_hit,
        max_touch=section.max_touch,
        max_touch_of=MappingProxyType(dict(section.max_touch_of)),
    )


def _obstacle(section: ObstacleSection, space: Space) -> Obstacle:
    """A box; its centre is in the case's space where its frame is the CT's."""
    center = np.asarray(section.center_mm)
    center = center if section.frame == "base" else to_lps(center[None], space)[0]
    return Obstacle(section.name, section.frame, center, np.asarray(section.size_mm))


def _errors(
    content: CaseFile, section: ErrorsSection | None, case_volumes: CaseVolumes, path: Path, *, truth: bool = False
) -> ErrorModel | None:
    """The declared errors, or the truth's own, which know no short form and no older names."""
    if section is None:
        return None
    return error_model(
        section,
        space=Space(content.space),
        cells=_ct_cells(content, case_volumes),
        fle_mm=None if truth or content.registration is None else content.registration.fle_mm,
        rehearsal=None if truth else content.rehearsal,
        where=f"{path}: {'rehearsal.errors' if truth else 'errors'}",
    )


def _ct_cells(content: CaseFile, case_volumes: CaseVolumes) -> Cells | None:
    """Pixel, slice spacing and slice normal of the case's CT; None without one."""
    name = _ct_name(content)
    if name is None:
        return None
    grid = case_volumes.source(name).grid
    spacing = grid.spacing_mm
    return Cells(float(spacing[:2].max()), float(spacing[2]), grid.T_ct_index[:3, 2] / spacing[2])


def _ct_name(content: CaseFile) -> str | None:
    """The CT that the skin comes from, or the one that stands beside it."""
    return next((one.ct for one in content.structure if one.ct is not None), content.ct.file)


def _target(content: CaseFile, path: Path, space: Space, files: InputFiles) -> Floats:
    target = content.target
    if target.position_mm is not None:
        return _read_only(to_lps(np.asarray([target.position_mm]), space)[0])
    assert target.points is not None  # held by the schema
    listed = parse_points(files.content(target.points), path.parent / target.points, default_space=space)
    if target.name not in listed.names:
        names = ", ".join(listed.names)
        raise InputError(f"target.name '{target.name}' is not in {target.points}", where=path, allowed=names)
    return _read_only(listed.points[listed.names.index(target.name)].copy())


def _of_transform(content: CaseFile) -> tuple[str, ...]:
    """What a registration lacks that only states its result."""
    stated = content.registration
    if stated is None or stated.transform is None:
        return ()
    return (f"registration: {NO_RESIDUALS.format(file=stated.transform)}",)


def _of_robot(content: CaseFile, robot: RobotSettings) -> tuple[str, ...]:
    """That a robot is named, and nothing said of where it is located: then no verdict is about it."""
    located = content.registration is not None or content.robot.mount is not None
    nowhere = not located and bool({"robot", "tool"} & content.model_fields_set)
    return (ROBOT_NOWHERE.format(robot=robot.model.name),) if nowhere else ()


def _markers(section: RegistrationSection | None) -> MarkerSection | None:
    """The registration by markers; None where the case states a transform instead, or nothing."""
    return None if section is None or section.transform else MarkerSection(**section.model_dump())


def _robot(content: CaseFile, space: Space, path: Path, files: InputFiles) -> RobotSettings:
    robot, stated, model = content.robot, content.registration, arm_of(content.robot, files, path)
    home = None if robot.home_deg is None else _read_only(np.radians(np.asarray(robot.home_deg)))
    mount = None if robot.mount is None else mount_pose(robot.mount, space, path)
    speeds = SpeedLimits(*(getattr(robot, name) for name in SpeedLimits._fields))
    if stated is not None and stated.transform is not None:
        T_file = itk_transform.parse_transform(files.content(stated.transform), path.parent / stated.transform)
        mount = _read_only(stated_base_ct(stated, T_file))
        return RobotSettings(model, home, mount, stated.transform, speeds)
    return RobotSettings(model, home, mount, speeds=speeds)


def _gantry(gantry: GantrySection, space: Space, path: Path) -> Gantry:
    """The bore's pose: z along the axis, x to the top, and turned so that a positive tilt leans the top against z."""
    axes = axes_frame(gantry.axis or "head", gantry.up or "anterior", space, path, "gantry: axis and up")
    T = pose(axes, to_lps(np.asarray([gantry.center_mm]), space)[0])
    c, s = np.cos(np.radians(gantry.tilt_deg)), np.sin(np.radians(gantry.tilt_deg))
    tilt = pose([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], np.zeros(3))
    return Gantry(_read_only(T @ tilt), gantry.bore_diameter_mm, gantry.wall_mm, gantry.thickness_mm)


def _read_only(array: ArrayLike) -> Floats:
    frozen = np.array(array, dtype=np.float64)
    frozen.setflags(write=False)
    return frozen
