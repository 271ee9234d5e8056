"""A needle that bends: its cross section, the beam on an elastic foundation, the path of a bevel, the force on the way.

Pure mechanics in N and mm; it knows neither cases nor patients.
"""
