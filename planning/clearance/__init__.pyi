from .cross_check import CrossChecked as CrossChecked
from .engine import ClearanceEngine as ClearanceEngine
from .fast_engine import FastEngine as FastEngine
from .fcl_engine import FclEngine as FclEngine
from .measure import Clearances as Clearances
