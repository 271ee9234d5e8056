"""UR arms as drawn: dimensions, kinematics, link meshes, the tool, a CT gantry, the straight insertion."""
