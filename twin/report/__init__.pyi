from .annotate import INK as INK
from .annotate import width_of as width_of
from .annotate import write as write
from .map_view import Cells as Cells
from .map_view import MapView as MapView
from .map_view import body_directions as body_directions
from .map_view import step_of as step_of
from .mount_text import direction_words as direction_words
from .mount_text import mount_words as mount_words
from .numbers import (
    arm_words as arm_words,
)
from .numbers import (
    chosen_row as chosen_row,
)
from .numbers import (
    demanding as demanding,
)
from .numbers import (
    nearest_structure as nearest_structure,
)
from .numbers import (
    needle_words as needle_words,
)
from .numbers import (
    number as number,
)
from .numbers import (
    percent as percent,
)
from .numbers import (
    reason_counts as reason_counts,
)
from .numbers import (
    target_words as target_words,
)
from .palette import (
    PNG_LEVEL as PNG_LEVEL,
)
from .palette import (
    REASON_COLOURS as REASON_COLOURS,
)
from .palette import (
    REASON_WORDS as REASON_WORDS,
)
from .palette import (
    Rgb as Rgb,
)
from .palette import (
    css as css,
)
from .palette import (
    reason_of as reason_of,
)
from .palette import (
    safe_shades as safe_shades,
)
from .progress import progress_display as progress_display
