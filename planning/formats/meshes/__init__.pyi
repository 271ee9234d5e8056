from .mesh_files import mesh_warnings as mesh_warnings, parse_mesh as parse_mesh
