from .plan import Plan as Plan
from .plan_check import (
    POSE_TOLERANCE_MM as POSE_TOLERANCE_MM,
    STRAIGHT_TOLERANCE_MM as STRAIGHT_TOLERANCE_MM,
    check_geometry as check_geometry,
)
from .plan_document import (
    MAX_PLAN_BYTES as MAX_PLAN_BYTES,
    PLAN_VERSION as PLAN_VERSION,
    parse_plan as parse_plan,
    write_plan as write_plan,
)
from .planner import make_plan as make_plan
from .recheck import check_plan as check_plan
