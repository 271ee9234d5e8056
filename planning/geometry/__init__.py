"""Triangle meshes and what follows from them alone: crossings, containment, winding, creases, voxels.

Rigid motions, least squares, spaces (LPS, RAS) and units are here too. Nothing here knows what a mesh means to a
patient or to an arm.
"""
