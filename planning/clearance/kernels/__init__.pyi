from .blocks import Blocks as Blocks, pack as pack
from .lanes import LANES as LANES
from .scratch import Found as Found, scratch_for as scratch_for
from .segment_triangle import axis_triangle as axis_triangle
from .tile_search import COUNTED as COUNTED, search_tiles as search_tiles
