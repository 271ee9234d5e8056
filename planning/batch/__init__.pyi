from .run import run_cohort as run_cohort
