from .job import reproduce_paper as reproduce_paper, run_servo as run_servo
