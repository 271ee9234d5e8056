from .mirror import (
    Mirror as Mirror,
    RecordedJoints as RecordedJoints,
    connect as connect,
    live_states as live_states,
    mirror_text as mirror_text,
)
