from .page import write_page as write_page
from .page_tables import (
    TIMES as TIMES,
    faint as faint,
    inputs_table as inputs_table,
    origin_section as origin_section,
    pairs as pairs,
    table as table,
)
from .template import (
    Card as Card,
    data_address as data_address,
    plotly_script as plotly_script,
    script_json as script_json,
    write_html as write_html,
)
