from .body_mask import BODY_HU as BODY_HU, BodyMask as BodyMask, filled_slices as filled_slices
from .outside_body import (
    BOX_FACES as BOX_FACES,
    OutsideImage as OutsideImage,
    beyond_body as beyond_body,
    beyond_flat_sides as beyond_flat_sides,
    joined as joined,
    outside_surface as outside_surface,
)
