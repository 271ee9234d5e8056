from .mirror import (
    Mirror as Mirror,
    connect as connect,
    live_states as live_states,
    mirror_text as mirror_text,
    recorded_states as recorded_states,
    recording_warnings as recording_warnings,
)
