"""What the bending of a needle takes away from safe directions, and what a needle feels and does on one path.

The bound is kept as clearance beside every margin; the path and the force of one direction are for people to read.
"""
