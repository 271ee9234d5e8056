"""A case: a validated case file, in LPS (or local) mm and radians, with the hash of every input."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.arm.speed_limits import DEFAULT_SPEEDS, SpeedLimits
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.provenance import CASE_ROLE, Input, InputFiles
from puncture_twin.planning.base.toml_file import find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.case.case_file import (
    AIR_HU,
    DENSE_HU,
    CaseFile,
    EntryAxes,
    GantrySection,
    MountSection,
    PlaceSection,
    RankingSection,
    RehearsalSection,
    StructureSection,
    StructuresSection,
)
from puncture_twin.planning.case.case_volumes import VOLUME_ROLES, CaseVolumes
from puncture_twin.planning.case.entry import entry_frame, view_frame
from puncture_twin.planning.case.errors import Cells, ErrorModel, error_model
from puncture_twin.planning.case.errors_section import ErrorsSection
from puncture_twin.planning.case.html import case_html
from puncture_twin.planning.case.registration_section import (
    NO_RESIDUALS,
    MarkerSection,
    RegistrationSection,
    stated_base_ct,
)
from puncture_twin.planning.case.toml_types import Anatomical
from puncture_twin.planning.case.whole_case import wholeness_warnings
from puncture_twin.planning.formats import itk_transform
from puncture_twin.planning.formats.labels import naming
from puncture_twin.planning.formats.labels.mask_folder import mask_files, structure_name
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.formats.points import point_files as points
from puncture_twin.planning.formats.points.point_files import parse_points
from puncture_twin.planning.formats.volumes import volume_files as volumes
from puncture_twin.planning.geometry.rigid import frame_of_axes, pose
from puncture_twin.planning.geometry.spaces import Space, to_lps

ALLOWED_CASE = "a TOML case file with schema = 1 or 2, or a folder with case.toml"


MASK_ROLE = "mask "
"""How the role of a mask begins; its structure's name follows."""

AXES_PARALLEL = 0.999
"""|cos| above which a mount's x and z axes do not span a frame (2.6 degrees)."""

LIKE_METRES = 5.0
"""A base that stands nearer to the CT's origin than this, and not on it, is one in metres: no arm reaches farther."""

AXES_SQUARE_DEG = 1.0
"""A mount's x and z axes may differ from a right angle by this much: what rounding to two digits leaves. More is
another rotation than was meant, and 1 degree moves the needle's tip by 9 mm at the arm's reach of half a metre."""


@dataclass(frozen=True)
class Needle:
    """The needle on the flange; lengths in mm, from the tip."""

    length_mm: float
    shaft_mm: float
    diameter_mm: float
    standoff_mm: float | None
    skin_gap_mm: float
    holder_diameter_mm: float

    @property
    def radius_mm(self) -> float:
        """Half the diameter."""
        return self.diameter_mm / 2


@dataclass(frozen=True)
class SearchSettings:
    """The grid of directions, the limit at the skin and those of the chances; radians.

    Attributes:
        min_hit: Least chance to hit the target; None sets no limit.
        max_touch: Greatest chance to touch any one structure; None sets no limit.
        max_touch_of: The same for single structures, by name, instead.
    """

    theta: tuple[float, float]
    beta: tuple[float, float]
    step: float
    max_skin_angle: float
    min_hit: float | None = None
    max_touch: float | None = None
    max_touch_of: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class CtSettings:
    """The CT beside the structures.

    Attributes:
        file: Where the skin does not come from a CT, the CT's file, or None.
        air_hu: Outside of the body, what is denser is not air.
        dense_hu: Inside the body, what is at least so dense must belong to a structure.
        margin_mm: Clearance that these structures demand.
        trust_labels: Whether the inside is left to the structures alone.
    """

    file: str | None = None
    air_hu: float = AIR_HU
    dense_hu: float = DENSE_HU
    margin_mm: float = 2.0
    trust_labels: bool = False


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A box in the room, axes parallel to its frame's."""

    name: str
    frame: str
    center_mm: Floats
    size_mm: Floats


@dataclass(frozen=True, eq=False)
class Gantry:
    """A wall with a round bore.

    Attributes:
        T_ct_gantry: Shape (4, 4), mm: the bore's centre; its axis is z, its top x.
        bore_diameter_mm: Of the bore.
        wall_mm: How far the wall reaches outward from the bore.
        thickness_mm: Along the bore.
    """

    T_ct_gantry: Floats
    bore_diameter_mm: float
    wall_mm: float
    thickness_mm: float


@dataclass(frozen=True, eq=False)
class RobotSettings:
    """The arm.

    Attributes:
        model: Its name.
        home: Shape (6,), rad, or None for the model's own.
        T_base_ct_mount: Shape (4, 4), mm, where a mount or a transform is stated, or None.
        transform: The file that states it, or None.
        speeds: How fast its plans may move.
    """

    model: str
    home: Floats | None
    T_base_ct_mount: Floats | None
    transform: str | None = None
    speeds: SpeedLimits = DEFAULT_SPEEDS


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
        own_target: Whether the target lies in no structure: its own is then the ball of the hit radius about it, which
            has its name.
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
    ct: CtSettings = CtSettings()
    gantry: Gantry | None = None
    place: PlaceSection = field(default_factory=PlaceSection)
    stated_structures: int | None = None
    region: str | None = None
    warnings: tuple[str, ...] = ()
    hit_radius_mm: float | None = None
    errors: ErrorModel | None = None
    truth_errors: ErrorModel | None = None
    own_target: bool = False

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return case_html(self)

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


def load_case(path: Path | str) -> Case:
    """Read and validate a case file, or a folder that holds ``case.toml``.

    Raises:
        InputError: Anything unreadable, unknown, missing or contradictory; names the key.
    """
    path = find_toml(path, "case.toml")
    files = InputFiles(path.parent)
    case_volumes = CaseVolumes(files, path)
    stated = files.add(CASE_ROLE, path.name, read_toml_bytes(path, ALLOWED_CASE))
    content = parse_toml(stated, path, CaseFile, allowed=ALLOWED_CASE, keys="docs/reference/case.md")
    for one in _named_files(content, path):
        if one.role in VOLUME_ROLES or one.role.startswith(MASK_ROLE):
            case_volumes.read(one.role, one.name, key=one.key)
        else:
            files.read(one.role, one.name, max_bytes=one.max_bytes, key=one.key, where=path)
    for many in content.structures:
        case_volumes.read_masks(many, _ct_name(content))
    space = Space(content.space)
    target = _target(content, path, space, files)
    settings = content.search
    return Case(
        path=path,
        name=content.name,
        space=space,
        target_ct=target,
        target_name=content.target.name,
        target_structure=content.target.structure or content.target.name,
        own_target=content.target.structure is None,
        needle=Needle(**content.needle.model_dump()),
        search=SearchSettings(
            theta=(np.radians(settings.theta_deg[0]), np.radians(settings.theta_deg[1])),
            beta=(np.radians(settings.beta_deg[0]), np.radians(settings.beta_deg[1])),
            step=np.radians(settings.step_deg),
            max_skin_angle=np.radians(settings.max_skin_angle_deg),
            min_hit=settings.min_hit,
            max_touch=settings.max_touch,
            max_touch_of=MappingProxyType(dict(settings.max_touch_of)),
        ),
        ranking=content.ranking,
        T_ct_entry=view_frame(entry_frame(settings.frame, space, where=path), target),
        structure=content.structure,
        structures=content.structures,
        registration=_markers(content.registration),
        robot=_robot(content, space, path, files),
        obstacles=tuple(
            Obstacle(
                o.name,
                o.frame,
                np.asarray(o.center_mm) if o.frame == "base" else to_lps(np.asarray([o.center_mm]), space)[0],
                np.asarray(o.size_mm),
            )
            for o in content.obstacle
        ),
        rehearsal=content.rehearsal,
        files=files,
        volumes=case_volumes,
        ct=CtSettings(**content.ct.model_dump(), trust_labels=settings.trust_labels),
        gantry=None if content.gantry is None else _gantry(content.gantry, space, path),
        place=content.place,
        stated_structures=content.stated_structures,
        region=content.region,
        warnings=(*wholeness_warnings(content, files, path), *_of_transform(content)),
        hit_radius_mm=content.target.hit_radius_mm,
        errors=_errors(content, content.errors, case_volumes, path),
        truth_errors=_errors(content, content.rehearsal.errors, case_volumes, path, truth=True),
    )


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


def _markers(section: RegistrationSection | None) -> MarkerSection | None:
    """The registration by markers; None where the case states a transform instead, or nothing."""
    return None if section is None or section.transform else MarkerSection(**section.model_dump())


def _robot(content: CaseFile, space: Space, path: Path, files: InputFiles) -> RobotSettings:
    robot, stated = content.robot, content.registration
    home = None if robot.home_deg is None else _read_only(np.radians(np.asarray(robot.home_deg)))
    mount = None if robot.mount is None else mount_pose(robot.mount, space, path)
    speeds = SpeedLimits(*(getattr(robot, name) for name in SpeedLimits._fields))
    if stated is not None and stated.transform is not None:
        T_file = itk_transform.parse_transform(files.content(stated.transform), path.parent / stated.transform)
        mount = _read_only(stated_base_ct(stated, T_file))
        return RobotSettings(ur_model(robot.model).name, home, mount, stated.transform, speeds)
    return RobotSettings(ur_model(robot.model).name, home, mount, speeds=speeds)


def mount_pose(mount: MountSection, space: Space, path: Path) -> Floats:
    """T_base_ct, shape (4, 4), from the base's origin and axes, as a case states them in its own space.

    Raises:
        InputError: The axes are parallel or zero, or not at a right angle, or the position looks like metres.
    """
    x, z = (to_lps(np.asarray([v], dtype=float), space)[0] for v in (mount.x_axis, mount.z_axis))
    lengths = np.linalg.norm(x), np.linalg.norm(z)
    if min(lengths) == 0 or abs(x @ z) > AXES_PARALLEL * lengths[0] * lengths[1]:
        raise InputError("robot.mount: x_axis and z_axis are parallel or zero", where=path, allowed="two axes")
    angle = float(np.degrees(np.arccos(x @ z / (lengths[0] * lengths[1]))))
    if abs(angle - 90.0) > AXES_SQUARE_DEG:
        raise InputError(
            f"robot.mount: x_axis and z_axis are {angle:.1f} degrees apart",
            where=path,
            allowed=f"a right angle, to {AXES_SQUARE_DEG:g} degree",
        )
    far = float(np.linalg.norm(mount.position_mm))
    if 0.0 < far < LIKE_METRES:
        raise InputError(
            f"robot.mount: position_mm is {far:g} mm from the origin, which would be a base within the patient",
            where=path,
            allowed="millimetres (these look like metres)",
        )
    T_ct_base = pose(frame_of_axes(z, x), to_lps(np.asarray([mount.position_mm]), space)[0])
    return _read_only(np.linalg.inv(T_ct_base))


def _gantry(gantry: GantrySection, space: Space, path: Path) -> Gantry:
    """The bore's pose: z along the axis, x to the top, and turned so that a positive tilt leans the top against z."""
    axes = axes_frame(gantry.axis or "head", gantry.up or "anterior", space, path, "gantry: axis and up")
    T = pose(axes, to_lps(np.asarray([gantry.center_mm]), space)[0])
    c, s = np.cos(np.radians(gantry.tilt_deg)), np.sin(np.radians(gantry.tilt_deg))
    tilt = pose([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], np.zeros(3))
    return Gantry(_read_only(T @ tilt), gantry.bore_diameter_mm, gantry.wall_mm, gantry.thickness_mm)


Axis = Anatomical | tuple[float, float, float]


def axes_frame(z: Axis, x: Axis, space: Space, path: Path, key: str) -> Floats:
    """R_ct_frame, shape (3, 3), of a frame whose z axis is given and whose x axis is what of ``x`` is square to it.

    Raises:
        InputError: The two are parallel or zero; names ``key``.
    """
    try:
        return entry_frame(EntryAxes(z=z, x=x), space, where=path)
    except InputError as error:
        raise InputError(f"{key} are parallel or zero", where=path, allowed="two axes") from error


class _Named(NamedTuple):
    """A file that a case names."""

    role: str
    name: str
    key: str
    max_bytes: int


def _named_files(content: CaseFile, path: Path) -> Iterator[_Named]:
    """Every file that a case names, in the order of its sections; of a folder of masks every mask."""
    if content.target.points is not None:
        yield _Named("target", content.target.points, "target.points", points.MAX_FILE_BYTES)
    for one in content.structure:
        key = f"structure '{one.name}'"
        if one.mesh is not None:
            yield _Named(f"mesh {one.name}", one.mesh, key, meshes.MAX_FILE_BYTES)
        if one.labelmap is not None:
            yield _Named("labelmap", one.labelmap, key, volumes.MAX_FILE_BYTES)
        if one.ct is not None:
            yield _Named("ct", one.ct, key, volumes.MAX_FILE_BYTES)
    for number, many in enumerate(content.structures):
        yield from _many_files(many, f"structures.{number}", path)
        if many.naming is not None and naming.is_naming_file(many.naming):
            yield _Named("naming", many.naming, f"structures.{number}.naming", naming.MAX_CSV_BYTES)
    if content.ct.file is not None:
        yield _Named("ct", content.ct.file, "ct.file", volumes.MAX_FILE_BYTES)
    for side in ("markers_ct", "markers_base", "transform"):
        file = getattr(content.registration, side, None)
        most = itk_transform.MAX_FILE_BYTES if side == "transform" else points.MAX_FILE_BYTES
        if file is not None:
            yield _Named(side, file, f"registration.{side}", most)
    if content.rehearsal.truth_base is not None:
        yield _Named("truth_base", content.rehearsal.truth_base, "rehearsal.truth_base", points.MAX_FILE_BYTES)


def _many_files(many: StructuresSection, key: str, path: Path) -> Iterator[_Named]:
    """A label map, or every file of a folder of masks: also empty ones decide what is there."""
    if many.labelmap is not None:
        yield _Named("labelmap", many.labelmap, f"{key}.labelmap", volumes.MAX_FILE_BYTES)
    for role in ("seg", "rtstruct"):
        if (file := getattr(many, role)) is not None:
            yield _Named(role, file, f"{key}.{role}", volumes.MAX_FILE_BYTES)
    if many.ct is not None:
        yield _Named("ct", many.ct, f"{key}.ct", volumes.MAX_FILE_BYTES)
    if many.masks is not None:
        for file in mask_files(path.parent / many.masks, where=f"{path}: {key}.masks"):
            name = str(PurePosixPath(many.masks) / file)
            yield _Named(f"{MASK_ROLE}{structure_name(file)}", name, f"{key}.masks", volumes.MAX_FILE_BYTES)


def _read_only(array: ArrayLike) -> Floats:
    frozen = np.array(array, dtype=np.float64)
    frozen.setflags(write=False)
    return frozen
