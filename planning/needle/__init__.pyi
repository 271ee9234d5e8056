from .beam import Beam as Beam, Shape as Shape
from .bevel_path import BevelPath as BevelPath, bevel_path as bevel_path
from .deflection import DeflectionBound as DeflectionBound, deflection_bound as deflection_bound
from .insertion_force import InsertionForce as InsertionForce, insertion_force as insertion_force
from .shaft import GAUGES as GAUGES, Gauge as Gauge, Shaft as Shaft
from .tissue import Layer as Layer, Tissue as Tissue
