from .detection import Placed as Placed
from .detection import ball_scene as ball_scene
from .experiment import (
    Row as Row,
)
from .experiment import (
    Statistics as Statistics,
)
from .experiment import (
    Trial as Trial,
)
from .experiment import (
    run_trials as run_trials,
)
from .experiment import (
    statistics as statistics,
)
from .experiment import (
    trial as trial,
)
from .servo_case import ServoCase as ServoCase
from .servo_case import load_servo_case as load_servo_case
from .session import Reached as Reached
from .session import Session as Session
from .session import run_session as run_session
