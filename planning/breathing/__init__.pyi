from .breathing import Breathing as Breathing
from .lujan import fraction_within as fraction_within, positions as positions
