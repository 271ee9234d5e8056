from .plan import (
    MAX_PLAN_BYTES as MAX_PLAN_BYTES,
)
from .plan import (
    PLAN_VERSION as PLAN_VERSION,
)
from .plan import (
    POSE_TOLERANCE_MM as POSE_TOLERANCE_MM,
)
from .plan import (
    STRAIGHT_TOLERANCE_MM as STRAIGHT_TOLERANCE_MM,
)
from .plan import (
    Plan as Plan,
)
from .plan import (
    check_geometry as check_geometry,
)
from .plan import (
    parse_plan as parse_plan,
)
from .plan import (
    write_plan as write_plan,
)
from .planner import make_plan as make_plan
from .recheck import check_plan as check_plan
