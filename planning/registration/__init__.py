"""Markers to pose: CT to robot base with residuals and expected error, and all that could make markers lie.

The equations are Arun's and Horn's rigid fit and Fitzpatrick's error formulas; each module names its source.
"""
