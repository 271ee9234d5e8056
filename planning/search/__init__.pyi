from .arm_reach import ArmReach as ArmReach, reach_request as reach_request, with_reach as with_reach
from .candidates import ARM_CHECKED as ARM_CHECKED, Candidates as Candidates
from .constraints import closest_miss as closest_miss
from .context import CaseContext as CaseContext, prepare as prepare
from .explain import (
    Explanation as Explanation,
    finite as finite,
    needle_warnings as needle_warnings,
    reason_text as reason_text,
)
from .organs import organ_candidates as organ_candidates
from .ranking import ranked as ranked
from .table import write_table as write_table
