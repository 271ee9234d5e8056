from .joint_model import Guess as Guess, JointModel as JointModel, Observed as Observed, Unknowns as Unknowns
from .needle_error import NeedleError as NeedleError, open_loop_error as open_loop_error, servoed_error as servoed_error
from .needle_outcome import NeedleOutcome as NeedleOutcome, TrueNeedle as TrueNeedle, needle_outcome as needle_outcome
from .optimum import Adjusted as Adjusted, adjust as adjust, bound as bound
