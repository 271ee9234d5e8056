from .errors import (
    MOST_WHAT as MOST_WHAT,
)
from .errors import (
    CacheWarning as CacheWarning,
)
from .errors import (
    InputError as InputError,
)
from .errors import (
    NoAnswerError as NoAnswerError,
)
from .errors import (
    PlanningError as PlanningError,
)
from .errors import (
    one_line as one_line,
)
from .files import (
    atomic as atomic,
)
from .files import (
    check_writable as check_writable,
)
from .files import (
    is_folder as is_folder,
)
from .files import (
    is_plain_file as is_plain_file,
)
from .input_file import read_input as read_input
from .processes import worker_count as worker_count
from .provenance import (
    CASE_ROLE as CASE_ROLE,
)
from .provenance import (
    Input as Input,
)
from .provenance import (
    InputFiles as InputFiles,
)
from .provenance import (
    content_input as content_input,
)
from .provenance import (
    differing_input as differing_input,
)
from .provenance import (
    inputs_document as inputs_document,
)
from .provenance import (
    read_inputs as read_inputs,
)
from .reasons import Reason as Reason
from .stages import Stages as Stages
from .text_names import MAX_NAME as MAX_NAME
from .text_names import check_name as check_name
from .text_names import unprintable_texts as unprintable_texts
from .toml_file import (
    SchemaOne as SchemaOne,
)
from .toml_file import (
    find_toml as find_toml,
)
from .toml_file import (
    parse_toml as parse_toml,
)
from .toml_file import (
    read_toml as read_toml,
)
from .toml_file import (
    read_toml_bytes as read_toml_bytes,
)
from .whole_lines import unfinished_warnings as unfinished_warnings
