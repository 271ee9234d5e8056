"""Cameras: pinhole with lens distortion, calibration from known points, bundle adjustment, triangulation."""
