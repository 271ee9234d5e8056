from .case import (
    Axis as Axis,
)
from .case import (
    Case as Case,
)
from .case import (
    Gantry as Gantry,
)
from .case import (
    Needle as Needle,
)
from .case import (
    Obstacle as Obstacle,
)
from .case import (
    axes_frame as axes_frame,
)
from .case import (
    load_case as load_case,
)
from .case import (
    mount_pose as mount_pose,
)
from .case_file import (
    Coordinate as Coordinate,
)
from .case_file import (
    Degrees180 as Degrees180,
)
from .case_file import (
    Degrees360 as Degrees360,
)
from .case_file import (
    Length as Length,
)
from .case_file import (
    MountBounds as MountBounds,
)
from .case_file import (
    MountName as MountName,
)
from .case_file import (
    MountSection as MountSection,
)
from .case_file import (
    Name as Name,
)
from .case_file import (
    NotNegative as NotNegative,
)
from .case_file import (
    Number as Number,
)
from .case_file import (
    RankingSection as RankingSection,
)
from .case_file import (
    RegistrationSection as RegistrationSection,
)
from .case_file import (
    Section as Section,
)
from .case_file import (
    Sextuple as Sextuple,
)
from .case_file import (
    StructureSection as StructureSection,
)
from .case_file import (
    StructuresSection as StructuresSection,
)
from .case_file import (
    Vector as Vector,
)
from .case_schema import count_difference as count_difference
from .entry import (
    ANATOMICAL_LPS as ANATOMICAL_LPS,
)
from .entry import (
    Directions as Directions,
)
from .entry import (
    angles as angles,
)
from .entry import (
    direction as direction,
)
from .entry import (
    grid as grid,
)
from .entry import (
    needle_pose as needle_pose,
)
from .entry import (
    outward as outward,
)
from .entry import (
    view_frame as view_frame,
)
