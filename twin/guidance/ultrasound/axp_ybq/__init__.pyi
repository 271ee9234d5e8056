from .calibration import Calibration as Calibration, calibrate as calibrate
from .direction import mean_direction as mean_direction
from .estimate import Estimate as Estimate, active_columns as active_columns
from .pose_choice import choose_poses as choose_poses, expected_tre_mm as expected_tre_mm
from .recording import (
    FILE_NAME as FILE_NAME,
    MAX_BYTES as MAX_BYTES,
    Noise as Noise,
    Recording as Recording,
    parse_recording as parse_recording,
    recording_file as recording_file,
    write_recording as write_recording,
)
from .residuals import UNWEIGHTED as UNWEIGHTED, Problem as Problem, tip_residuals as tip_residuals
from .robust import plain_fit as plain_fit
from .slips import checked_calibration as checked_calibration
