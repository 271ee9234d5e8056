"""What other programs write: meshes, label maps, CT volumes and named points, each through the guard."""

from puncture_twin.planning.formats.guard import guard_mesh, guard_points, guard_transform
from puncture_twin.planning.formats.labels.labelmaps import LabelMap, read_labelmap
from puncture_twin.planning.formats.meshes.mesh_files import mesh_warnings, read_mesh
from puncture_twin.planning.formats.points.point_files import NamedPoints, read_points, write_points
from puncture_twin.planning.formats.volumes.volume_files import Volume, read_volume
from puncture_twin.planning.geometry.spaces import Space, Unit, parse_space, parse_unit, to_lps

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
