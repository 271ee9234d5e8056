"""The commands of an experiment, each with the truth beside what is measured: scan, touch.

A job composes plant and guidance: the device measures, guidance reads, and the job alone compares both with the truth.
"""
