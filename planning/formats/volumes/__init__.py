"""Volumes: NIfTI and NRRD, with headers that are checked before any voxel is inflated, in one orientation."""
