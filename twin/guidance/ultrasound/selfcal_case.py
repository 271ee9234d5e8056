"""TOML schema of a self-calibration case, version 1, key by key. See docs/reference/selfcal-case.md."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, Strict, field_validator, model_validator
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.ur import UrModel, ur_model
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import SchemaError
from puncture_twin.planning.base.provenance import CASE_ROLE, Input, content_input
from puncture_twin.planning.base.toml_file import SchemaOne, find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.case.errors import ArmErrors
from puncture_twin.planning.case.tables import Length, Name, Number, Section, Sextuple, Vector
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArm, DeclaredArms
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise
from puncture_twin.twin.guidance.ultrasound.needle_detector import Imager, NeedleEcho

CASE_NAME = "selfcal.toml"
"""What a folder is searched for."""
ALLOWED_CASE = "a TOML self-calibration case with schema = 1, or a folder with selfcal.toml"
ARMS_WITH_MESHES = ("ur3", "ur5", "ur10")
"""Collision needs link meshes, and these ship."""
Deviation = Annotated[Number, Field(ge=0, le=100)]
"""A standard deviation."""
Degrees = Annotated[Number, Field(ge=-180, le=180)]
Steep = Annotated[Number, Field(ge=5, le=85)]
Count = Annotated[int, Strict(), Field(ge=1, le=5000)]
Tool = Annotated[Number, Field(ge=20, le=1000)]
Thickness = Annotated[Number, Field(ge=0.1, le=200)]


class ArmSection(Section):
    """One of the two arms."""

    model: str = "ur3"
    home_deg: Sextuple = (0.0, -90.0, 90.0, -90.0, -90.0, 0.0)
    errors: ArmErrors = ArmErrors()

    @field_validator("model")
    @classmethod
    def _has_meshes(cls, value: str) -> str:
        if value not in ARMS_WITH_MESHES:
            what = f"model '{value}'; collision needs link meshes, which ship for {ARMS_WITH_MESHES}"
            raise SchemaError(what, "unknown_robot")
        return value


class NeedleArmSection(ArmSection):
    """The needle's arm, and the pose of its base in the frame of the probe's arm, both upright."""

    position_mm: Vector = (800.0, 0.0, 0.0)
    yaw_deg: Degrees = 180.0


class ProbeSection(Section):
    """The probe: a round handle along the flange's z axis, and a flat head whose end is the face."""

    length_mm: Tool = 150.0
    handle_diameter_mm: Thickness = 40.0
    head_mm: tuple[Thickness, Thickness, Thickness] = (58.0, 30.0, 20.0)
    yaw_deg: Degrees = 35.0

    @model_validator(mode="after")
    def _head_fits(self) -> Self:
        if self.head_mm[1] >= self.length_mm:
            what = f"head_mm {self.head_mm[1]:g} along the probe is not shorter than length_mm"
            raise SchemaError(what, "out_of_range")
        return self


class SelfcalNeedleSection(Section):
    """The needle along its flange's z axis; what lies between shaft and flange is the holder."""

    length_mm: Tool = 210.0
    shaft_mm: Tool = 150.0
    diameter_mm: Thickness = 1.2
    holder_diameter_mm: Thickness = 30.0

    @model_validator(mode="after")
    def _shaft_fits(self) -> Self:
        if self.shaft_mm > self.length_mm:
            raise SchemaError(f"shaft_mm {self.shaft_mm:g} is longer than length_mm {self.length_mm:g}", "out_of_range")
        return self


class PhantomSection(Section):
    """A block of tissue on the table, between the arms; frame of the probe's arm."""

    top_mm: Vector = (330.0, 0.0, 150.0)
    size_mm: tuple[Length, Length, Length] = (160.0, 160.0, 100.0)
    round_mm: Annotated[Number, Field(ge=1, le=50)] = 15.0
    gel_mm: Annotated[Number, Field(ge=0.5, le=50)] = 2.0

    @model_validator(mode="after")
    def _corners_fit(self) -> Self:
        if 2 * self.round_mm >= min(self.size_mm):
            raise SchemaError(f"round_mm {self.round_mm:g} leaves nothing of size_mm {self.size_mm}", "out_of_range")
        return self


class ImageSection(Section):
    """The ultrasound machine, and the needle's echo."""

    pixel_mm: Annotated[Number, Field(ge=0.05, le=1)] = 0.2
    slice_fwhm_mm: Annotated[Number, Field(ge=0.2, le=10)] = 1.2
    contrast_db: Annotated[Number, Field(ge=0, le=60)] = 28.0

    def imager(self) -> Imager:
        """Probe and machine: 50 x 60 mm."""
        columns, rows = round(50.0 / self.pixel_mm), round(60.0 / self.pixel_mm)
        return Imager(columns=columns, rows=rows, pixel_mm=self.pixel_mm, slice_fwhm_mm=self.slice_fwhm_mm)

    def echo(self) -> NeedleEcho:
        """The needle's echo."""
        return NeedleEcho(contrast_db=self.contrast_db)


class PosesSection(Section):
    """Bounds of the poses that are chosen, and how they are chosen."""

    samples: Annotated[int, Strict(), Field(ge=20, le=100_000)] = 600
    count: Annotated[int, Strict(), Field(ge=16, le=2000)] = 30
    choose: Literal["information", "random"] = "information"
    tilt_deg: Annotated[Number, Field(ge=1, le=60)] = 25.0
    yaw_deg: Annotated[Number, Field(ge=1, le=180)] = 50.0
    insertion_deg: tuple[Steep, Steep] = (20.0, 75.0)
    clearance_mm: Annotated[Number, Field(ge=0, le=50)] = 4.0

    @model_validator(mode="after")
    def _insertion_ascends(self) -> Self:
        if self.insertion_deg[0] >= self.insertion_deg[1]:
            what = f"insertion_deg {list(self.insertion_deg)} does not ascend; it is [lowest, highest]"
            raise SchemaError(what, "range_descends")
        return self


class TruthSection(Section):
    """Deviations of the truth from the drawing and of the operator, per axis."""

    mount_mm: Deviation = 3.0
    mount_deg: Deviation = 0.5
    tip_mm: Deviation = 1.5
    length_mm: Deviation = 0.2
    needle_deg: Deviation = 0.5
    off_plane_mm: Deviation = 0.15
    lean_deg: Deviation = 0.5
    click_mm: Deviation = 0.3


class NoiseSection(Section):
    """Noise stated to the calibration; without it, the residuals' spread is estimated."""

    robot_mm: Annotated[Number, Field(ge=0, le=100)]
    robot_deg: Annotated[Number, Field(ge=0, le=10)]
    image_mm: Annotated[Number, Field(gt=0, le=100)]
    direction_deg: Annotated[Number, Field(gt=0, le=45)]
    off_plane_mm: Deviation = 0.0

    @model_validator(mode="after")
    def _across_the_image(self) -> Self:
        if self.robot_mm == 0.0 and self.off_plane_mm == 0.0:
            what = "noise: robot_mm and off_plane_mm are both 0; no measurement across the image is exact"
            raise SchemaError(what, "not_positive")
        return self

    def noise(self) -> Noise:
        """The stated noise in mm and rad."""
        robot_rad, direction_rad = np.radians([self.robot_deg, self.direction_deg]).tolist()
        return Noise(self.robot_mm, robot_rad, self.image_mm, direction_rad, self.off_plane_mm)


class SelfcalFile(Section):
    """Schema of the whole file."""

    schema_: SchemaOne = Field(alias="schema")
    name: Name
    seed: Annotated[int, Strict(), Field(ge=0, lt=2**31)] = 0
    hold_needle_length: Annotated[bool, Strict()] = False
    probe_arm: ArmSection = ArmSection()
    needle_arm: NeedleArmSection = NeedleArmSection()
    probe: ProbeSection = ProbeSection()
    needle: SelfcalNeedleSection = SelfcalNeedleSection()
    phantom: PhantomSection = PhantomSection()
    image: ImageSection = ImageSection()
    poses: PosesSection = PosesSection()
    truth: TruthSection = TruthSection()
    noise: NoiseSection | None = None

    @model_validator(mode="after")
    def _phantom_on_table(self) -> Self:
        if self.phantom.top_mm[2] - self.phantom.size_mm[2] < 0.0:
            what = "phantom: its lower side (top_mm minus size_mm) is below the table at z = 0"
            raise SchemaError(what, "out_of_range")
        return self


@dataclass(frozen=True, eq=False)
class SelfcalCase:
    """A validated case; its drawing is in mm."""

    path: Path
    content: SelfcalFile
    inputs: tuple[Input, ...]  # its file with role and hash
    models: tuple[UrModel, UrModel] = field(init=False)  # the probe's first
    T_end1_image: Floats = field(init=False)  # X: the face's middle on the flange's z axis, the depth along it
    T_base1_base2: Floats = field(init=False)  # Y
    tip_end2: Floats = field(init=False)  # shape (3,)

    @property
    def declared_arms(self) -> DeclaredArms:
        """Declared errors of both arms."""
        arms = (self.content.probe_arm, self.content.needle_arm)
        return DeclaredArms(*(DeclaredArm(model, arm.errors) for arm, model in zip(arms, self.models, strict=True)))

    def __post_init__(self) -> None:
        content, (width, _) = self.content, self.content.image.imager().size_mm
        models = ur_model(content.probe_arm.model), ur_model(content.needle_arm.model)
        object.__setattr__(self, "models", models)
        probe, arm = content.probe, content.needle_arm
        c, s = np.cos(np.radians(probe.yaw_deg)), np.sin(np.radians(probe.yaw_deg))
        R = np.array([[c, 0.0, s], [s, 0.0, -c], [0.0, 1.0, 0.0]])
        R_base1_base2 = Rotation.from_euler("z", arm.yaw_deg, degrees=True).as_matrix()
        drawn = {
            "T_end1_image": pose(R, [0.0, 0.0, probe.length_mm] - 0.5 * width * R[:, 0]),
            "T_base1_base2": pose(R_base1_base2, arm.position_mm),
            "tip_end2": np.array([0.0, 0.0, content.needle.length_mm]),
        }
        for name, value in drawn.items():
            object.__setattr__(self, name, read_only(value))


def load_selfcal_case(path: Path | str) -> SelfcalCase:
    """Read and validate a case file, or a folder that holds ``selfcal.toml``.

    Raises:
        InputError: Anything unreadable, unknown, missing or contradictory; names the key.
    """
    path = find_toml(path, CASE_NAME)
    stated = read_toml_bytes(path, ALLOWED_CASE)
    content = parse_toml(stated, path, SelfcalFile, allowed=ALLOWED_CASE, keys="docs/reference/selfcal-case.md")
    return SelfcalCase(path, content, (content_input(CASE_ROLE, path.name, stated),))
