from .true_arm import ArmErrors as ArmErrors, TrueArm as TrueArm, draw_true_arm as draw_true_arm
from .truth import Truth as Truth, draw_truth as draw_truth
