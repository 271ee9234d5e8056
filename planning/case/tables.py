"""The tables of a case file: numbers with bounds, names, and a section for each table; mm and degrees.

See docs/reference/case.md for the keys.
"""

import difflib
import re
import unicodedata
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, StringConstraints, model_validator

from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS as USUAL, HIGHEST
from puncture_twin.planning.arm.urdf.arm_urdf import FLANGE
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import SchemaError
from puncture_twin.planning.base.text import MAX_NAME
from puncture_twin.planning.formats.points import plainly_radians
from puncture_twin.planning.geometry.rigid import inverse, pose
from puncture_twin.planning.geometry.spaces import Up


def _plain_name(value: str) -> str:
    if not re.fullmatch(r"[^\W_]([\w .\-]*[\w.\-])?", unicodedata.normalize("NFC", value)):
        raise SchemaError("must be letters, digits, spaces and . _ -, a letter or digit first", "bad_name")
    return value


def _degrees(value: tuple[float, ...]) -> tuple[float, ...]:
    if plainly_radians(value):
        raise SchemaError(f"all six are within {max(map(abs, value)):g} of zero: not in degrees?", "wrong_unit")
    return value


Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Coordinate = Annotated[Number, Field(ge=-100_000, le=100_000)]
Length = Annotated[Number, Field(gt=0, le=100_000)]
Margin = Annotated[Number, Field(ge=0, le=1000)]
Weight = Annotated[Number, Field(ge=0, le=1000)]
JointDegrees = Annotated[Number, Field(ge=-360, le=360)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Sextuple = Annotated[
    tuple[JointDegrees, JointDegrees, JointDegrees, JointDegrees, JointDegrees, JointDegrees], AfterValidator(_degrees)
]
Text = Annotated[str, StringConstraints(min_length=1, max_length=MAX_NAME)]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$", max_length=80)]
CaseName = Annotated[str, StringConstraints(max_length=80), AfterValidator(_plain_name)]
"""Of any alphabet: a patient may be called Müller. What must be ASCII (exports to robots) writes it plainly."""
StructureName = Annotated[str, StringConstraints(pattern=r"^\S(.*\S)?$", max_length=MAX_NAME)]
"""As other programs name structures, such as "right lung"; that it is printable is checked for the whole file."""
Degrees360 = Annotated[Number, Field(ge=0, le=360)]
Degrees180 = Annotated[Number, Field(ge=0, le=180)]
Yes = Annotated[bool, Strict()]
Label = Annotated[int, Strict(), Field(ge=1, le=65535)]
Anatomical = Literal["left", "right", "anterior", "posterior", "head", "feet"]


class Section(BaseModel):
    """A table of the file: frozen, and an unknown key is an error that names the nearest valid one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def _problems(self) -> Iterator[SchemaError]:
        """Problems of the keys together; the first is raised."""
        yield from ()

    def model_post_init(self, context: Any, /) -> None:
        """Raise the first problem; a validator of its own would name itself in the places of errors."""
        for problem in self._problems():
            raise problem

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        if isinstance(data, dict):
            known = [field.alias or name for name, field in cls.model_fields.items()]
            for key in data:
                if key not in known:
                    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
                    hint = f"did you mean '{near[0]}'? " if near else ""
                    raise SchemaError(f"unknown key '{key}'; {hint}keys here: {', '.join(known)}", "unknown_key")
        return data


MAX_STRUCTURES, MAX_LABEL_MAPS = 1000, 100
"""Structures, or obstacles, of a case: TotalSegmentator knows 117 classes, and each structure costs a tree. And tables
``[[structures]]``, each with a label map of its own."""
Stated = Literal["none", "present"]
"""Whether arms, or a table, are in an image, as a person states it."""
Role = Literal["avoid", "traverse", "target", "skin", "unknown"]
Patterns = Annotated[tuple[Text, ...], Field(max_length=MAX_STRUCTURES)]
Margins = Annotated[dict[Text, Margin], Field(max_length=MAX_STRUCTURES)]
Sides = tuple[Literal["right", "left", "front", "back", "feet", "head"], ...]
AIR_HU, DENSE_HU = -900.0, 250.0
"""Air is -1000; its noise in a mean over 3 mm is some 15, so that 100 is more than six times that. Foam of a mattress
has -970 to -900: what is less dense than this is not told from air. Cancellous bone starts at about 200; soft tissue
with contrast in the venous phase ends at about 200."""


class StructureSection(Section):
    """One structure from one source."""

    name: StructureName
    role: Role
    margin_mm: Margin | None = None
    mesh: str | None = None
    unit: str | None = None
    space: str | None = None
    up: Up | None = None
    labelmap: str | None = None
    label: Label | None = None
    ct: str | None = None
    cut: Sides | None = None
    hu: Annotated[Number, Field(ge=-1024, le=30_000)] | None = None

    def _problems(self) -> Iterator[SchemaError]:
        sources = [key for key in ("mesh", "labelmap", "ct") if getattr(self, key) is not None]
        if len(sources) != 1:
            what = f"'{self.name}' needs exactly one of mesh, labelmap, ct; given: {sources or 'none'}"
            yield SchemaError(what, "not_one_source")
        if (self.labelmap is None) != (self.label is None):
            yield SchemaError(f"'{self.name}': labelmap and label go together", "keys_together")
        if self.mesh is not None and self.unit is None:
            what = f'\'{self.name}\': a mesh needs unit = "mm", "cm" or "m"; mesh files do not state it'
            yield SchemaError(what, "unit_not_stated")
        if self.mesh is None and (self.unit or self.space or self.up):
            what = f"'{self.name}': unit, space and up are for a mesh; a volume states its own"
            yield SchemaError(what, "key_not_of_it")
        if self.ct is not None and self.role != "skin":
            yield SchemaError(f"'{self.name}': ct gives only the body's skin; role must be \"skin\"", "key_not_of_it")
        if self.cut is not None and self.role != "skin" and self.labelmap is None:
            what = f"'{self.name}': cut is for the skin and for label maps: it states where they were cut"
            yield SchemaError(what, "key_not_of_it")
        if self.margin_mm is not None and self.role not in {"avoid", "unknown"}:
            yield SchemaError(f'\'{self.name}\': margin_mm is for role "avoid", not "{self.role}"', "key_not_of_it")


class StructuresSection(Section):
    """Many structures of one label map, a folder of masks, a SEG (DICOM or Slicer) or RTSTRUCT, by name pattern."""

    labelmap: str | None = None
    masks: str | None = None
    seg: str | None = None
    rtstruct: str | None = None
    ct: str | None = None
    naming: str | None = None
    target: Patterns = ()
    avoid: Margins = Field(default_factory=dict)
    unknown: Margins = Field(default_factory=dict)
    traverse: Patterns = ()
    ignore: Patterns = ()
    cut: Sides | None = None

    def _problems(self) -> Iterator[SchemaError]:
        sources = [key for key in ("labelmap", "masks", "seg", "rtstruct") if getattr(self, key) is not None]
        if len(sources) != 1:
            yield SchemaError(
                "needs either labelmap (a file) or masks (a folder with one file per structure), not both; "
                f"or seg (DICOM, or Slicer's .seg.nrrd), or rtstruct; given: {' and '.join(sources) or 'none'}",
                "not_one_source",
            )
        if self.labelmap is None and self.naming is not None:
            what = "naming is for labelmap; masks are named after their files, SEG and RTSTRUCT state their names"
            yield SchemaError(what, "key_not_of_it")
        if self.ct is not None and self.seg is None and self.rtstruct is None:
            yield SchemaError("ct is for seg and rtstruct: the DICOM series on which they were drawn", "key_not_of_it")

    @property
    def source(self) -> str:
        """The file or the folder, as the case writes it."""
        return self.labelmap or self.mask_set or ""

    @property
    def mask_set(self) -> str | None:
        """The folder of masks, or the DICOM file that holds them; None for a label map."""
        return self.masks or self.seg or self.rtstruct


class CtSection(Section):
    """The CT beside the structures: what it shows that they do not name. Hounsfield units."""

    file: str | None = None
    air_hu: Annotated[Number, Field(ge=-990, le=-300)] = AIR_HU
    dense_hu: Annotated[Number, Field(ge=100, le=3000)] = DENSE_HU
    margin_mm: Margin = 2.0
    unnamed: Literal["unknown", "free"] = "unknown"
    arms: Stated | None = None
    table: Stated | None = None
    beyond_mm: Annotated[Number, Field(ge=0, le=1000)] | Literal["all"] | None = None


Chance = Annotated[Number, Field(ge=0, le=1)]
"""A chance, or another fraction, 0..1."""
MAX_DIRECTIONS = 1_000_000
"""Rows of a search: a hemisphere at 0.2 degrees; 2 GB of table with 60 structures."""


class EntryAxes(Section):
    """An entry frame of one's own: where its z and x axes point; y = z × x."""

    z: Anatomical | Vector
    x: Anatomical | Vector


class SearchSection(Section):
    """The grid of directions and the limits at the skin."""

    theta_deg: tuple[Degrees180, Degrees180] = (0.0, 90.0)
    beta_deg: tuple[Degrees360, Degrees360] = (0.0, 360.0)
    step_deg: Annotated[Number, Field(ge=0.05, le=45)] = 1.0
    max_skin_angle_deg: Annotated[Number, Field(gt=0, le=90)] = 60.0
    frame: Literal["ct", "bed"] | EntryAxes | None = None
    trust_labels: Annotated[bool, Strict()] = False
    min_hit: Chance | None = None
    max_touch: Chance | None = None
    max_touch_of: Annotated[dict[Text, Chance], Field(max_length=MAX_STRUCTURES)] = Field(default_factory=dict)

    def _problems(self) -> Iterator[SchemaError]:
        rows = float(np.prod([(high - low) / self.step_deg + 1 for low, high in (self.theta_deg, self.beta_deg)]))
        if rows > MAX_DIRECTIONS:
            what = f"step_deg {self.step_deg:g} makes {rows:,.0f} directions; {MAX_DIRECTIONS:,} at most"
            yield SchemaError(what, "too_many")
        for key in ("theta_deg", "beta_deg"):
            low, high = getattr(self, key)
            if low > high:
                yield SchemaError(f"{key} [{low:g}, {high:g}] descends; it is [lowest, highest]", "range_descends")
            if 0 < high - low < self.step_deg:
                what = f"step_deg {self.step_deg:g} is larger than the range {key} [{low:g}, {high:g}]"
                yield SchemaError(what, "step_too_large")


class RankingSection(Section):
    """Weights of the cost terms; each term lies in 0..1, see planning/search/ranking.py."""

    clearance: Weight = 1.0
    path_length: Weight = 0.5
    skin_angle: Weight = 0.3
    tissue: Weight = 0.5
    reach: Weight = 0.5
    safe_cone: Weight = 0.5

    def _problems(self) -> Iterator[SchemaError]:
        if not any(getattr(self, name) > 0 for name in type(self).model_fields):
            yield SchemaError("every weight is 0; at least one must be above 0", "no_weight")


Force = Annotated[Number, Field(ge=0, le=50)]


class NeedleSection(Section):
    """The needle: lengths from the tip; the holder is what lies between shaft and flange."""

    length_mm: Annotated[Number, Field(ge=20, le=1000)]
    shaft_mm: Annotated[Number, Field(ge=10, le=1000)]
    diameter_mm: Annotated[Number, Field(ge=0.1, le=20)]
    standoff_mm: Annotated[Number, Field(ge=5, le=1000)] | None = None
    skin_gap_mm: Annotated[Number, Field(ge=6, le=200)] = 10.0  # the least, along the needle; see standoff.py
    holder_diameter_mm: Annotated[Number, Field(ge=1, le=200)] = 30.0
    lengths_mm: tuple[Annotated[Number, Field(ge=20, le=1000)], ...] = ()
    gauge: Annotated[int, Strict()] | None = None
    solid: Annotated[bool, Strict()] | None = None
    bevel_deg: Annotated[Number, Field(ge=0, le=10)] | None = None
    modulus_gpa: Annotated[Number, Field(ge=1, le=1000)] | None = None

    def _problems(self) -> Iterator[SchemaError]:
        if self.shaft_mm > self.length_mm:
            yield SchemaError(f"shaft_mm {self.shaft_mm:g} is longer than length_mm {self.length_mm:g}", "out_of_range")
        least = self.length_mm - self.shaft_mm + 10.0
        if self.lengths_mm and (self.length_mm not in self.lengths_mm or min(self.lengths_mm) < least):
            what = f"lengths_mm must include length_mm, and none below {least:g} mm (the holder, and 10 mm of shaft)"
            yield SchemaError(what, "out_of_range")
        if self.solid is not None and self.gauge is None:
            yield SchemaError("solid is for gauge; without gauge the shaft is solid, of diameter_mm", "key_not_of_it")


class TissueSection(Section):
    """One tissue."""

    stiffness_n_mm2: Annotated[Number, Field(ge=0, le=100)]  # soft tissue has 0.01 to 1, rubber some 10
    cutting_n: Force = 0.0
    friction_n_mm: Annotated[Number, Field(ge=0, le=1)] = 0.0
    capsule_n: Force = 0.0
    capsule_mm: Annotated[Number, Field(ge=0, le=50)] = 0.0
    held_n_mm: Annotated[Number, Field(ge=0.01, le=1000)] | None = None

    def _problems(self) -> Iterator[SchemaError]:
        if (self.capsule_n > 0) != (self.capsule_mm > 0):
            what = "capsule_n and capsule_mm go together: force at the rupture, and its depth"
            yield SchemaError(what, "keys_together")


class TargetSection(Section):
    """The point to reach: coordinates, or a name in a file of points."""

    position_mm: Vector | None = None
    points: str | None = None
    name: Text = "target"
    structure: StructureName | None = None
    hit_radius_mm: Annotated[Number, Field(gt=0, le=100)] | None = None

    def _problems(self) -> Iterator[SchemaError]:
        if (self.position_mm is None) == (self.points is None):
            what = "needs either position_mm or points (a file, with the target's name), not both"
            yield SchemaError(what, "not_one_source")
        if self.structure is None and self.hit_radius_mm is None:
            yield SchemaError("needs structure, or hit_radius_mm if the target lies in no structure", "missing_key")


Turn = Annotated[Number, Field(ge=-720, le=720)]
Turns = tuple[Turn, Turn, Turn, Turn, Turn, Turn]
Speed = Annotated[Number, Field(gt=0, le=720)]
Speeds = tuple[Speed, Speed, Speed, Speed, Speed, Speed]


class LimitsSection(Section):
    """The angles and speeds of six joints, from the base on; degrees."""

    lowest_deg: Turns | None = None
    highest_deg: Turns | None = None
    max_speed_deg_s: Speeds | None = None

    def _problems(self) -> Iterator[SchemaError]:
        if (self.lowest_deg is None) != (self.highest_deg is None):
            yield SchemaError("lowest_deg and highest_deg go together", "keys_together")
        for joint, (low, high) in enumerate(zip(self.lowest_deg or (), self.highest_deg or (), strict=True)):
            if not low < high:
                what = f"joint {joint + 1}: lowest_deg {low:g} is not below highest_deg {high:g}"
                yield SchemaError(what, "range_descends")


class MountSection(Section):
    """Where the robot's base stands in the CT, when no markers say it."""

    position_mm: Vector
    x_axis: Vector
    z_axis: Vector


class RobotSection(Section):
    """The arm: one of the table, by its name, or one's own, by a URDF."""

    model: str = "ur3"
    urdf: str | None = None
    flange: Text = FLANGE
    limits: LimitsSection | None = None
    home_deg: Sextuple | None = None
    mount: MountSection | None = None
    tip_speed_mm_s: Annotated[Number, Field(ge=1, le=HIGHEST.tip_speed_mm_s)] = USUAL.tip_speed_mm_s
    insertion_speed_mm_s: Annotated[Number, Field(ge=0.1, le=HIGHEST.insertion_speed_mm_s)] = USUAL.insertion_speed_mm_s
    joint_speed_fraction: Annotated[Number, Field(ge=0.01, le=1)] = USUAL.joint_speed_fraction
    joint_acceleration_fraction: Annotated[Number, Field(ge=0.01, le=1)] = USUAL.joint_acceleration_fraction

    def _problems(self) -> Iterator[SchemaError]:
        if self.urdf is not None and "model" in self.model_fields_set:
            yield SchemaError("model and urdf both state the arm; keep one", "stated_twice")
        if self.urdf is None and "flange" in self.model_fields_set:
            yield SchemaError("flange names a link of urdf, and urdf is missing", "key_not_of_it")
        if self.insertion_speed_mm_s > self.tip_speed_mm_s:
            what = f"insertion_speed_mm_s {self.insertion_speed_mm_s:g} is above tip_speed_mm_s {self.tip_speed_mm_s:g}"
            yield SchemaError(what, "out_of_range")


Range = tuple[Coordinate, Coordinate]
MountName = Literal["floor", "rail", "ceiling", "side"]


class MountBounds(Section):
    """Bounds of the base's place for one kind of mount, from the target; the rest follows from the arm's length."""

    along_mm: Range | None = None
    across_mm: Range | None = None
    height_mm: Range | None = None

    def _problems(self) -> Iterator[SchemaError]:
        for key in ("along_mm", "across_mm", "height_mm"):
            bounds = getattr(self, key)
            if bounds is not None and bounds[0] > bounds[1]:
                what = f"{key} [{bounds[0]:g}, {bounds[1]:g}] descends; it is [lowest, highest]"
                yield SchemaError(what, "range_descends")


class PlaceSection(Section):
    """Bounds within which ``place`` searches for the arm's base."""

    mounts: tuple[MountName, ...] | None = None
    step_mm: Annotated[Number, Field(ge=20, le=500)] = 150.0
    table: Name = "table"
    rail_gap_mm: Annotated[Number, Field(ge=0, le=1000)] = 110.0
    up: Anatomical | Vector | None = None
    along: Anatomical | Vector | None = None
    floor: MountBounds = MountBounds()
    rail: MountBounds = MountBounds()
    ceiling: MountBounds = MountBounds()
    side: MountBounds = MountBounds()

    def _problems(self) -> Iterator[SchemaError]:
        if self.mounts is not None and (not self.mounts or len(set(self.mounts)) < len(self.mounts)):
            yield SchemaError(f"mounts {list(self.mounts)}: must have at least one, each once", "duplicate_name")
        if self.rail.across_mm is not None:
            yield SchemaError("rail.across_mm: a rail is next to the table; use rail_gap_mm", "key_not_of_it")


RAS_OF_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Its own inverse."""
NO_RESIDUALS = "stated transform {file}: no residuals, expected error unknown"
_OF_MARKERS = ("method", "correct", "correct_joints_deg")
_OF_COMPARISON = ("use", "fle_mm", "accept_residuals", "accept_symmetry")


class RegistrationSection(Section):
    """Markers seen in the CT and touched by the robot, or the transform between both in a file of ITK.

    Markers beside a transform do not place the base: the transform is held against them.
    """

    method: Literal["triad", "rigid", "weighted", "affine"] | None = None
    markers_ct: str | None = None
    markers_base: str | None = None
    use: tuple[Text, ...] | None = None
    fle_mm: Positive | None = None
    correct: Yes = False
    correct_joints_deg: Sextuple | None = None
    accept_residuals: Yes = False
    accept_symmetry: Yes = False
    transform: str | None = None
    transform_maps: Literal["base_to_ct", "ct_to_base"] | None = None
    base_axes: Literal["LPS", "RAS"] | None = None

    def _problems(self) -> Iterator[SchemaError]:
        if self.correct_joints_deg is not None and not self.correct:
            yield SchemaError("correct_joints_deg needs correct = true, the correction for it", "keys_together")
        if self.correct and self.method not in {None, "weighted"}:
            yield SchemaError(f'correct = true has its own fit; method "{self.method}" has another', "conflicting_keys")
        markers = [key for key in ("markers_ct", "markers_base") if getattr(self, key) is None]
        if self.transform is None:
            if markers:
                what = f"{' and '.join(markers)}: missing; markers_ct and markers_base, or transform"
                yield SchemaError(what, "missing_key")
            if self.transform_maps or self.base_axes:
                yield SchemaError("transform_maps and base_axes are for transform", "key_not_of_it")
            return
        if len(markers) == 1:
            what = f"{markers[0]}: missing; with transform, give both lists of markers, to check it"
            yield SchemaError(what, "missing_key")
        placing = (*_OF_MARKERS, *_OF_COMPARISON) if markers else _OF_MARKERS
        given = [key for key in placing if getattr(self, key)]
        if given:
            yield SchemaError(f"transform replaces markers; {', '.join(given)} is for markers", "key_not_of_it")
        if self.transform_maps is None:
            yield SchemaError(
                'transform needs transform_maps = "base_to_ct" (as Slicer saves a transform from the CT to the '
                'robot) or "ct_to_base": the file does not state its direction',
                "missing_key",
            )
        if self.base_axes is None:
            yield SchemaError(
                'transform needs base_axes = "RAS" (the robot\'s x, y, z are what Slicer shows as R, A, S) or "LPS" '
                "(the file has them unchanged)",
                "missing_key",
            )


class MarkerSection(RegistrationSection):
    """The section where it names markers."""

    markers_ct: str
    markers_base: str


def stated_base_ct(section: RegistrationSection, T_file: Floats) -> Floats:
    """T_base_ct (4, 4), mm, of what a stated transform's file does to a point (4, 4), rigid to the file's digits."""
    U, _, Vt = np.linalg.svd(T_file[:3, :3])
    T = pose(U @ Vt, T_file[:3, 3])
    return _read_as(T, inverted=section.transform_maps == "base_to_ct", rotated=section.base_axes == "RAS")


def other_readings(section: RegistrationSection, T_base_ct: Floats) -> dict[str, Floats]:
    """T_base_ct (4, 4), mm, under other values of ``transform_maps`` and ``base_axes``, by these keys as text."""
    T = RAS_OF_LPS @ T_base_ct if section.base_axes == "RAS" else T_base_ct
    maps = "ct_to_base" if section.transform_maps == "base_to_ct" else "base_to_ct"
    axes = "LPS" if section.base_axes == "RAS" else "RAS"
    inverted, turned = f'transform_maps = "{maps}"', f'base_axes = "{axes}"'
    return {
        inverted: _read_as(T, inverted=True, rotated=section.base_axes == "RAS"),
        turned: _read_as(T, inverted=False, rotated=axes == "RAS"),
        f"{inverted} and {turned}": _read_as(T, inverted=True, rotated=axes == "RAS"),
    }


def _read_as(T: Floats, *, inverted: bool, rotated: bool) -> Floats:
    T = inverse(T) if inverted else T
    return np.asarray(RAS_OF_LPS @ T if rotated else T)


Millimetres = Annotated[Number, Field(ge=0, le=100)]
Degrees = Annotated[Number, Field(ge=0, le=10)]
Cell = Annotated[Number, Field(gt=0, le=100)]


class ErrorsSection(Section):
    """The declared errors; what is left out takes its default, which for the CT follows from pixel and slices."""

    ct_pixel_mm: Cell | None = None
    ct_spacing_mm: Cell | None = None
    ct_in_plane_mm: Millimetres | None = None
    ct_slice_mm: Millimetres | None = None
    bed_axis: Anatomical | Vector | None = None
    touch_mm: Millimetres | None = None
    target_mm: Millimetres | None = None
    marker_noise: Literal["declared", "found"] = "declared"
    arm: Literal["calibrated", "nominal"] = "calibrated"
    link_mm: Millimetres | None = None
    twist_deg: Degrees | None = None
    joint_deg: Degrees | None = None
    repeatability_deg: Degrees = 0.003
    joint_drift_deg: Degrees | None = None
    jitter_deg: Degrees = 0.0
    tip_offset_mm: Millimetres = 0.3
    needle_direction_deg: Degrees = 0.2
    surface_mm: Millimetres | None = None

    def _problems(self) -> Iterator[SchemaError]:
        for cell, deviation in (("ct_pixel_mm", "ct_in_plane_mm"), ("ct_spacing_mm", "ct_slice_mm")):
            if getattr(self, cell) is not None and getattr(self, deviation) is not None:
                yield SchemaError(f"{cell} and {deviation} state the same error; keep one", "stated_twice")


class RehearsalSection(Section):
    """From what the twin draws its ground truth; the planner never reads it."""

    seed: Annotated[int, Strict(), Field(ge=0, lt=2**31)] = 0
    truth_base: str | None = None
    fle_ct_mm: NotNegative = 0.5
    fle_touch_mm: NotNegative = 0.1
    joint_offset_deg: NotNegative = 0.02
    control: Literal["impedance", "admittance", "position"] = "impedance"
    errors: ErrorsSection | None = None


PatternWeight = Annotated[Number, Field(ge=0, le=2)]
"""Of what moves more than the target, such as the dome of a liver over a lesion deep in it, a weight is above 1."""


class BreathingSection(Section):
    """The keys; positions s are 0 at exhale and 1 at full inhale."""

    amplitude_mm: Annotated[Number, Field(ge=0, le=100)]
    direction: Anatomical | Vector = "feet"
    weights: Annotated[dict[Text, PatternWeight], Field(max_length=MAX_STRUCTURES)]
    phases: Annotated[int, Strict(), Field(ge=1, le=64)] = 8
    exponent: Annotated[int, Strict(), Field(ge=1, le=6)] = 2
    scanned_at: Chance = 0.0
    gate: Chance | None = None

    def _problems(self) -> Iterator[SchemaError]:
        if self.phases > 1 and self.phases % 2:
            what = f"phases {self.phases}: must be 1, or an even number, so that full inhale is one of them"
            yield SchemaError(what, "out_of_range")


Deviation = Annotated[Number, Field(gt=0, le=10)]
"""Standard deviation of a device's reading, mm; no device reads without error."""
Along = Annotated[Number, Field(gt=0, le=1000)]
"""Along the needle, from its tip."""


class StereoSection(Section):
    """Two cameras, and balls on the needle and its holder that they see."""

    cameras_mm: tuple[Vector, Vector] | None = None
    balls_mm: Annotated[tuple[Along, ...], Field(min_length=1, max_length=4)] = (80.0, 160.0)
    sd_mm: Deviation = 0.03

    def _problems(self) -> Iterator[SchemaError]:
        if self.cameras_mm is not None and self.cameras_mm[0] == self.cameras_mm[1]:
            yield SchemaError("cameras_mm: both cameras are at one place, which shows no depth", "out_of_range")
        if any(high <= low for low, high in pairwise(self.balls_mm)):
            yield SchemaError(f"balls_mm {list(self.balls_mm)} does not ascend, from the tip on", "range_descends")


class UltrasoundSection(Section):
    """A probe on an arm of its own: where that is located, how well its image is read, and what it sees.

    ``target_sd_mm`` and ``tip_sd_mm`` are of readings in the image plane (per axis), and across it.
    """

    model: str = "ur3"
    mount: MountSection | None = None
    target_sd_mm: tuple[Deviation, Deviation] = (0.3, 0.5)
    tip_sd_mm: tuple[Deviation, Deviation] = (0.08, 0.5)
    calibration_sd_mm: Deviation = 0.07
    depth_mm: Annotated[Number, Field(ge=20, le=400)] = 150.0
    width_mm: Annotated[Number, Field(ge=10, le=200)] = 40.0


class ControlScanSection(Section):
    """A CT of a few cm with the needle in: its slices, whether it shows the target, what it costs."""

    slice_mm: Annotated[Number, Field(ge=0.5, le=5)] = 2.0
    target_seen: Annotated[bool, Strict()] = True
    dose_msv: Annotated[Number, Field(ge=0, le=50)] = 0.9
    seconds: Annotated[Number, Field(gt=0, le=3600)] = 120.0


class MotionSection(Section):
    """How the target, and what surrounds it, has moved since the scan: standard deviation per axis, LPS."""

    target_sd_mm: tuple[Millimetres, Millimetres, Millimetres]


class ObstacleSection(Section):
    """A box in the workcell (table, gantry side), axes parallel to its frame's."""

    name: Name
    frame: Literal["ct", "base"]
    center_mm: Vector
    size_mm: tuple[Length, Length, Length]


class GantrySection(Section):
    """A CT gantry: a wall with a round bore. ``axis`` and ``up`` are the bore's directions before the tilt."""

    bore_diameter_mm: Annotated[Number, Field(ge=200, le=5000)]
    center_mm: Vector
    thickness_mm: Annotated[Number, Field(ge=10, le=5000)]
    wall_mm: Annotated[Number, Field(ge=10, le=5000)] = 600.0
    tilt_deg: Annotated[Number, Field(ge=-45, le=45)] = 0.0
    axis: Anatomical | Vector | None = None
    up: Anatomical | Vector | None = None


TOOL_ROLE = "tool mesh"
"""Role of the file that defines a tool, among the inputs of a case."""
Beside = Annotated[Number, Field(ge=-1000, le=1000)]
ToolTurn = Annotated[Number, Field(ge=-360, le=360)]


class ToolSection(Section):
    """A mesh and where it is on the flange: z along the needle, as the controller has it."""

    mesh: str
    unit: str
    up: Up | None = None
    position_mm: tuple[Beside, Beside, Beside] = (0.0, 0.0, 0.0)
    rotation_deg: tuple[ToolTurn, ToolTurn, ToolTurn] = (0.0, 0.0, 0.0)
