from .ball_image import BallScene as BallScene, render as render
from .tracker import LostBall as LostBall, find_ball as find_ball
