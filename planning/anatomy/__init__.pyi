from .anatomy import (
    Anatomy as Anatomy,
)
from .anatomy import (
    Role as Role,
)
from .anatomy import (
    Structure as Structure,
)
from .anatomy import (
    load_anatomy as load_anatomy,
)
from .anatomy import (
    load_skin as load_skin,
)
from .anatomy import (
    surface_distance as surface_distance,
)
from .inside_skin import LEAST_TOLERANCE_MM as LEAST_TOLERANCE_MM
from .regions import absent_organs as absent_organs
from .skin import FieldOfView as FieldOfView
from .skin import Skin as Skin
from .skin_entry import SkinPaths as SkinPaths
from .skin_entry import skin_paths as skin_paths
