from .declarations import AS_FOUND as AS_FOUND, AS_STATED as AS_STATED, Declaration as Declaration
from .monte_carlo import Experiment as Experiment, run_draws as run_draws
