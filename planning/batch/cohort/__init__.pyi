from .cohort_case import CohortCase as CohortCase
