from .map_picture import draw_map as draw_map
from .placement_picture import draw_placements as draw_placements
