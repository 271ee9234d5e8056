from .trunk import Trunk as Trunk, draw_trunk as draw_trunk
from .trunk_case import write_trunk_case as write_trunk_case
