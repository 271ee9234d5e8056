"""A servo case: its TOML schema, version 1, and the workcell as it plans it. See docs/reference/servo-case.md.

Declared errors say what may be off, and by how much: the belief computes with them, the twin's truth is drawn from
them. What is not declared (a rod that bends, cameras that move after the calibration, tissue) is not modelled, which is
something else than 0.

Two frames matter: the base's, in which the arm is commanded, and C, which the measuring arm defines at the calibration
and in which the cameras are known. How C lies in the base only a calibration tells.
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, Strict, model_validator
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel, ur_model
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import SchemaError, refuse
from puncture_twin.planning.base.provenance import CASE_ROLE, Input, InputFiles
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.base.toml_file import SchemaOne, find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.case.errors import ARM_KINDS, ArmErrors
from puncture_twin.planning.case.tables import Coordinate, Length, Name, Number, Section, Vector
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.formats import points
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.formats.meshes.mesh_files import parse_mesh
from puncture_twin.planning.formats.points import NamedPoints, parse_points
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import frame_yz, pose
from puncture_twin.planning.geometry.spaces import Space, Unit
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.twin.guidance.stereo.camera import Camera, stereo_pair
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod, rod_orientation

Millimetres = Annotated[Number, Field(ge=0, le=50)]
SmallAngle = Annotated[Number, Field(ge=0, le=10)]
PixelDeviation = Annotated[Number, Field(ge=0, le=200)]
DetectionDeviation = Annotated[Number, Field(ge=1e-4, le=50)]
Part = Annotated[Number, Field(ge=0, le=0.2)]
"""A fraction, 0 to 1."""
DEFAULT_MEASURING_MM = 0.01
"""Deviation of a coordinate measuring arm."""
DEFAULT_MARKER_MM = 0.3
"""Deviation of a marker's centre in an image with voxels of a millimetre: 1 / sqrt(12)."""


class ServoErrors(ArmErrors):
    """Standard deviations per axis."""

    arm: Literal["calibrated", "nominal"] = "calibrated"
    """Whose numbers link, twist and joint take where none are stated."""
    gear_deg: SmallAngle = 0.0
    """Amplitude of each gear's error, a sine over its joint."""
    gear_cycles: Annotated[int, Strict(), Field(ge=1, le=1000)] = 200
    """Periods of that sine per turn of the joint: 200 of a harmonic drive of 1:100, twice a turn of its motor (Tuttle,
    "Understanding and modeling the behavior of a harmonic drive gear transmission", MIT AITR-1365, 1992)."""
    ball_offset_mm: Millimetres = 0.3
    """Of the ball's centre against where the controller has it on the flange; the cameras see it."""
    tip_offset_mm: Millimetres = 0.3
    """Of the needle's tip against the ball's centre, flange axes; no camera sees it."""
    needle_direction_deg: SmallAngle = 0.2
    """Of the needle, about each of the flange's x and y axes."""
    camera_turn_deg: SmallAngle = 0.23
    camera_shift_mm: Millimetres = 3.0
    camera_axis_px: PixelDeviation = 8.0
    camera_focal: Part = 0.01
    """Of the focal length, as a part of it; ``lens`` of k1, k2, p1, p2."""
    lens: tuple[Part, Part, Part, Part] = (0.02, 0.02, 0.0005, 0.0005)
    ball_px: DetectionDeviation | None = None
    """Of the centre of a ball or marker in one look; None takes what the tracker states of each image."""
    measuring_arm_mm: Millimetres = DEFAULT_MEASURING_MM
    marker_mm: Millimetres = DEFAULT_MARKER_MM
    target_mm: Millimetres = DEFAULT_MARKER_MM
    """Of the target in the image; as a marker where it is not stated."""
    head_shift_mm: Millimetres = 0.0
    """By which the head moves after its markers were seen; it turns about their middle."""
    head_turn_deg: SmallAngle = 0.0

    @model_validator(mode="before")
    @classmethod
    def _as_kind_and_marker(cls, stated: Any) -> Any:
        if not isinstance(stated, dict):
            return stated
        kind = ARM_KINDS["nominal" if stated.get("arm") == "nominal" else "calibrated"]
        return {**kind._asdict(), "target_mm": stated.get("marker_mm", DEFAULT_MARKER_MM), **stated}

    @property
    def needle_direction(self) -> float:
        """Of the needle, rad."""
        return float(np.radians(self.needle_direction_deg))

    @property
    def camera_turn(self) -> float:
        """Of each camera about each axis, rad."""
        return float(np.radians(self.camera_turn_deg))

    @property
    def head_turn(self) -> float:
        """Of the head after its markers were seen, rad."""
        return float(np.radians(self.head_turn_deg))

    @property
    def arrival(self) -> float:
        """Deviation of every joint at one arrival, rad.

        Play leaves a joint at either edge, so half of it counts. A gear's error is a sine of the joint, of which no two
        arrivals have the same phase: it is as good as drawn anew.
        """
        return float(np.linalg.norm([self.repeatability, self.backlash / 2, np.radians(self.gear_deg) / np.sqrt(2.0)]))

    def arm_deviations(self) -> Floats:
        """Deviations of the 26 parameters that move the ball, shape (26,), ordered as `error_jacobian`; mm, rad."""
        return np.repeat([self.link_mm, self.twist, self.joint, self.ball_offset_mm], [11, 6, 6, 3])

    def camera_deviations(self) -> Floats:
        """Deviations of a camera's 13 parameters: focal length (part), axis (px), lens, rotation (rad), shift (mm)."""
        lens, axes = (self.camera_focal, *[self.camera_axis_px] * 2, *self.lens), [self.camera_turn] * 3
        return np.array([*lens, *axes, *[self.camera_shift_mm] * 3])

    def stated(self) -> dict[str, Any]:
        """The deviations by the keys of ``[errors]``, mm, degrees and px."""
        return self.model_dump(exclude={"arm"})


class ServoRehearsalSection(Section):
    """Errors from which a workcell's truth is drawn, where they are not those that the belief declares."""

    errors: ServoErrors | None = None


CASE_NAME = "servo.toml"
ALLOWED_CASE = "a TOML servo case with schema = 1, or a folder with servo.toml"
Pixels = Annotated[int, Strict(), Field(ge=64, le=8192)]
Count = Annotated[int, Strict(), Field(ge=1, le=1000)]
Degrees = Annotated[Number, Field(ge=-90, le=90)]
Coefficient = Annotated[Number, Field(ge=-2, le=2)]


class CamerasSection(Section):
    """Two cameras side by side that look at the middle of the calibrated volume."""

    size_px: tuple[Pixels, Pixels] = (1280, 960)
    focal_px: Annotated[Number, Field(ge=50, le=50_000)] = 2560.0
    baseline_mm: Annotated[Number, Field(ge=10, le=5000)] = 500.0
    distance_mm: Annotated[Number, Field(ge=100, le=10_000)] = 1000.0
    elevation_deg: Degrees = 45.0
    distortion: tuple[Coefficient, Coefficient, Coefficient, Coefficient] = (-0.1, 0.02, 0.0005, -0.0005)
    model_distortion: Annotated[bool, Strict()] = True
    noise_grey: Annotated[Number, Field(ge=0, le=100)] = 2.0
    blur_px: Annotated[Number, Field(ge=0, le=20)] = 0.7
    light: Literal["diffuse", "lamp"] = "diffuse"
    occlusion: Annotated[Number, Field(ge=0, le=0.9)] = 0.0
    centre: Literal["edges", "hough"] = "edges"


class ServoRobotSection(Section):
    """The arm."""

    model: Name = "ur3"


class ToolSection(Section):
    """A rod along the flange's z axis with a ball at its end; ``rod_mm`` runs from the flange to the ball's centre."""

    ball_diameter_mm: Annotated[Number, Field(ge=1, le=100)] = 8.0
    rod_mm: Annotated[Number, Field(ge=30, le=500)] = 160.0
    rod_diameter_mm: Annotated[Number, Field(ge=0.5, le=50)] = 3.0
    holder_mm: Annotated[Number, Field(ge=1, le=400)] = 40.0
    holder_diameter_mm: Annotated[Number, Field(ge=1, le=200)] = 30.0
    tilt_deg: Annotated[Number, Field(ge=-60, le=60)] = 10.0

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.holder_mm >= self.rod_mm:
            what = f"holder_mm {self.holder_mm:g} is not shorter than rod_mm {self.rod_mm:g}"
            raise SchemaError(what, "out_of_range")
        if self.rod_diameter_mm >= self.ball_diameter_mm:
            what = f"rod_diameter_mm {self.rod_diameter_mm:g} hides a ball of {self.ball_diameter_mm:g} mm"
            raise SchemaError(what, "out_of_range")
        return self


class CalibrationSection(Section):
    """The robot's points: a 3 x 2 x 2 grid along the base's axes, about a centre; rod tilted as at the targets.

    With another ``tilt_deg`` the arm's errors at the targets are not those of the calibration.
    """

    center_mm: Vector
    size_mm: tuple[Length, Length, Length] = (160.0, 120.0, 120.0)
    tilt_deg: Annotated[Number, Field(ge=-60, le=60)] | None = None


class HeadSection(Section):
    """The head: its surface and its points in the image frame, and where it is; z up, face to the cameras."""

    mesh: str
    unit: Literal["mm", "cm", "m"]
    markers: str
    targets: str
    position_mm: Vector
    yaw_deg: Annotated[Number, Field(ge=-360, le=360)] = 0.0
    marker_diameter_mm: Annotated[Number, Field(ge=1, le=100)] = 8.0


class ServoTargetSection(Section):
    """When a needle hits: the distance from a target within which its tip ends."""

    hit_radius_mm: Annotated[Number, Field(gt=0, le=100)] | None = None


class ServoSection(Section):
    """The loop's limits."""

    tolerance_mm: Annotated[Number, Field(ge=0.001, le=20)] = 0.1
    estimate: Literal["chain", "joint"] = "chain"
    max_steps: Count = 10
    frames: Annotated[int, Strict(), Field(ge=1, le=100)] = 1
    looks: Annotated[int, Strict(), Field(ge=1, le=20)] = 3
    search_px: Annotated[Number, Field(ge=4, le=1000)] = 48.0
    max_step_mm: Annotated[Number, Field(ge=0.1, le=200)] = 10.0
    max_joint_step_deg: Annotated[Number, Field(ge=0.01, le=90)] = 10.0
    max_drift_deg: Annotated[Number, Field(ge=0, le=45)] = 1.0
    joints: Literal[5, 6] = 6
    hover_mm: Annotated[Number, Field(ge=5, le=300)] = 70.0
    padding_mm: Annotated[Number, Field(ge=1, le=50)] = 2.0


class BoxSection(Section):
    """A box in the workcell, axes parallel to the base's."""

    name: Name
    center_mm: tuple[Coordinate, Coordinate, Coordinate]
    size_mm: tuple[Length, Length, Length]


class ServoFile(Section):
    """The whole file."""

    schema_: SchemaOne = Field(alias="schema")
    name: Name
    seed: Annotated[int, Strict(), Field(ge=0, lt=2**31)] = 0
    cameras: CamerasSection = CamerasSection()
    robot: ServoRobotSection = ServoRobotSection()
    tool: ToolSection = ToolSection()
    calibration: CalibrationSection
    head: HeadSection
    target: ServoTargetSection = ServoTargetSection()
    servo: ServoSection = ServoSection()
    errors: ServoErrors = ServoErrors()
    rehearsal: ServoRehearsalSection = ServoRehearsalSection()
    box: tuple[BoxSection, ...] = ()

    @model_validator(mode="after")
    def _belief_is_declared(self) -> Self:
        if "errors" not in self.model_fields_set and self.rehearsal.errors is not None:
            what = "[rehearsal.errors] is a ground truth that differs from [errors], and [errors] is missing"
            raise SchemaError(what, "missing_errors")
        return self


@dataclass(frozen=True, eq=False)
class ServoCase:
    """A servo case, read and checked."""

    path: Path
    file: ServoFile
    model: UrModel
    skin: TriangleMesh  # the head's surface, image frame, mm
    markers: NamedPoints  # their centres in truth, image frame, mm
    targets: NamedPoints  # likewise
    inputs: tuple[Input, ...]

    @property
    def name(self) -> str:
        """The case's name."""
        return self.file.name

    @property
    def hough_only(self) -> bool:
        """True where a ball's centre is that of the paper's method."""
        return self.file.cameras.centre == "hough"

    @property
    def errors(self) -> ServoErrors:
        """The declared errors: all that guidance believes of errors."""
        return self.file.errors

    @property
    def truth_errors(self) -> ServoErrors:
        """Errors from which the truth is drawn: the declared ones, unless ``[rehearsal.errors]`` states others."""
        return self.file.rehearsal.errors or self.errors

    @property
    def wrong_belief(self) -> bool:
        """Whether the truth is drawn from other errors than the belief declares, on purpose."""
        return self.file.rehearsal.errors is not None


def load_servo_case(path: Path | str) -> ServoCase:
    """Read a servo case, or a folder that holds ``servo.toml``.

    Raises:
        InputError: Anything unreadable, unknown, missing or contradictory; names the key.
    """
    path = find_toml(path, CASE_NAME)
    files = InputFiles(path.parent)
    stated = files.add(CASE_ROLE, path.name, read_toml_bytes(path, ALLOWED_CASE))
    file = parse_toml(stated, path, ServoFile, allowed=ALLOWED_CASE, keys="docs/reference/servo-case.md")
    model = ur_model(file.robot.model)
    surface = _read(files, file.head, "mesh", meshes.MAX_FILE_BYTES, path)
    named = {key: _read(files, file.head, key, points.MAX_FILE_BYTES, path) for key in ("markers", "targets")}
    skin = parse_mesh(surface, path.parent / file.head.mesh, unit=Unit(file.head.unit), space=Space.LOCAL)
    markers = parse_points(named["markers"], path.parent / file.head.markers, default_space=Space.LOCAL)
    targets = parse_points(named["targets"], path.parent / file.head.targets, default_space=Space.LOCAL)
    if len(markers.names) < MIN_MARKERS:
        refuse(f"head.markers: {plural(len(markers.names), 'marker')}", path, "3 or more", "too_few_markers")
    return ServoCase(path, file, model, skin, markers, targets, files.inputs)


def _read(files: InputFiles, head: HeadSection, role: str, max_bytes: int, path: Path) -> bytes:
    return files.read(role, getattr(head, role), max_bytes=max_bytes, key=f"head.{role}", where=path)


GRID = (3, 2, 2)
"""Points of the calibration along the base's x, y and z."""


def planned_cameras(case: ServoCase) -> tuple[Camera, ...]:
    """The cameras as the case plans them; only a calibration tells where they are."""
    plan = case.file.cameras
    return stereo_pair(*plan.size_px, plan.focal_px, plan.baseline_mm, plan.distance_mm, plan.distortion)


def calibration_frame(case: ServoCase) -> Floats:
    """T_base_c, shape (4, 4), mm: C at the calibrated volume's middle, z along the cameras' view, y down."""
    # the cameras are on the far side of the head, seen from the arm, and look back and down at it
    down = np.radians(case.file.cameras.elevation_deg)
    z, y = np.array([-np.cos(down), 0.0, -np.sin(down)]), np.array([np.sin(down), 0.0, -np.cos(down)])
    return pose(frame_yz(y, z), case.file.calibration.center_mm)


def head_pose(case: ServoCase) -> Floats:
    """T_base_m, shape (4, 4), mm: the head's z up, its face (-y) along the base's x at yaw 0."""
    head = case.file.head
    return pose(Rotation.from_euler("z", 90.0 + head.yaw_deg, degrees=True).as_matrix(), head.position_mm)


def workcell_checker(case: ServoCase, T_base_m: Floats | None) -> FastChecker:
    """The planner's collision checker; T_base_m (4, 4), mm: where the head is believed to be, None without it."""
    boxes = [Box(box.name, pose(np.eye(3), box.center_mm), box.size_mm) for box in case.file.box]
    skin, tool = None if T_base_m is None else case.skin.transformed(T_base_m), case.file.tool
    length = tool.rod_mm + tool.ball_diameter_mm / 2  # to the ball's far side, as thick as it
    rod = Tool(length, length - tool.holder_mm, tool.ball_diameter_mm, tool.holder_diameter_mm)
    return FastChecker(case.model, rod, boxes, skin, padding_mm=case.file.servo.padding_mm)


def carried_rod(case: ServoCase) -> CarriedRod:
    """The nominal arm with the case's rod, in the orientation of the targets."""
    tool = case.file.tool
    return CarriedRod(case.model, tool.rod_mm, rod_orientation(float(np.radians(tool.tilt_deg))))


def calibrating_rod(case: ServoCase) -> CarriedRod:
    """The nominal arm with the case's rod, in the orientation of the calibration."""
    tilt = case.file.calibration.tilt_deg
    rod = carried_rod(case)
    return rod if tilt is None else rod._replace(R_base_flange=rod_orientation(float(np.radians(tilt))))


def grid_points(case: ServoCase) -> Floats:
    """The calibration's points, base frame, shape (12, 3), mm: neighbours in the order of the arm's path."""
    cal = case.file.calibration
    steps = np.array(list(product(*(np.linspace(-0.5, 0.5, count) for count in GRID))))
    return np.asarray(cal.center_mm + steps * cal.size_mm)
