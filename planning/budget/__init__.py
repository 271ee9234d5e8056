"""Error budget of a puncture: the cost of each source, and the gain of other scans, markers, arms or guidance.

It computes with the one error model; nothing here decides a verdict.
"""
