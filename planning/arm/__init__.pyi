from .gantry import gantry_boxes as gantry_boxes
from .insertion import (
    MIN_SINGULARITY as MIN_SINGULARITY,
)
from .insertion import (
    NeedleLine as NeedleLine,
)
from .insertion import (
    away_from_singularities as away_from_singularities,
)
from .insertion import (
    branch_way as branch_way,
)
from .insertion import (
    every_way as every_way,
)
from .insertion import (
    first_stop as first_stop,
)
from .insertion import (
    flange_at as flange_at,
)
from .insertion import (
    flange_poses as flange_poses,
)
from .insertion import (
    needle_lines as needle_lines,
)
from .insertion import (
    reach_margin as reach_margin,
)
from .insertion import (
    survey as survey,
)
from .insertion import (
    why_unreachable as why_unreachable,
)
from .kernels import link_frames as link_frames
from .kinematics import (
    N_BRANCHES as N_BRANCHES,
)
from .kinematics import (
    flange_pose as flange_pose,
)
from .kinematics import (
    inverse as inverse,
)
from .kinematics import (
    jacobian as jacobian,
)
from .kinematics import (
    link_poses as link_poses,
)
from .kinematics import (
    nearest_within_limits as nearest_within_limits,
)
from .kinematics import (
    singularity as singularity,
)
from .kinematics import (
    wrap_to_pi as wrap_to_pi,
)
from .kinematics import (
    wrapped_solutions as wrapped_solutions,
)
from .links import (
    JOINT_NAMES as JOINT_NAMES,
)
from .links import (
    LINK_NAMES as LINK_NAMES,
)
from .links import (
    T_BASE_URDFBASE as T_BASE_URDFBASE,
)
from .links import (
    Link as Link,
)
from .links import (
    collision_links as collision_links,
)
from .links import (
    joined as joined,
)
from .links import (
    resolve_package as resolve_package,
)
from .links import (
    urdf_link_poses as urdf_link_poses,
)
from .links import (
    urdf_path as urdf_path,
)
from .links import (
    visual_links as visual_links,
)
from .tool import Box as Box
from .tool import Tool as Tool
from .ur import UrModel as UrModel
from .ur import ur_model as ur_model
