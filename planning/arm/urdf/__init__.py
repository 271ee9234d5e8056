"""An arm's URDF: read strictly, its chain of six joints, its links' shapes, and its lengths if it is built as a UR.

URDFs speak metres; here are mm. What a URDF leaves open (a frame, a limit, a shape) is refused.
"""
