from .mesh_files import mesh_warnings as mesh_warnings
from .mesh_files import parse_mesh as parse_mesh
