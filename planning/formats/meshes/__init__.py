"""Mesh files: STL, OBJ, PLY, VTP and legacy VTK, each by a reader of its own, behind `parse_mesh`."""
