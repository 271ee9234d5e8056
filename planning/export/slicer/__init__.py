"""What 3D Slicer opens: a path, markers, the safe entry area on the skin, the CT-to-robot transform, a scene."""
