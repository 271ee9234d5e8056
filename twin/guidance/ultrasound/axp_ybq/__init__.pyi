from .calibration import Calibration as Calibration
from .calibration import calibrate as calibrate
from .direction import mean_direction as mean_direction
from .estimate import Estimate as Estimate
from .estimate import active_columns as active_columns
from .pose_choice import choose_poses as choose_poses
from .pose_choice import expected_tre_mm as expected_tre_mm
from .recording import (
    FILE_NAME as FILE_NAME,
)
from .recording import (
    MAX_BYTES as MAX_BYTES,
)
from .recording import (
    Noise as Noise,
)
from .recording import (
    Recording as Recording,
)
from .recording import (
    parse_recording as parse_recording,
)
from .recording import (
    recording_file as recording_file,
)
from .recording import (
    write_recording as write_recording,
)
from .refine import Problem as Problem
from .residuals import tip_residuals as tip_residuals
from .robust import plain_fit as plain_fit
from .rotations import exp as exp
from .rotations import log as log
from .rotations import tangent_basis as tangent_basis
from .slips import checked_calibration as checked_calibration
from .weighting import UNWEIGHTED as UNWEIGHTED
