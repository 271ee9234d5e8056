from .annotate import INK as INK, width_of as width_of, write as write
from .map_view import MapCells as MapCells, MapView as MapView, body_directions as body_directions, step_of as step_of
from .mount_text import direction_text as direction_text, mounting_text as mounting_text
from .numbers import (
    arm_text as arm_text,
    demanding as demanding,
    nearest_structure as nearest_structure,
    needle_text as needle_text,
    number as number,
    percent as percent,
    reason_counts as reason_counts,
    target_text as target_text,
)
from .palette import (
    PNG_LEVEL as PNG_LEVEL,
    reason_of as reason_of,
    safe_shades as safe_shades,
)
from .progress import progress_display as progress_display
