from .calibrate import calibrate as calibrate
from .calibration import Calibration as Calibration
from .direction import mean_direction as mean_direction
from .estimate import Estimate as Estimate
from .outliers.robust import plain_fit as plain_fit
from .parameters import active_columns as active_columns
from .problem import UNWEIGHTED as UNWEIGHTED, Problem as Problem
from .recording import Noise as Noise, Recording as Recording
from .residuals.tip_residuals import tip_residuals as tip_residuals
