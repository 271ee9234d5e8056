from .containment import Side as Side, side_of as side_of
from .creases import split_at_creases as split_at_creases
from .crossings import Crossings as Crossings, first_crossing as first_crossing
from .decimation import decimated as decimated, squared_distance as squared_distance
from .mesh import TriangleMesh as TriangleMesh
from .spaces import Space as Space, Unit as Unit, parse_space as parse_space, parse_unit as parse_unit, to_lps as to_lps
from .voxelize import voxels_inside as voxels_inside
from .winding import odd_fraction as odd_fraction, winding_number as winding_number
