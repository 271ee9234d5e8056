from .blocks import Blocks as Blocks
from .blocks import pack as pack
from .lanes import LANES as LANES
from .scratch import Found as Found
from .scratch import scratch_for as scratch_for
from .segment_triangle import axis_triangle as axis_triangle
from .tile_search import COUNTED as COUNTED
from .tile_search import search_tiles as search_tiles
