from .mirror import (
    Mirror as Mirror,
)
from .mirror import (
    connect as connect,
)
from .mirror import (
    live_states as live_states,
)
from .mirror import (
    mirror_text as mirror_text,
)
from .mirror import (
    recorded_states as recorded_states,
)
from .mirror import (
    recording_warnings as recording_warnings,
)
