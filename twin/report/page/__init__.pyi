from .page import fill as fill
from .page import write_page as write_page
from .page_tables import (
    TIMES as TIMES,
)
from .page_tables import (
    escape as escape,
)
from .page_tables import (
    inputs_table as inputs_table,
)
from .page_tables import (
    origin_section as origin_section,
)
from .page_tables import (
    pairs as pairs,
)
from .page_tables import (
    table as table,
)
