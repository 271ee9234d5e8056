from .approach import (
    FINER as FINER,
)
from .approach import (
    MAX_SWEEP_MM as MAX_SWEEP_MM,
)
from .approach import (
    RESOLUTION_RAD as RESOLUTION_RAD,
)
from .approach import (
    dense_states as dense_states,
)
from .approach import (
    first_contact as first_contact,
)
from .approach import (
    least_clearance as least_clearance,
)
from .approach import (
    plan_approach as plan_approach,
)
from .follow import MAX_JERK as MAX_JERK
from .follow import drive_smoothly as drive_smoothly
from .trajectory import SAMPLE_S as SAMPLE_S
from .trajectory import Peaks as Peaks
from .trajectory import Trajectory as Trajectory
