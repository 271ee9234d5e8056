from .touch_plan import Touch as Touch, TouchPlan as TouchPlan
from .touch_planner import plan_touches as plan_touches
