"""Named points: CSV, and 3D Slicer's markups and fiducial lists."""
