from .job import reproduce_paper as reproduce_paper
from .job import run_servo as run_servo
