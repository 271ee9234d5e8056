"""The camera guidance: two calibrated cameras, a ball on the tool, and a servo on what they see (Liu 2007).

The session draws its own workcell with ground truth, an exception from `guidance` never importing `plant`.
"""
