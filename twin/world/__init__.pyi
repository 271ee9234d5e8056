from .bodies import load_ball as load_ball
from .cameras import pinhole_picture as pinhole_picture
from .client import TIME_STEP_S as TIME_STEP_S
from .execution import Execution as Execution, execute as execute
from .workcell import open_workcell as open_workcell
