from .bodies.arm_bodies import arm_bodies as arm_bodies
from .bodies.body import Body as Body, Shape as Shape
from .bodies.prisms import prism as prism
from .bodies.shapes import surface as surface, touch as touch
from .bodies.sphere_tree import sphere_tree as sphere_tree
from .checker import (
    DISTANCE_PAIRS as DISTANCE_PAIRS,
    CellChecker as CellChecker,
    Distances as Distances,
    Nearest as Nearest,
)
from .fast_checker import FastChecker as FastChecker
from .patient import FclPatient as FclPatient, FclSkin as FclSkin
from .segments import halving_order as halving_order
from .state_checker import PATIENT as PATIENT
from .surroundings import case_boxes as case_boxes, check_gantry as check_gantry, with_surroundings as with_surroundings
from .workcell import (
    ARM_PADDING_MM as ARM_PADDING_MM,
    case_checker as case_checker,
    case_tool as case_tool,
    home_configuration as home_configuration,
    patient_surface as patient_surface,
)
