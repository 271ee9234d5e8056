from .checked_placement import checked_placement as checked_placement
from .marker_check import check_markers as check_markers
from .squareness import Squareness as Squareness, check_squareness as check_squareness
