"""Mesh files: STL, OBJ, PLY, GLB and VTP, each by a reader of its own, behind `parse_mesh`."""
