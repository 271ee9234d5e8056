"""A needle that bends: its cross section, the beam on an elastic foundation, the path of a bevel, the axial force.

Pure mechanics in N and mm; it knows neither cases nor patients.
"""
