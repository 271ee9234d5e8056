from .point_files import NamedPoints as NamedPoints, parse_points as parse_points
from .raw_points import parse_coordinate as parse_coordinate
