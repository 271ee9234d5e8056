"""The TOML schema, version 1, of a servo case, and the case read from it. See docs/reference/servo-case.md."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, Strict, model_validator

from puncture_twin.planning.arm.ur import UrModel, ur_model
from puncture_twin.planning.base.errors import SchemaError, refuse
from puncture_twin.planning.base.provenance import CASE_ROLE, Input, InputFiles
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.base.toml_file import SchemaOne, find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.case.tables import Coordinate, Length, Name, Number, Section, Vector
from puncture_twin.planning.formats import points
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.formats.meshes.mesh_files import parse_mesh
from puncture_twin.planning.formats.points import NamedPoints, parse_points
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, Unit
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.twin.guidance.stereo.declared_errors import ServoErrors, ServoRehearsalSection

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
    """A servo case, read and checked.

    Attributes:
        skin: The head's surface, image frame, mm.
        markers: The markers' centres, image frame, in truth.
        targets: The targets, image frame, in truth.
        inputs: Every file, with role and hash.
    """

    path: Path
    file: ServoFile
    model: UrModel
    skin: TriangleMesh
    markers: NamedPoints
    targets: NamedPoints
    inputs: tuple[Input, ...]

    @property
    def name(self) -> str:
        """The case's name."""
        return self.file.name

    @property
    def hough_only(self) -> bool:
        """Whether a ball's centre is that of the paper's method."""
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
