from .mesh_files import parse_mesh as parse_mesh
from .mesh_warnings import mesh_warnings as mesh_warnings
