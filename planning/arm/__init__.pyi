from .gantry import gantry_boxes as gantry_boxes
from .insertion import first_stop as first_stop, reach_margin as reach_margin
from .inverse_kinematics import (
    N_BRANCHES as N_BRANCHES,
    inverse as inverse,
    nearest_within_limits as nearest_within_limits,
    wrap_to_pi as wrap_to_pi,
    wrapped_solutions as wrapped_solutions,
)
from .kinematics import (
    flange_pose as flange_pose,
    jacobian as jacobian,
    link_frames as link_frames,
    link_poses as link_poses,
)
from .links import (
    LINK_NAMES as LINK_NAMES,
    Link as Link,
    collision_links as collision_links,
    visual_links as visual_links,
)
from .model_urdf import (
    T_BASE_URDFBASE as T_BASE_URDFBASE,
    model_urdf as model_urdf,
)
from .needle_line import NeedleLine as NeedleLine, flange_poses as flange_poses, needle_lines as needle_lines
from .singularity import (
    MIN_SINGULARITY as MIN_SINGULARITY,
    away_from_singularities as away_from_singularities,
    singularity as singularity,
)
from .tool import Box as Box, Tool as Tool
from .ur import JOINT_NAMES as JOINT_NAMES, UrModel as UrModel, ur_model as ur_model
