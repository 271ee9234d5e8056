"""What a case file may hold: the TOML schema, key by key. See docs/reference/case.md for the words."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any, Literal, Self

from pydantic import Field, Strict, model_validator

from puncture_twin.planning.arm.speed_limits import DEFAULT_SPEEDS, HIGHEST
from puncture_twin.planning.arm.urdf.arm_urdf import FLANGE
from puncture_twin.planning.base.text_names import unprintable_texts
from puncture_twin.planning.case.case_schema import CaseSchema, Region, check_statement, count_difference, with_count
from puncture_twin.planning.case.errors_section import ErrorsSection
from puncture_twin.planning.case.registration_section import RegistrationSection
from puncture_twin.planning.case.sections.breathing_section import BreathingSection
from puncture_twin.planning.case.sections.limits_section import LimitsSection
from puncture_twin.planning.case.sections.tissue_section import TissueSection
from puncture_twin.planning.case.sections.tool_section import ToolSection
from puncture_twin.planning.case.toml_types import (
    Anatomical,
    Coordinate,
    Degrees180,
    Degrees360,
    Label,
    Length,
    Margin,
    Name,
    NotNegative,
    Number,
    Section,
    Sextuple,
    StructureName,
    Text,
    Vector,
    Weight,
)

MAX_STRUCTURES = 1000
"""Structures, or obstacles, of a case: TotalSegmentator knows 117 classes, and each structure costs a tree."""

Chance = Annotated[Number, Field(ge=0, le=1)]

MAX_LABEL_MAPS = 100
"""Tables ``[[structures]]``, each with a label map of its own."""

AIR_HU = -900.0
"""Air is -1000; its noise in a mean over 3 mm is some 15, so that 100 is more than six times that. Foam of a mattress
has -970 to -900: what is less dense than this is not told from air."""
DENSE_HU = 250.0
"""Cancellous bone starts at about 200; soft tissue with contrast in the venous phase ends at about 200."""

MAX_DIRECTIONS = 1_000_000
"""Rows of a search: a hemisphere at 0.2 degrees; 2 GB of table with 60 structures."""


class TargetSection(Section):
    """The point to reach: coordinates, or a name in a file of points."""

    position_mm: Vector | None = None
    points: str | None = None
    name: Text = "target"
    structure: StructureName | None = None
    hit_radius_mm: Annotated[Number, Field(gt=0, le=100)] | None = None

    @model_validator(mode="after")
    def _one_position(self) -> Self:
        if (self.position_mm is None) == (self.points is None):
            raise ValueError("needs either position_mm or points (a file, with the target's name), not both")
        if self.structure is None and self.hit_radius_mm is None:
            raise ValueError("needs structure, or hit_radius_mm where the target lies in no structure")
        return self


class NeedleSection(Section):
    """The needle: lengths from the tip; the holder is what lies between shaft and flange."""

    length_mm: Annotated[Number, Field(ge=20, le=1000)]
    shaft_mm: Annotated[Number, Field(ge=10, le=1000)]
    diameter_mm: Annotated[Number, Field(ge=0.1, le=20)]
    standoff_mm: Annotated[Number, Field(ge=5, le=1000)] | None = None
    skin_gap_mm: Annotated[Number, Field(ge=6, le=200)] = 10.0  # the least, along the needle; see standoff.py
    holder_diameter_mm: Annotated[Number, Field(ge=1, le=200)] = 30.0
    gauge: Annotated[int, Strict()] | None = None
    solid: Annotated[bool, Strict()] | None = None
    bevel_deg: Annotated[Number, Field(ge=0, le=10)] | None = None
    modulus_gpa: Annotated[Number, Field(ge=1, le=1000)] | None = None

    @model_validator(mode="after")
    def _shaft_fits(self) -> Self:
        if self.shaft_mm > self.length_mm:
            raise ValueError(f"shaft_mm {self.shaft_mm:g} is longer than length_mm {self.length_mm:g}")
        if self.solid is not None and self.gauge is None:
            raise ValueError("solid belongs to gauge; without one the shaft is solid, of diameter_mm")
        return self


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

    @model_validator(mode="after")
    def _grid_fits(self) -> Self:
        rows = 1.0
        for low, high in (self.theta_deg, self.beta_deg):
            rows *= (high - low) / self.step_deg + 1
        if rows > MAX_DIRECTIONS:
            raise ValueError(f"step_deg {self.step_deg:g} makes {rows:,.0f} directions; {MAX_DIRECTIONS:,} at most")
        return self

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        for key in ("theta_deg", "beta_deg"):
            low, high = getattr(self, key)
            if low > high:
                raise ValueError(f"{key} [{low:g}, {high:g}] descends; it is [lowest, highest]")
            if 0 < high - low < self.step_deg:
                raise ValueError(f"step_deg {self.step_deg:g} is larger than the range {key} [{low:g}, {high:g}]")
        return self


class RankingSection(Section):
    """Weights of the cost terms; each term lies in 0..1, see planning/search/ranking.py."""

    clearance: Weight = 1.0
    path_length: Weight = 0.5
    skin_angle: Weight = 0.3
    tissue: Weight = 0.5
    reach: Weight = 0.5
    safe_cone: Weight = 0.5

    @model_validator(mode="after")
    def _one_counts(self) -> Self:
        if not any(getattr(self, name) > 0 for name in type(self).model_fields):
            raise ValueError("every weight is 0; one at least is above")
        return self


Role = Literal["avoid", "traverse", "target", "skin", "unknown"]


class StructureSection(Section):
    """One structure from one source."""

    name: StructureName
    role: Role
    margin_mm: Margin | None = None
    mesh: str | None = None
    unit: str | None = None
    space: str | None = None
    labelmap: str | None = None
    label: Label | None = None
    ct: str | None = None
    cut: tuple[Literal["right", "left", "front", "back", "feet", "head"], ...] | None = None
    hu: Annotated[Number, Field(ge=-1024, le=30_000)] | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = [key for key in ("mesh", "labelmap", "ct") if getattr(self, key) is not None]
        if len(sources) != 1:
            raise ValueError(f"'{self.name}' needs exactly one of mesh, labelmap, ct; it has {sources or 'none'}")
        if (self.labelmap is None) != (self.label is None):
            raise ValueError(f"'{self.name}': labelmap and label go together")
        if self.mesh is not None and self.unit is None:
            raise ValueError(f'\'{self.name}\': a mesh needs unit = "mm", "cm" or "m"; no mesh file says it')
        if self.mesh is None and (self.unit or self.space):
            raise ValueError(f"'{self.name}': unit and space belong to a mesh; a volume says its own")
        if self.ct is not None and self.role != "skin":
            raise ValueError(f"'{self.name}': ct finds the body's skin only; role must be \"skin\"")
        if self.cut is not None and (self.role != "skin" or self.mesh is None):
            raise ValueError(f"'{self.name}': cut belongs to a skin mesh; a volume shows where it cuts the body")
        if self.margin_mm is not None and self.role not in {"avoid", "unknown"}:
            raise ValueError(f'\'{self.name}\': margin_mm belongs to role "avoid", not "{self.role}"')
        return self


Patterns = Annotated[tuple[Text, ...], Field(max_length=MAX_STRUCTURES)]


class StructuresSection(Section):
    """Many structures of one label map, a folder of masks, a SEG (DICOM or Slicer) or RTSTRUCT, by name pattern."""

    labelmap: str | None = None
    masks: str | None = None
    seg: str | None = None
    rtstruct: str | None = None
    ct: str | None = None
    naming: str | None = None
    target: Patterns = ()
    avoid: Annotated[dict[Text, Margin], Field(max_length=MAX_STRUCTURES)] = Field(default_factory=dict)
    unknown: Annotated[dict[Text, Margin], Field(max_length=MAX_STRUCTURES)] = Field(default_factory=dict)
    traverse: Patterns = ()
    ignore: Patterns = ()

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = [key for key in ("labelmap", "masks", "seg", "rtstruct") if getattr(self, key) is not None]
        if len(sources) != 1:
            raise ValueError(
                "needs either labelmap (a file) or masks (a folder with one file a structure), not both; "
                f"or seg (DICOM, or Slicer's .seg.nrrd), or rtstruct; it has {' and '.join(sources) or 'none'}"
            )
        if self.labelmap is None and self.naming is not None:
            raise ValueError(
                "naming belongs to labelmap; masks are named after their files, SEG and RTSTRUCT state their names"
            )
        if self.ct is not None and self.seg is None and self.rtstruct is None:
            raise ValueError("ct belongs to seg and rtstruct: the DICOM series on which they were drawn")
        return self

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
    tip_speed_mm_s: Annotated[Number, Field(ge=1, le=HIGHEST.tip_speed_mm_s)] = DEFAULT_SPEEDS.tip_speed_mm_s
    insertion_speed_mm_s: Annotated[Number, Field(ge=0.1, le=HIGHEST.insertion_speed_mm_s)] = (
        DEFAULT_SPEEDS.insertion_speed_mm_s
    )
    joint_speed_fraction: Annotated[Number, Field(ge=0.01, le=1)] = DEFAULT_SPEEDS.joint_speed_fraction
    joint_acceleration_fraction: Annotated[Number, Field(ge=0.01, le=1)] = DEFAULT_SPEEDS.joint_acceleration_fraction

    @model_validator(mode="after")
    def _one_arm(self) -> Self:
        if self.urdf is not None and "model" in self.model_fields_set:
            raise ValueError("model and urdf both say which arm it is; keep one")
        if self.urdf is None and "flange" in self.model_fields_set:
            raise ValueError("flange names a link of urdf, which is not there")
        return self

    @model_validator(mode="after")
    def _insertion_is_the_slower(self) -> Self:
        if self.insertion_speed_mm_s > self.tip_speed_mm_s:
            raise ValueError(
                f"insertion_speed_mm_s {self.insertion_speed_mm_s:g} is above tip_speed_mm_s {self.tip_speed_mm_s:g}"
            )
        return self


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


Range = tuple[Coordinate, Coordinate]
MountName = Literal["floor", "rail", "ceiling", "side"]


class MountBounds(Section):
    """Where a base of one kind may stand, seen from the target; what is left out follows from the arm's length."""

    along_mm: Range | None = None
    across_mm: Range | None = None
    height_mm: Range | None = None

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        for key in ("along_mm", "across_mm", "height_mm"):
            bounds = getattr(self, key)
            if bounds is not None and bounds[0] > bounds[1]:
                raise ValueError(f"{key} [{bounds[0]:g}, {bounds[1]:g}] descends; it is [lowest, highest]")
        return self


class PlaceSection(Section):
    """Where ``place`` may stand the arm."""

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

    @model_validator(mode="after")
    def _mounts_make_sense(self) -> Self:
        if self.mounts is not None and (not self.mounts or len(set(self.mounts)) < len(self.mounts)):
            raise ValueError(f"mounts {list(self.mounts)}: at least one, each once")
        if self.rail.across_mm is not None:
            raise ValueError("rail.across_mm: a rail lies beside the table; rail_gap_mm says how far")
        return self


class RehearsalSection(Section):
    """What the twin's truth is drawn from; the planner never reads it."""

    seed: Annotated[int, Strict(), Field(ge=0, lt=2**31)] = 0
    truth_base: str | None = None
    fle_ct_mm: NotNegative = 0.5
    fle_touch_mm: NotNegative = 0.1
    joint_offset_deg: NotNegative = 0.02
    control: Literal["impedance", "admittance", "position"] = "impedance"
    errors: ErrorsSection | None = None


class EndSection(Section):
    """The last table of the file, which every cut loses."""

    structures: Annotated[int, Strict(), Field(ge=1)]


class CaseFile(Section):
    """The whole file."""

    schema_: CaseSchema = Field(alias="schema")
    structure_count: Annotated[int, Strict(), Field(ge=1)] | None = Field(None, alias="structures = N")
    region: Region | None = None
    name: Name
    space: Literal["LPS", "RAS", "local"]
    target: TargetSection
    needle: NeedleSection
    search: SearchSection = SearchSection()
    ranking: RankingSection = RankingSection()
    structure: Annotated[tuple[StructureSection, ...], Field(max_length=MAX_STRUCTURES)] = ()
    structures: Annotated[tuple[StructuresSection, ...], Field(max_length=MAX_LABEL_MAPS)] = ()
    ct: CtSection = CtSection()
    registration: RegistrationSection | None = None
    robot: RobotSection = RobotSection()
    tool: ToolSection | None = None
    obstacle: Annotated[tuple[ObstacleSection, ...], Field(max_length=MAX_STRUCTURES)] = ()
    gantry: GantrySection | None = None
    place: PlaceSection = PlaceSection()
    errors: ErrorsSection | None = None
    breathing: BreathingSection | None = None
    tissue: Annotated[dict[Text, TissueSection], Field(max_length=MAX_STRUCTURES)] = Field(default_factory=dict)
    rehearsal: RehearsalSection = RehearsalSection()
    end: EndSection | None = None

    @property
    def stated_structures(self) -> int | None:
        """How many structures the file says that it has, the skin among them; None in schema 1."""
        return self.structure_count if self.end is None else self.end.structures

    @property
    def ct_name(self) -> str | None:
        """The CT that the skin comes from, or the one that stands beside it."""
        return next((one.ct for one in self.structure if one.ct is not None), self.ct.file)

    @model_validator(mode="before")
    @classmethod
    def _with_count(cls, data: Any) -> Any:
        return with_count(data)

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        at_end = None if self.end is None else self.end.structures
        check_statement(self.schema_, self.region, self.structure_count, at_end)
        stated = self.stated_structures
        wrong = "" if stated is None or self.structures else count_difference(stated, len(self.structure))
        if wrong:
            raise ValueError(wrong)
        return self

    @model_validator(mode="before")
    @classmethod
    def _refuse_unprintable(cls, data: Any) -> Any:
        for text in unprintable_texts(data):
            raise ValueError(f"{text[:60]!a} holds a control or format character; names and paths are plain text")
        return data

    @model_validator(mode="after")
    def _no_contradiction(self) -> Self:
        if self.registration is not None and self.robot.mount is not None:
            raise ValueError("[registration] and [robot.mount] both say where the base is; keep one")
        if self.errors is None and self.rehearsal.errors is not None:
            raise ValueError("[rehearsal.errors] is a truth that differs from [errors], which is not there")
        if self.errors is None and self.registration is not None and self.registration.correct:
            raise ValueError(
                "registration.correct needs [errors]: it tells the arm's errors by what is declared of them"
            )
        chances = (self.search.min_hit, self.search.max_touch, self.search.max_touch_of or None)
        if self.errors is None and any(chance is not None for chance in chances):
            raise ValueError("search.min_hit and max_touch need [errors]: without declared errors there is no chance")
        if self.space == "local" and self.registration is not None and self.registration.transform is not None:
            raise ValueError('registration.transform: a transform file speaks of patient space; space "local" has none')
        if self.space == "local" and self.ct.file is not None:
            raise ValueError('ct.file: a CT says its own patient space; space "local" has none')
        if self.space == "local" and any(s.cut for s in self.structure):
            raise ValueError('cut names sides of a patient; space "local" has none')
        if self.space == "local" and self.search.frame not in {None, "ct"}:
            raise ValueError('search.frame must be "ct" for space "local": it has no head and no front')
        for name, count in Counter(s.name for s in self.structure).items():
            if count > 1:
                raise ValueError(f"structure '{name}' stands twice; names are unique")
        skins = [s.name for s in self.structure if s.role == "skin"]
        if len(skins) != 1:
            raise ValueError(f'one structure has role "skin"; here {skins or "none"}')
        return self

    @model_validator(mode="after")
    def _local_has_no_head(self) -> Self:
        if self.space != "local":
            return self
        gantry = self.gantry
        if gantry is not None and not (isinstance(gantry.axis, tuple) and isinstance(gantry.up, tuple)):
            raise ValueError('gantry: space "local" has no head and no front; give axis and up as vectors')
        if isinstance(self.place.up, str) or isinstance(self.place.along, str):
            raise ValueError('place: space "local" has no head and no front; give up and along as vectors')
        return self
