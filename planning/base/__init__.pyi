from .errors import (
    MOST_WHAT as MOST_WHAT,
    CacheWarning as CacheWarning,
    InputError as InputError,
    NoAnswerError as NoAnswerError,
    PlanningError as PlanningError,
    one_line as one_line,
)
from .files import (
    atomic as atomic,
    check_writable as check_writable,
    is_folder as is_folder,
    is_plain_file as is_plain_file,
)
from .html import Facts as Facts, card as card, escape as escape, never_raises as never_raises
from .input_file import (
    decode_text as decode_text,
    read_input as read_input,
    unfinished_warnings as unfinished_warnings,
)
from .polar_map import Sectors as Sectors, polar_map as polar_map
from .processes import map_all as map_all, process_pool as process_pool, worker_count as worker_count
from .progress import Count as Count, Silent as Silent, Stages as Stages, Watcher as Watcher, uncounted as uncounted
from .provenance import (
    CASE_ROLE as CASE_ROLE,
    Input as Input,
    InputFiles as InputFiles,
    content_input as content_input,
    differing_input as differing_input,
    inputs_document as inputs_document,
    read_inputs as read_inputs,
)
from .reasons import (
    REASON_COLOURS as REASON_COLOURS,
    REASON_TEXT as REASON_TEXT,
    SAFE as SAFE,
    Reason as Reason,
    Rgb as Rgb,
    css as css,
)
from .text_names import MAX_NAME as MAX_NAME, check_name as check_name, unprintable_texts as unprintable_texts
from .toml_file import (
    SchemaOne as SchemaOne,
    find_toml as find_toml,
    parse_toml as parse_toml,
    read_toml_bytes as read_toml_bytes,
)
