"""A plan for MoveIt and ROS 2: the scene, the goals, the arm with its needle, and who sends them."""
