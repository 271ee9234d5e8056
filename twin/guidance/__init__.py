"""How the needle is brought to the target from measurements: by stereo cameras, or by ultrasound with two arms.

Guidance by CT markers is `planning.registration`, for the planner itself needs it.
"""
