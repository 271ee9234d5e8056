"""UR arms as drawn: dimensions, kinematics, link meshes, the tool, a CT gantry, the straight insertion.

Whether an arm touches anything is tested in `collision`, whether it can reach a direction in `reach`.
"""
