from .body_mask import BODY_HU as BODY_HU
from .body_mask import BodyMask as BodyMask
from .body_mask import filled_slices as filled_slices
from .outside_body import (
    BOX_FACES as BOX_FACES,
)
from .outside_body import (
    OutsideImage as OutsideImage,
)
from .outside_body import (
    beyond_body as beyond_body,
)
from .outside_body import (
    beyond_flat_sides as beyond_flat_sides,
)
from .outside_body import (
    joined as joined,
)
from .outside_body import (
    outside_surface as outside_surface,
)
