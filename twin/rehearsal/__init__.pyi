from .rehearsal import Rehearsal as Rehearsal, rehearse as rehearse
