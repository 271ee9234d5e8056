from .canvas import Canvas as Canvas, Halo as Halo, Words as Words, circle as circle, star as star
from .fonts import Anchor as Anchor, Face as Face, font as font
from .ticks import ticks as ticks
