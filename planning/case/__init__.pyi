from .angle_grid import AngleGrid as AngleGrid
from .bed import bed_frame as bed_frame
from .case import Case as Case, view_frame as view_frame
from .case_file import count_difference as count_difference
from .entry import (
    ANATOMICAL_LPS as ANATOMICAL_LPS,
    Directions as Directions,
    angles as angles,
    direction as direction,
    grid as grid,
    needle_pose as needle_pose,
    outward as outward,
)
from .errors import ArmUncertainty as ArmUncertainty, ErrorModel as ErrorModel
from .mount import Axis as Axis, axes_frame as axes_frame, mount_pose as mount_pose
from .read_case import load_case as load_case
from .settings import Gantry as Gantry, Needle as Needle, Obstacle as Obstacle
from .tables.place_section import MountBounds as MountBounds, MountName as MountName
from .tables.robot_section import MountSection as MountSection
from .tables.search_section import RankingSection as RankingSection
from .tables.structures_section import StructureSection as StructureSection, StructuresSection as StructuresSection
from .toml_types import (
    Coordinate as Coordinate,
    Degrees180 as Degrees180,
    Degrees360 as Degrees360,
    Length as Length,
    Name as Name,
    NotNegative as NotNegative,
    Number as Number,
    Section as Section,
    Sextuple as Sextuple,
    Vector as Vector,
)
