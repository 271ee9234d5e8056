from .true_arm import ArmErrors as ArmErrors
from .true_arm import TrueArm as TrueArm
from .true_arm import draw_true_arm as draw_true_arm
from .truth import Truth as Truth
from .truth import draw_truth as draw_truth
