from .lesion import read_lesion as read_lesion
from .markers import Markers as Markers, find_markers as find_markers
from .needle import FoundNeedle as FoundNeedle, find_needle as find_needle
from .pivot import Pivot as Pivot, pivot_calibration as pivot_calibration
