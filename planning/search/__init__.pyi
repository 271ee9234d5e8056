from .candidates import ARM_CHECKED as ARM_CHECKED
from .candidates import Candidates as Candidates
from .constraints import longest_path as longest_path
from .context import Prepared as Prepared
from .context import Watcher as Watcher
from .context import prepare as prepare
from .explain import (
    Explanation as Explanation,
)
from .explain import (
    finite as finite,
)
from .explain import (
    needle_warnings as needle_warnings,
)
from .explain import (
    reason_text as reason_text,
)
from .search import (
    Reach as Reach,
)
from .search import (
    case_directions as case_directions,
)
from .search import (
    closest_miss as closest_miss,
)
from .search import (
    organ_candidates as organ_candidates,
)
from .search import (
    ranked as ranked,
)
from .search import (
    reach_request as reach_request,
)
from .search import (
    with_reach as with_reach,
)
from .table import write_table as write_table
