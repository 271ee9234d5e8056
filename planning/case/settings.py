"""What a validated case holds beside its structures, in mm and radians and in the CT's frame.

Needle and its bending, search, CT, obstacles, gantry, arm, devices that see needle and target, motion and breathing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from types import MappingProxyType

import numpy as np
import scipy

from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS, SpeedLimits
from puncture_twin.planning.arm.links import own_arm
from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.arm.ur import UrModel, ur_model
from puncture_twin.planning.arm.urdf.document import MOST_BYTES
from puncture_twin.planning.arm.urdf.lengths import NOTHING_STATED, JointLimits, StatedLimits, narrowed
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case import tables
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.entry import AXES_PARALLEL, entry_frame, lps_axis
from puncture_twin.planning.case.tables import TOOL_ROLE, Anatomical
from puncture_twin.planning.formats import itk_transform
from puncture_twin.planning.formats.labels.naming import REST, ByName
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.geometry.rigid import frame_of_axes, pose
from puncture_twin.planning.geometry.spaces import Space, parse_unit, to_lps
from puncture_twin.planning.needle.deflection import GAUGES, STEEL_GPA, Bending, Shaft, Tissue


@dataclass(frozen=True)
class Needle:
    """The needle on the flange; lengths in mm, from the tip. ``lengths_mm``: of those there are, tip to flange."""

    length_mm: float
    shaft_mm: float
    diameter_mm: float
    standoff_mm: float | None
    skin_gap_mm: float
    holder_diameter_mm: float
    lengths_mm: tuple[float, ...] = ()

    @property
    def radius_mm(self) -> float:
        """Half the diameter."""
        return self.diameter_mm / 2

    def of_length(self, length_mm: float) -> Needle:
        """This needle with another length: the same holder, a shaft that is shorter or longer by the difference."""
        return replace(self, length_mm=length_mm, shaft_mm=self.shaft_mm + length_mm - self.length_mm)

    @property
    def longest_path_mm(self) -> float:
        """The longest path, target to skin, that it can travel.

        The shaft must reach; and with a fixed standoff the tip must still lie ``skin_gap_mm`` outside, along it.
        """
        outside = np.inf if self.standoff_mm is None else self.standoff_mm - self.skin_gap_mm
        return min(self.shaft_mm, outside)


@dataclass(frozen=True)
class SearchSettings:
    """The grid of directions, the limit at the skin and those of the chances (None sets no limit); radians.

    ``max_touch`` is of any one structure, ``max_touch_of`` of single ones, by name, in its place.
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
    """The CT beside the structures."""

    file: str | None = None  # where the skin does not come from a CT, the CT's file, or None
    air_hu: float = tables.AIR_HU  # outside of the body, what is denser is not air
    dense_hu: float = tables.DENSE_HU  # inside the body, what is at least so dense must belong to a structure
    margin_mm: float = 2.0  # clearance that what the CT adds demands
    unnamed: str = "unknown"  # what the CT shows inside the body and no structure names: ``unknown``, or ``free``
    trust_labels: bool = False  # whether a person has seen that the structures lie right: no check of that refuses them
    arms: tables.Stated | None = None
    """Whether the image shows arms or other limbs beside the trunk, where a person states it."""
    table: tables.Stated | None = None  # whether it shows what the body lies on, where a person states it
    beyond_mm: float | None = None
    """How much wider than where the image cuts it the body may be beyond, where a person states it; infinite for all
    that lies beyond the plane of the cut."""

    @property
    def declared(self) -> tuple[str, ...]:
        """Sentences on what a person states of the image."""
        stated = ((self.arms, "no arms", "arms"), (self.table, "no table", "a table"))
        said = [f"declared: {no if one == 'none' else yes} in the image" for one, no, yes in stated if one is not None]
        if self.beyond_mm is not None:
            wider = "fills all" if np.isinf(self.beyond_mm) else f"is at most {self.beyond_mm:g} mm wider"
            said.append(f"declared: beyond the image the body {wider}")
        return tuple(said)


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A box in the workcell, axes parallel to its frame's."""

    name: str
    frame: str
    center_mm: Floats
    size_mm: Floats


@dataclass(frozen=True, eq=False)
class Gantry:
    """A wall that reaches so far outward from a round bore, whose axis is z of its frame, its top x; mm."""

    T_ct_gantry: Floats  # shape (4, 4), mm: the bore's centre; its axis is z, its top x
    bore_diameter_mm: float
    wall_mm: float
    thickness_mm: float


@dataclass(frozen=True, eq=False)
class RobotSettings:
    """The arm, its home (6,), rad, or None for the model's own, and where its base is."""

    model: UrModel
    home: Floats | None
    T_base_ct_mount: Floats | None  # shape (4, 4), mm, where a mount or a transform is stated
    stated: tables.RegistrationSection | None = None  # the section that states a transform
    speeds: SpeedLimits = DEFAULT_SPEEDS

    @property
    def transform(self) -> str | None:
        """The file of the stated transform, or None."""
        return None if self.stated is None else self.stated.transform


@dataclass(frozen=True, eq=False)
class Stereo:
    """Two cameras (2, 3), mm, None where they are to be proposed, and the balls on the needle that they see.

    The balls by their distance behind the needle's tip, ascending; ``sd_mm`` is of a point that both see, per axis.
    """

    cameras_ct: Floats | None  # shape (2, 3), mm: where the cameras are, or None where they are to be proposed
    balls_mm: tuple[float, ...]
    sd_mm: float


@dataclass(frozen=True, eq=False)
class Ultrasound:
    """A probe on an arm of its own, whose base is at T_base_ct_mount (4, 4), mm; None where that is to be proposed.

    Standard deviations of the readings of target and tip: per axis of the image plane, and across it.
    """

    model: UrModel
    T_base_ct_mount: Floats | None
    target_sd_mm: tuple[float, float]
    tip_sd_mm: tuple[float, float]
    calibration_sd_mm: float  # of the image's place on its arm, per axis
    depth_mm: float  # how deep the probe sees
    width_mm: float  # of its footprint


@dataclass(frozen=True, eq=False)
class Motion:
    """How the target, and what surrounds it, has moved since the scan: ``target_cov_ct``, shape (3, 3), mm^2."""

    target_cov_ct: Floats


def stereo_of(section: tables.StereoSection | None, space: Space, path: Path) -> Stereo | None:
    """The cameras; None where the case declares none. A position that looks like metres is refused."""
    if section is None:
        return None
    cameras = None
    if section.cameras_mm is not None:
        for position in section.cameras_mm:
            if 0.0 < float(np.linalg.norm(position)) < LIKE_METRES:
                what = f"stereo.cameras_mm: {list(position)} would be in the patient"
                refuse(what, path, "millimetres (these look like metres)", "wrong_unit")
        cameras = read_only(to_lps(np.asarray(section.cameras_mm), space))
    return Stereo(cameras, section.balls_mm, section.sd_mm)


def ultrasound_of(section: tables.UltrasoundSection | None, space: Space, path: Path) -> Ultrasound | None:
    """The probe and its arm; None where the case declares none. A mount that cannot be used is refused."""
    if section is None:
        return None
    mount = None if section.mount is None else mount_pose(section.mount, space, path, key="ultrasound.mount")
    stated = section.model_dump(exclude={"model", "mount"})
    return Ultrasound(model=ur_model(section.model), T_base_ct_mount=mount, **stated)


def ct_of(section: tables.CtSection, *, trust_labels: bool) -> CtSettings:
    """The CT's table; ``beyond_mm = "all"`` is infinite."""
    beyond_mm = np.inf if section.beyond_mm == "all" else section.beyond_mm
    return CtSettings(**section.model_dump(exclude={"beyond_mm"}), trust_labels=trust_labels, beyond_mm=beyond_mm)


def search_of(section: tables.SearchSection) -> SearchSettings:
    """The grid and the limits in radians."""
    (low, high), (first, last) = section.theta_deg, section.beta_deg
    ranges = (np.radians(low), np.radians(high)), (np.radians(first), np.radians(last))
    steps = np.radians(section.step_deg), np.radians(section.max_skin_angle_deg)
    touch_of = MappingProxyType(dict(section.max_touch_of))
    return SearchSettings(*ranges, *steps, section.min_hit, section.max_touch, touch_of)


def obstacle_of(section: tables.ObstacleSection, space: Space) -> Obstacle:
    """A box; its centre is in the case's space where its frame is the CT's."""
    center = np.asarray(section.center_mm)
    center = center if section.frame == "base" else to_lps(center[None], space)[0]
    return Obstacle(section.name, section.frame, center, np.asarray(section.size_mm))


def gantry_of(gantry: tables.GantrySection, space: Space, path: Path) -> Gantry:
    """The bore's pose: z along the axis, x to the top, and turned so that a positive tilt leans the top against z."""
    axes = axes_frame(gantry.axis or "head", gantry.up or "anterior", space, path, "gantry: axis and up")
    T = pose(axes, to_lps(np.asarray([gantry.center_mm]), space)[0])
    c, s = np.cos(np.radians(gantry.tilt_deg)), np.sin(np.radians(gantry.tilt_deg))
    tilt = pose([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], np.zeros(3))
    return Gantry(read_only(T @ tilt), gantry.bore_diameter_mm, gantry.wall_mm, gantry.thickness_mm)


LIKE_METRES = 5.0
"""A base that stands nearer to the CT's origin than this, and not on it, is one in metres: no arm reaches farther."""
AXES_SQUARE_DEG = 1.0
"""A mount's x and z axes may differ from a right angle by this much: what rounding to two digits leaves. More is
another rotation than was meant, and 1 degree moves the needle's tip by 9 mm at the arm's reach of half a metre."""
Axis = Anatomical | tuple[float, float, float]


def mount_pose(mount: tables.MountSection, space: Space, path: Path, *, key: str = "robot.mount") -> Floats:
    """T_base_ct, shape (4, 4), from the base's origin and axes, as a case states them in its own space.

    Raises InputError: the axes are parallel or zero, or not at a right angle, or the position looks like metres.
    """
    x, z = (to_lps(np.asarray([v], dtype=float), space)[0] for v in (mount.x_axis, mount.z_axis))
    lengths = np.linalg.norm(x), np.linalg.norm(z)
    if min(lengths) == 0 or abs(x @ z) > AXES_PARALLEL * lengths[0] * lengths[1]:
        refuse(f"{key}: x_axis and z_axis are parallel or zero", path, "two axes", "axes_parallel")
    angle = float(np.degrees(np.arccos(x @ z / (lengths[0] * lengths[1]))))
    if abs(angle - 90.0) > AXES_SQUARE_DEG:
        allowed = f"a right angle, to {AXES_SQUARE_DEG:g} degree"
        refuse(f"{key}: x_axis and z_axis are {angle:.1f} degrees apart", path, allowed, "axes_not_square")
    far = float(np.linalg.norm(mount.position_mm))
    if 0.0 < far < LIKE_METRES:
        what = f"{key}: position_mm is {far:g} mm from the origin: the base would be in the patient"
        refuse(what, path, "millimetres (these look like metres)", "wrong_unit")
    T_ct_base = pose(frame_of_axes(z, x), to_lps(np.asarray([mount.position_mm]), space)[0])
    return read_only(np.linalg.inv(T_ct_base))


def axes_frame(z: Axis, x: Axis, space: Space, path: Path, key: str) -> Floats:
    """R_ct_frame, shape (3, 3), of a frame whose z axis is given and whose x axis is what of ``x`` is square to it.

    Raises InputError: the two are parallel or zero; names ``key``.
    """
    try:
        return entry_frame(tables.EntryAxes(z=z, x=x), space, where=path)
    except InputError as error:
        raise InputError(f"{key} are parallel or zero", where=path, allowed="two axes", code="axes_parallel") from error


URDF_ROLE, MESH_ROLE = "urdf", "urdf mesh"
"""Roles of the files that define an arm, among the inputs of a case."""


def robot_of(content: CaseFile, space: Space, path: Path, files: InputFiles) -> RobotSettings:
    """The arm with its home, its speeds, and where it is, as far as mount or transform say so; its files become inputs.

    Raises InputError: an arm, a mount or a transform that cannot be used.
    """
    robot, stated, model = content.robot, content.registration, arm_of(content.robot, files, path)
    home = None if robot.home_deg is None else read_only(np.radians(np.asarray(robot.home_deg)))
    mount = None if robot.mount is None else mount_pose(robot.mount, space, path)
    speeds = SpeedLimits(*(getattr(robot, name) for name in SpeedLimits._fields))
    if stated is None or stated.transform is None:
        return RobotSettings(model, home, mount, speeds=speeds)
    T_file = itk_transform.parse_transform(files.content(stated.transform), path.parent / stated.transform)
    return RobotSettings(model, home, read_only(tables.stated_base_ct(stated, T_file)), stated, speeds)


def arm_of(section: tables.RobotSection, files: InputFiles, path: Path) -> UrModel:
    """The arm's model; each file that decides it becomes an input of the case."""
    stated = stated_limits(section.limits)
    if section.urdf is None:
        model = ur_model(section.model)
    else:
        data = files.read(URDF_ROLE, section.urdf, max_bytes=MOST_BYTES, key="robot.urdf", where=path)
        read = partial(_mesh, urdf=section.urdf, files=files, path=path)
        model = own_arm(data, path.parent / section.urdf, flange=section.flange, read=read, stated=stated)
    if section.limits is None:
        return model
    known = JointLimits(model.joint_limits, model.max_speeds, model.max_torques)
    limits = narrowed(known, stated, f"{path}: robot.limits")
    return replace(model, joint_limits=limits.angles, max_speeds=limits.speeds)


def _mesh(address: str, *, urdf: str, files: InputFiles, path: Path) -> bytes:
    if "://" in address or PurePosixPath(address).is_absolute():
        allowed = "paths relative to the URDF's folder, such as meshes/base.stl"
        refuse(f"robot.urdf: mesh '{address}' is not a path next to the URDF", path, allowed, "outside_folder")
    name = str(PurePosixPath(urdf).parent / address)
    return files.read(MESH_ROLE, name, max_bytes=meshes.MAX_FILE_BYTES, key=f"robot.urdf: mesh '{address}'", where=path)


def stated_limits(section: tables.LimitsSection | None) -> StatedLimits:
    """The limits in radians; nothing where the case states none."""
    if section is None:
        return NOTHING_STATED
    angles = None
    if section.lowest_deg is not None:
        angles = np.radians(np.stack([section.lowest_deg, section.highest_deg or ()], axis=1))
    return StatedLimits(angles, None if section.max_speed_deg_s is None else np.radians(section.max_speed_deg_s))


def tool_of(section: tables.ToolSection | None, files: InputFiles, path: Path) -> ToolBody | None:
    """The tool's body, turned about the flange's x, y and z, in this order, then moved; its file becomes an input.

    Raises InputError: a file that cannot be used, or a unit that is not known.
    """
    if section is None:
        return None
    unit, file = parse_unit(section.unit, where=f"{path}: tool.unit"), path.parent / section.mesh
    data = files.read(TOOL_ROLE, section.mesh, max_bytes=meshes.MAX_FILE_BYTES, key="tool.mesh", where=path)
    R = scipy.spatial.transform.Rotation.from_euler("xyz", section.rotation_deg, degrees=True).as_matrix()
    T = pose(R, np.array(section.position_mm))
    mesh = meshes.parse_mesh(data, file, unit=unit, space=Space.LOCAL, up=section.up).transformed(T)
    return ToolBody(mesh, file, unit.mm, T, f"{path}: tool")


ROBOT_NOWHERE = (
    "the case states a robot ({robot}) but not the position of its base: the arm is not checked ([registration] or "
    "[robot.mount] places it)"
)


def robot_warnings(content: CaseFile, robot: RobotSettings) -> tuple[str, ...]:
    """Warning of a case that does not say where a robot is: no verdict includes one."""
    located = content.registration is not None or content.robot.mount is not None
    nowhere = not located and bool({"robot", "tool"} & content.model_fields_set)
    return (ROBOT_NOWHERE.format(robot=robot.model.name),) if nowhere else ()


SAME_MM = 0.03
"""Greatest difference of ``diameter_mm`` from its gauge: twice the usual tolerance of the chart."""


def bending_of(
    needle: tables.NeedleSection, tissue: Mapping[str, tables.TissueSection], where: str | Path
) -> Bending | None:
    """The bending of a case's needle; None where it declares no tissue.

    Raises InputError: half of what is needed, an unknown gauge, or one that is not the needle's diameter.
    """
    stated = [key for key in ("gauge", "solid", "bevel_deg", "modulus_gpa") if getattr(needle, key) is not None]
    if not tissue:
        if stated:
            message = f"needle.{stated[0]}: the bending depends on the tissue, and there is no [tissue]"
            refuse(message, where, "[tissue.PATTERN] for each pattern of names; or omit this key", "no_tissue")
        return None
    if needle.bevel_deg is None:
        refuse("[tissue] needs needle.bevel_deg", where, "degrees; 0 for a symmetric tip", "no_bevel")
    if REST not in tissue:
        message = f'[tissue."{REST}"] is missing: there is tissue between the structures too'
        refuse(message, where, f'a table for "{REST}", the rest of the body', "no_tissue")
    tissues = {pattern: Tissue(**section.model_dump()) for pattern, section in tissue.items()}
    return Bending(_shaft(needle, where), float(np.radians(needle.bevel_deg)), ByName(tissues))


def _shaft(needle: tables.NeedleSection, where: str | Path) -> Shaft:
    modulus = STEEL_GPA if needle.modulus_gpa is None else needle.modulus_gpa
    if needle.gauge is None:
        return Shaft(needle.shaft_mm, needle.diameter_mm, 0.0, modulus)
    if needle.gauge not in GAUGES:
        what = f"needle.gauge {needle.gauge} is not in the chart"
        refuse(what, where, f"{min(GAUGES)} to {max(GAUGES)}", "unknown_gauge")
    gauge = GAUGES[needle.gauge]
    if abs(gauge.outer_mm - needle.diameter_mm) > SAME_MM:
        stated = f"diameter_mm is {needle.diameter_mm:g}"
        what = f"needle.gauge {needle.gauge} is {gauge.outer_mm:g} mm wide, but {stated}"
        refuse(what, where, f"diameter_mm within {SAME_MM:g} of the gauge's", "gauge_contradicted")
    return Shaft(needle.shaft_mm, gauge.outer_mm, 0.0 if needle.solid else gauge.inner_mm, modulus)


def breathing_of(section: tables.BreathingSection | None, space: Space, where: str | Path) -> Breathing | None:
    """The breathing of a case; None where it declares none.

    Raises InputError: a direction without length, or an anatomical one in a space that knows no patient.
    """
    if section is None:
        return None
    if isinstance(section.direction, str) and space is Space.LOCAL:
        message = f'breathing.direction: space "local" has no {section.direction}'
        refuse(message, where, "direction = [x, y, z]", "local_space")
    vector = lps_axis(section.direction, space)
    length = float(np.linalg.norm(vector))
    if length == 0:
        refuse("breathing.direction is zero", where, "a direction of any length", "zero_direction")
    stated = section.model_dump(exclude={"direction", "weights"})
    return Breathing(direction_ct=vector / length, weights=ByName(section.weights), **stated)
