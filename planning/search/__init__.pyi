from .candidates import ARM_CHECKED as ARM_CHECKED, Candidates as Candidates
from .constraints import longest_path as longest_path
from .context import CaseContext as CaseContext, prepare as prepare
from .explain import (
    Explanation as Explanation,
    finite as finite,
    needle_warnings as needle_warnings,
    reason_text as reason_text,
)
from .search import (
    ArmReach as ArmReach,
    case_directions as case_directions,
    closest_miss as closest_miss,
    organ_candidates as organ_candidates,
    ranked as ranked,
    reach_request as reach_request,
    with_reach as with_reach,
)
from .table import write_table as write_table
