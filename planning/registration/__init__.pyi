from .conditioning import Conditioning as Conditioning
from .marker_check import check_markers as check_markers
from .marker_check import checked_placement as checked_placement
from .placement import Placement as Placement
from .placement import load_placement as load_placement
from .registration import (
    MIN_MARKERS as MIN_MARKERS,
)
from .registration import (
    MarkerPairs as MarkerPairs,
)
from .registration import (
    Registration as Registration,
)
from .registration import (
    apply as apply,
)
from .registration import (
    fit_affine as fit_affine,
)
from .registration import (
    fit_rigid as fit_rigid,
)
from .registration import (
    fit_triad as fit_triad,
)
from .registration import (
    match as match,
)
from .registration import (
    register as register,
)
