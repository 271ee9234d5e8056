"""An arm's URDF: read strictly, its chain of six joints, its links' shapes, and its lengths if it is built as a UR."""
