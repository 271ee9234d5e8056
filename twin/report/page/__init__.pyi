from .page import fill as fill, write_page as write_page
from .page_tables import (
    TIMES as TIMES,
    escape as escape,
    inputs_table as inputs_table,
    origin_section as origin_section,
    pairs as pairs,
    table as table,
)
