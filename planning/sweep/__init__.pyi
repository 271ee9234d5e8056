from .sweep_plan import SweepPlan as SweepPlan
from .sweep_planner import plan_sweep as plan_sweep
