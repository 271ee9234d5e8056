"""The CT scanner: a scene of solids with Hounsfield units in, a series of slices out; and what a person reads off it.

It knows the ground truth. What it writes (DICOM, NIfTI) and `readings` are all that guidance sees of it.
"""
