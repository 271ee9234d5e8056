from .approach import (
    FINER as FINER,
    MAX_SWEEP_MM as MAX_SWEEP_MM,
    RESOLUTION_RAD as RESOLUTION_RAD,
    dense_states as dense_states,
    first_contact as first_contact,
    least_clearance as least_clearance,
    plan_approach as plan_approach,
)
from .follow import MAX_JERK as MAX_JERK, follow_smoothly as follow_smoothly
from .trajectory import SAMPLE_S as SAMPLE_S, Peaks as Peaks, Trajectory as Trajectory
