from .ball_image import BallScene as BallScene
from .ball_image import render as render
from .tracker import LostBall as LostBall
from .tracker import find_ball as find_ball
