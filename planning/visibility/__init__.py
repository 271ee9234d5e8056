"""Where the devices that see needle and target go, and what they see: two cameras, and an ultrasound probe.

It decides by geometry alone: skin, arms, obstacles and organs where the case and its plan have them.
"""
