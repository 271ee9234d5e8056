from .rehearsal import rehearse as rehearse
from .result import Rehearsal as Rehearsal
