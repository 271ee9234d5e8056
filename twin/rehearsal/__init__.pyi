from .rehearsal import Rehearsal as Rehearsal
from .rehearsal import rehearse as rehearse
