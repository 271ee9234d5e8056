"""A checked plan as a file for a robot: URScript, ROS 2, or a table of times. Metres: names with ``_m``.

What is written is read back and compared with the plan before it is published.
"""
