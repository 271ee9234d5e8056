from .body_mask import BODY_HU as BODY_HU, BodyMask as BodyMask, filled_slices as filled_slices
from .drawn_side import DrawnSide as DrawnSide
from .flat_side import FlatSide as FlatSide
from .outside_body import (
    BEYOND_LONG_MM as BEYOND_LONG_MM,
    BEYOND_MM as BEYOND_MM,
    BOX_FACES as BOX_FACES,
    OutsideImage as OutsideImage,
    beyond_body as beyond_body,
    beyond_drawn_sides as beyond_drawn_sides,
    beyond_face as beyond_face,
    beyond_flat_sides as beyond_flat_sides,
    outside_mask as outside_mask,
    outside_surface as outside_surface,
)
from .support import FACES as FACES, find_support as find_support, support_warnings as support_warnings
from .unscanned import measured_hu as measured_hu, unscanned_voxels as unscanned_voxels
