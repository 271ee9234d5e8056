from .guard import (
    MAX_COORDINATE_MM as MAX_COORDINATE_MM,
    ROTATION_TOLERANCE as ROTATION_TOLERANCE,
    guard_points as guard_points,
    guard_transform as guard_transform,
)
from .mesh_guard import (
    MAX_TRIANGLES as MAX_TRIANGLES,
    fits as fits,
    guard_mesh as guard_mesh,
    twice_areas as twice_areas,
)
from .raw_mesh import (
    MAX_VERTICES as MAX_VERTICES,
    RawMesh as RawMesh,
    join as join,
    refuse as refuse,
    token_array as token_array,
    triangulate as triangulate,
)
