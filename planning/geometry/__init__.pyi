from .containment import Side as Side, side_of as side_of
from .creases import split_at_creases as split_at_creases
from .crossings import Crossings as Crossings, first_crossing as first_crossing
from .decimation import decimated as decimated
from .frames import (
    frame_about as frame_about,
    frame_along as frame_along,
    frame_of_axes as frame_of_axes,
    frame_of_points as frame_of_points,
    frame_xz as frame_xz,
    frame_yz as frame_yz,
)
from .mesh import TriangleMesh as TriangleMesh
from .rigid import (
    apply as apply,
    exp_twist as exp_twist,
    inverse as inverse,
    log_twist as log_twist,
    pose as pose,
    rotated_about as rotated_about,
)
from .rotations import (
    exp_rotation as exp_rotation,
    left_jacobian as left_jacobian,
    log_rotation as log_rotation,
    skew as skew,
)
from .spaces import Space as Space, parse_space as parse_space, to_lps as to_lps
from .triangle_distance import farthest_from as farthest_from, squared_distance as squared_distance
from .units import Unit as Unit, parse_unit as parse_unit
from .voxelize import voxels_inside as voxels_inside
from .winding import odd_fraction as odd_fraction, winding_number as winding_number
