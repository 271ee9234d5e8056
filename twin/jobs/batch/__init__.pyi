from .merge_job import merge_cohort as merge_cohort
from .plan_job import plan_cohort as plan_cohort
from .run_job import run_part as run_part
