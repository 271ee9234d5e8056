from .axis_lengths import axis_lengths as axis_lengths, farthest_flange as farthest_flange
from .goals import approach_goals as approach_goals
from .reach import ReachRequest as ReachRequest, assess_reach_all as assess_reach_all
from .standoff import standoffs as standoffs, waiting_flange as waiting_flange
