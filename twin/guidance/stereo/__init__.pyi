from .detection import Placed as Placed, ball_scene as ball_scene
from .experiment import (
    Row as Row,
    Statistics as Statistics,
    Trial as Trial,
    run_trials as run_trials,
    statistics as statistics,
    trial as trial,
)
from .servo_case import ServoCase as ServoCase, load_servo_case as load_servo_case
from .session import Reached as Reached, Session as Session, run_session as run_session
