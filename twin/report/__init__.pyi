from .annotate import INK as INK, width_of as width_of, write as write
from .map_view import MapCells as MapCells, MapView as MapView, body_directions as body_directions, step_of as step_of
from .mount_text import direction_words as direction_words, mount_words as mount_words
from .numbers import (
    arm_words as arm_words,
    demanding as demanding,
    nearest_structure as nearest_structure,
    needle_words as needle_words,
    number as number,
    percent as percent,
    reason_counts as reason_counts,
    target_words as target_words,
)
from .palette import (
    PNG_LEVEL as PNG_LEVEL,
    reason_of as reason_of,
    safe_shades as safe_shades,
)
from .progress import progress_display as progress_display
