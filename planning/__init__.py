"""The planner: decides which needle paths are safe and reachable, and how the arm follows one.

It is pure: no simulator, no screen, no printing, and nothing of `twin`. Its rooms import each other in one direction:
base, geometry, formats, needle, breathing, arm, case, anatomy, clearance, registration, collision, reach, motion,
search, and after them certify, plan, export, place, batch and the collision cases of pytest.
"""
