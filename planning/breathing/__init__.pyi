from .breathing import Breathing as Breathing, Weights as Weights
from .lujan import fraction_within as fraction_within, positions as positions
