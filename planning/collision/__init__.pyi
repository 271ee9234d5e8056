from .bodies import Body as Body
from .bodies import Shape as Shape
from .bodies import arm_bodies as arm_bodies
from .bounding_spheres import ball_tree as ball_tree
from .bounding_spheres import prism as prism
from .checker import (
    DISTANCE_PAIRS as DISTANCE_PAIRS,
)
from .checker import (
    CellChecker as CellChecker,
)
from .checker import (
    Distances as Distances,
)
from .checker import (
    Nearest as Nearest,
)
from .fast_checker import FastChecker as FastChecker
from .segments import halving_order as halving_order
from .shapes import skin_surface as skin_surface
from .shapes import touch as touch
from .state_checker import PATIENT as PATIENT
from .surroundings import with_surroundings as with_surroundings
from .workcell import (
    ARM_PADDING_MM as ARM_PADDING_MM,
)
from .workcell import (
    case_boxes as case_boxes,
)
from .workcell import (
    case_checker as case_checker,
)
from .workcell import (
    case_tool as case_tool,
)
from .workcell import (
    check_gantry as check_gantry,
)
from .workcell import (
    home_configuration as home_configuration,
)
from .workcell import (
    patient_surface as patient_surface,
)
