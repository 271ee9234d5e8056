"""A case: a case file and all that it names, read once and validated; in LPS (or local) mm and radians. Its bed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.provenance import CASE_ROLE, Input, InputFiles
from puncture_twin.planning.base.text import Facts, Shown, brief, did_you_mean
from puncture_twin.planning.base.toml_file import find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case import named_files, settings, tables
from puncture_twin.planning.case.case_file import NO_OPTIONS, OPTIONS_ROLE, CaseFile, CaseOptions, case_options
from puncture_twin.planning.case.entry import ANATOMICAL_LPS, Directions, direction, entry_frame, grid, lps_axis
from puncture_twin.planning.case.errors import ErrorModel, errors_of
from puncture_twin.planning.formats.guard import guard_points
from puncture_twin.planning.formats.labels.label_sources import structure_name
from puncture_twin.planning.formats.points import parse_points
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.needle.deflection import Bending

ALLOWED_CASE = "a TOML case file with schema = 2, or a folder with case.toml"


@dataclass(frozen=True, eq=False)
class Case(Shown):
    """A validated case: what a search, a plan and a rehearsal start from."""

    path: Path
    name: str
    space: Space
    target_ct: Floats
    """Shape (3,), the point to reach."""
    target_name: str
    target_structure: str
    needle: settings.Needle
    search: settings.SearchSettings
    ranking: tables.RankingSection
    T_ct_entry: Floats
    """Shape (4, 4), the entry frame, its origin on the target."""
    structure: tuple[tables.StructureSection, ...]
    structures: tuple[tables.StructuresSection, ...]
    registration: tables.MarkerSection | None
    robot: settings.RobotSettings
    obstacles: tuple[settings.Obstacle, ...]
    rehearsal: tables.RehearsalSection
    files: InputFiles
    volumes: named_files.CaseVolumes
    """Those of the files that are volumes: the CT and the label maps."""
    stated_structures: int
    """How many structures the case says that it has, the skin among them."""
    region: str
    ct: settings.CtSettings = field(default_factory=settings.CtSettings)
    gantry: settings.Gantry | None = None
    place: tables.PlaceSection = field(default_factory=tables.PlaceSection)
    warnings: tuple[str, ...] = ()
    hit_radius_mm: float | None = None
    """Within which of the target the tip hits; None counts the target's own mesh."""
    errors: ErrorModel | None = None
    """Declared errors; None, here and below, where the case does not state them."""
    truth_errors: ErrorModel | None = None
    """From what a rehearsal's truth is drawn instead, to test a wrong belief; None draws from `errors`."""
    breathing: Breathing | None = None
    stereo: settings.Stereo | None = None
    ultrasound: settings.Ultrasound | None = None
    control_scan: tables.ControlScanSection | None = None
    motion: settings.Motion | None = None
    bending: Bending | None = None
    own_target: bool = False
    """Whether the target lies in no structure: its own is then the ball of the hit radius about it, which has its
    name."""
    tool: ToolBody | None = None
    """A body on the flange besides needle and holder."""
    options: CaseOptions = NO_OPTIONS
    """Options that replace values of the case file."""

    @brief
    def __repr__(self) -> str:
        return f"{self.name}, {self.path}: target {self.target_name} in {self.target_structure}"

    def _title(self) -> str:
        return f"Case {self.name}"

    def _facts(self) -> Facts:
        """Target, needle, structures, grid, robot, and what the case leaves open."""
        x, y, z = self.target_ct
        axes = "the local frame" if str(self.space) == "local" else "LPS"
        yield "target", f"{self.target_name} in {self.target_structure}: ({x:.1f}, {y:.1f}, {z:.1f}) mm in {axes}"
        one = self.needle
        yield "needle", f"⌀ {one.diameter_mm:g} mm, shaft {one.shaft_mm:g} mm, tip to flange {one.length_mm:g} mm"
        if self.tool is not None:
            size = " × ".join(f"{edge:.0f}" for edge in np.ptp(self.tool.mesh.bounds, axis=0))
            yield "tool", f"{self.tool.file.name}, {size} mm along the flange's axes"
        stated = [one.name for one in self.structure] + [f"as in {one.source}" for one in self.structures]
        yield "structures", ", ".join(stated) or "none"
        (low, high), (first, last) = np.degrees(self.search.theta), np.degrees(self.search.beta)
        step = np.degrees(self.search.step)
        yield "search", f"θ {low:g}° to {high:g}°, β {first:g}° to {last:g}°, every {step:g}°"
        yield "robot", self.robot.model.name
        base = "not stated" if self.robot.T_base_ct_mount is None else "by a stated mount"
        if self.robot.transform is not None:
            base = f"by the stated transform {self.robot.transform}: no residuals"
        if self.registration is not None:
            base = f"by registration of markers ({self.registration.method})"
        yield "its base", base
        yield "inputs", f"{len(self.inputs)} files, {self.path}"
        yield from (("warning", warning) for warning in self.warnings)

    def replace(self, *, target_ct: ArrayLike | None = None, **options: Mapping[str, Any]) -> Case:
        """The case with these values in place of its file's; the file stays as it is.

        Args:
            target_ct: Another target in the same structure, shape (3,), mm, LPS (or the case's local frame). Alone, it
                needs no file but the case file to be read again.
            options: Tables of keys and values as in the file, in mm, degrees and the case's space: ``target``,
                ``mount`` (in place of any registration), ``needle``, ``arm``, ``search``, ``errors``, ``margins``. Of
                margins that fit one structure the last stated counts; ``add_mm`` is added to all of them,
                and replaces an earlier ``add_mm``.

        Raises:
            InputError: A kind of option, a key or a value that the file could not have, a table without any, or a
                file that has changed.
        """
        for kind, values in options.items():
            if isinstance(values, Mapping) and not values:
                what = f"option '{kind}' has no keys, and changes nothing"
                refuse(what, "replace", "keys and values, as in the case", "empty")
        known = self if target_ct is not None and not options else None  # a target alone changes no other file
        if target_ct is not None:
            point = guard_points([target_ct], (self.target_name,), where="replace: target_ct")
            options = {**options, "target": {"position_mm": to_lps(point, self.space)[0]}}
        stated = self.options.with_(case_options(options, where="replace"))
        return _read(self.path, self.files.again(), stated, known)

    def directions(self) -> Directions:
        """The grid of the case."""
        return grid(self.search.theta, self.search.beta, self.search.step, self.T_ct_entry[:3, :3])

    def direction(self, theta: Floats | float, beta: Floats | float) -> Directions:
        """A single direction of the case's entry frame, or several, shape (n,), rad."""
        return direction(theta, beta, self.T_ct_entry[:3, :3])

    @property
    def folder(self) -> Path:
        """The folder to which every path of the case is relative."""
        return self.path.parent

    @property
    def skin_section(self) -> tables.StructureSection:
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
        files = [one.path for one in self.inputs if one.role.startswith(named_files.MASK_ROLE)]
        return {structure_name(file): file for file in files if PurePosixPath(file).parent == inside}


def view_frame(R_ct_entry: Floats, target_ct: Floats) -> Floats:
    """T_ct_entry: the entry frame with its origin on the target, shape (4, 4), read-only."""
    return read_only(pose(R_ct_entry, target_ct))


def load_case(path: Path | str, options: CaseOptions = NO_OPTIONS) -> Case:
    """Read and validate a case file, or a folder that holds ``case.toml``.

    ``options`` are stated in place of what the file states, and an input of their own. Raises InputError: anything
    unreadable, unknown, missing or contradictory; names the key.
    """
    path = find_toml(path, "case.toml")
    return _read(path, InputFiles(path.parent), options)


def _read(path: Path, files: InputFiles, options: CaseOptions, known: Case | None = None) -> Case:
    """Read a case; of one that differs from a known one by its target alone, the case file is looked at again."""
    case_volumes = named_files.CaseVolumes(files, path) if known is None else known.volumes
    stated = files.add(CASE_ROLE, path.name, files.held(path.name) or read_toml_bytes(path, ALLOWED_CASE))
    if options.sections:
        files.state(OPTIONS_ROLE, options.text.encode())
    change = partial(options.applied, where=path)
    content = parse_toml(stated, path, CaseFile, allowed=ALLOWED_CASE, keys="docs/reference/case.md", change=change)
    if known is None:
        whole = named_files.read_named_files(content, path, files, case_volumes)
    else:
        files.take(known.files, but=("target", OPTIONS_ROLE))
        whole = named_files.wholeness_warnings(content, files, path)
    return replace(case_of(content, path, files, case_volumes, whole), options=options)


def case_of(
    content: CaseFile, path: Path, files: InputFiles, case_volumes: named_files.CaseVolumes, warnings: tuple[str, ...]
) -> Case:
    """Make a case of its file and the files that it names, in LPS (or local) mm and radians."""
    space = Space(content.space)
    target = _target_of(content, path, space, files)
    robot = settings.robot_of(content, space, path, files)
    tool = settings.tool_of(content.tool, files, path)
    searched, placed, motion = content.search, content.registration, None
    if content.motion is not None:  # a diagonal covariance: LPS and RAS are the same
        motion = settings.Motion(read_only(np.diag(np.square(content.motion.target_sd_mm))))
    return Case(
        path=path,
        name=content.name,
        space=space,
        target_ct=target,
        target_name=content.target.name,
        target_structure=content.target.structure or content.target.name,
        own_target=content.target.structure is None,
        needle=settings.Needle(**content.needle.model_dump(include={*settings.Needle.__dataclass_fields__})),
        search=settings.search_of(searched),
        obstacles=tuple(settings.obstacle_of(one, space) for one in content.obstacle),
        ranking=content.ranking,
        T_ct_entry=view_frame(entry_frame(searched.frame, space, where=path), target),
        structure=content.structure,
        structures=content.structures,
        registration=None if placed is None or placed.transform else tables.MarkerSection(**placed.model_dump()),
        robot=robot,
        tool=tool,
        rehearsal=content.rehearsal,
        files=files,
        volumes=case_volumes,
        ct=settings.ct_of(content.ct, trust_labels=searched.trust_labels),
        gantry=None if content.gantry is None else settings.gantry_of(content.gantry, space, path),
        place=content.place,
        stated_structures=content.stated_structures,
        region=content.region,
        warnings=(*warnings, *settings.robot_warnings(content, robot)),
        hit_radius_mm=content.target.hit_radius_mm,
        errors=errors_of(content, content.errors, case_volumes, path),
        truth_errors=errors_of(content, content.rehearsal.errors, case_volumes, path, truth=True),
        breathing=settings.breathing_of(content.breathing, space, path),
        stereo=settings.stereo_of(content.stereo, space, path),
        ultrasound=settings.ultrasound_of(content.ultrasound, space, path),
        control_scan=content.control_scan,
        motion=motion,
        bending=settings.bending_of(content.needle, content.tissue, path),
    )


def _target_of(content: CaseFile, path: Path, space: Space, files: InputFiles) -> Floats:
    """The point to reach, shape (3,), LPS (or the case's local frame) mm, read-only."""
    target = content.target
    if target.position_mm is not None:
        return read_only(to_lps(np.asarray([target.position_mm]), space)[0])
    assert target.points is not None  # held by the schema
    listed = parse_points(files.content(target.points), path.parent / target.points, default_space=space)
    if target.name not in listed.names:
        what = f"target.name '{target.name}' is not in {target.points}{did_you_mean(target.name, listed.names)}"
        refuse(what, path, ", ".join(listed.names), "unknown_point")
    return read_only(listed.points[listed.names.index(target.name)].copy())


Vector = tuple[float, float, float]
UPRIGHT = 0.5
"""An entry frame whose z lies within 60 degrees of the body's long axis is not the direction up."""


def bed_frame(case: Case) -> Floats:
    """T_ct_bed (4, 4), read-only, mm: x along the bed (to the head), y across (to the right of one on the back), z up.

    See `up_axis` and `along_axis`. Raises InputError: the two are parallel.
    """
    R_ct_bed = settings.axes_frame(up_axis(case), along_axis(case), Space.LPS, case.path, "place: up and along")
    return view_frame(R_ct_bed, case.target_ct)


def up_axis(case: Case) -> Vector:
    """Up in LPS (or the local frame), of any length: ``place.up``.

    Left out, it is the entry frame's z, or the front where that z runs along the body.
    """
    up, head = case.T_ct_entry[:3, 2], np.array(ANATOMICAL_LPS["head"])
    if case.space is not Space.LOCAL and abs(up @ head) > UPRIGHT:
        up = np.array(ANATOMICAL_LPS["anterior"])
    return _stated(case.place.up, case.space, up)


def along_axis(case: Case) -> Vector:
    """Along the bed, likewise: ``place.along``, else the head, or the entry frame's x where there is no head."""
    along = case.T_ct_entry[:3, 0] if case.space is Space.LOCAL else np.array(ANATOMICAL_LPS["head"])
    return _stated(case.place.along, case.space, along)


def _stated(axis: settings.Axis | None, space: Space, otherwise: Floats) -> Vector:
    """An axis that the case states, or the default, in LPS (or the local frame)."""
    x, y, z = (otherwise if axis is None else lps_axis(axis, space)).tolist()
    return x, y, z
