from .anatomy import (
    Anatomy as Anatomy,
    Role as Role,
    Structure as Structure,
    load_anatomy as load_anatomy,
    load_skin as load_skin,
    surface_distance as surface_distance,
)
from .body.field_of_view import FieldOfView as FieldOfView
from .regions import absent_organs as absent_organs
from .skin import Skin as Skin
from .skin_entry import SkinPaths as SkinPaths, skin_paths as skin_paths
