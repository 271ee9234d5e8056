"""Exports: a checked plan for a robot, a case for Slicer, a result for an archive. Metres: names with ``_m``.

What is written is read back and compared with the plan before it is published.
"""
