"""The commands of experiments, which compare measurements with the ground truth: scan, touch, pivot, sweep.

A job composes plant and guidance: the device measures, guidance reads, and the job alone compares both with the truth.
"""
