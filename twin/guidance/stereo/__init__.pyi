from .detection import LocatedPair as LocatedPair, ball_scene as ball_scene
from .experiment import (
    ServoTrial as ServoTrial,
    Statistics as Statistics,
    TargetRow as TargetRow,
    run_trials as run_trials,
    statistics as statistics,
    trial as trial,
)
from .servo_case import ServoCase as ServoCase, load_servo_case as load_servo_case
from .session import Reached as Reached, Session as Session, run_session as run_session
