from .goals import approach_goals as approach_goals
from .reach import ReachRequest as ReachRequest
from .reach import assess_reach_all as assess_reach_all
from .standoff import axis_lengths as axis_lengths
from .standoff import farthest_flange as farthest_flange
from .standoff import standoffs as standoffs
