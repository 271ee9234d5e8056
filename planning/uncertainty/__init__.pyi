from .hit import (
    TargetRays as TargetRays,
    hit_in_ball as hit_in_ball,
    hit_in_mesh as hit_in_mesh,
    target_rays as target_rays,
)
from .pose_error import (
    ErrorBudget as ErrorBudget,
    PoseError as PoseError,
    error_budget as error_budget,
    pose_error as pose_error,
)
