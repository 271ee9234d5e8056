from .arm_phases import with_breathing_reach as with_breathing_reach
from .moving_weights import MovingWeights as MovingWeights, moving_weights as moving_weights
from .organ_phases import with_breathing as with_breathing
