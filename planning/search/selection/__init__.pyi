from .choice import (
    BEST as BEST,
    Choice as Choice,
    Chosen as Chosen,
    Pick as Pick,
    best_pick as best_pick,
    choose as choose,
    choose_stated as choose_stated,
    chosen_angles as chosen_angles,
    parse_choice as parse_choice,
)
from .listed import Listed as Listed, ReadList as ReadList, read_entries as read_entries, read_targets as read_targets
from .safe_cone import grid_cone as grid_cone, with_grid_cone as with_grid_cone
from .windows import (
    MOST_WINDOWS as MOST_WINDOWS,
    Window as Window,
    Windows as Windows,
    find_windows as find_windows,
    nearest_row as nearest_row,
)
