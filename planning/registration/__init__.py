"""Markers to pose: CT to robot base with residuals and expected error, and all that could make markers lie."""
