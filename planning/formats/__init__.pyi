from .guard import (
    MAX_COORDINATE_MM as MAX_COORDINATE_MM,
)
from .guard import (
    MAX_TRIANGLES as MAX_TRIANGLES,
)
from .guard import (
    ROTATION_TOLERANCE as ROTATION_TOLERANCE,
)
from .guard import (
    guard_mesh as guard_mesh,
)
from .guard import (
    guard_points as guard_points,
)
from .guard import (
    guard_transform as guard_transform,
)
from .guard import (
    twice_areas as twice_areas,
)
from .raw_mesh import (
    MAX_VERTICES as MAX_VERTICES,
)
from .raw_mesh import (
    RawMesh as RawMesh,
)
from .raw_mesh import (
    decode_text as decode_text,
)
from .raw_mesh import (
    join as join,
)
from .raw_mesh import (
    refuse as refuse,
)
from .raw_mesh import (
    token_array as token_array,
)
from .raw_mesh import (
    triangulate as triangulate,
)
