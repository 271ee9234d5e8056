"""What other programs write: meshes, label maps, CT volumes and named points, each through the guard."""

from planning.formats.guard import guard_mesh, guard_points, guard_transform
from planning.formats.labelmaps import LabelMap, read_labelmap
from planning.formats.meshes import mesh_warnings, read_mesh
from planning.formats.points import NamedPoints, read_points, write_points
from planning.formats.spaces import Space, Unit, parse_space, parse_unit, to_lps
from planning.formats.volumes import Volume, read_volume

__all__ = [
    "LabelMap",
    "NamedPoints",
    "Space",
    "Unit",
    "Volume",
    "guard_mesh",
    "guard_points",
    "guard_transform",
    "mesh_warnings",
    "parse_space",
    "parse_unit",
    "read_labelmap",
    "read_mesh",
    "read_points",
    "read_volume",
    "to_lps",
    "write_points",
]
