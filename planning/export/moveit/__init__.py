"""A plan for MoveIt and ROS 2: the scene, the goals, the arm with its needle, and who sends them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
